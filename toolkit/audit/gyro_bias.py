"""A constant bias of the gyro: reported, never repaired, for the filters estimate it as it is.

Where the vehicle stands, its gyro must read nothing; a recording without a standstill is compared with the
rotation its own tracks show, which is good to half a degree a second only.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.robust import median_error
from toolkit.geometry import Array
from toolkit.measured_motion import TwistSamples
from toolkit.sequence import Sequence

# Measured speed below which the vehicle stands, and the fewest samples of a standstill that is used.
STANDING_MPS = 0.05
LEAST_STANDING = 50
# What a reading is good for (rad/s) beside the standard error of its median: a standing vehicle shakes, and the
# camera's own rotation is off by up to 0.0045 on KITTI drives whose gyro has no bias. A bias is one beyond so many
# standard errors with both in them; the constants were chosen on the recordings at hand.
SYSTEMATIC_STANDING = 0.00075
SYSTEMATIC_CAMERA = 0.00125
SIGMAS = 4.0


class _Reading(NamedTuple):
    """Gyro readings (M, 3) rad/s that should be zero, their systematic error, and where they come from."""

    residual_radps: Array
    systematic_radps: float
    source: str


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Count the axes with a bias beyond doubt; the bias itself is left to the filters."""
    reading = _standstill(evidence.sequence) or _against_camera(evidence)
    if reading is None:
        return evidence.blind
    bias_radps = np.median(reading.residual_radps, axis=0)
    error_radps = np.hypot(median_error(reading.residual_radps), reading.systematic_radps)
    biased = np.abs(bias_radps) > SIGMAS * error_radps
    if not biased.any():
        return None
    values = ", ".join(f"{b:.4f} +- {e:.4f}" for b, e in zip(bias_radps, error_radps, strict=True))
    return Symptom(
        count=int(biased.sum()),
        detail=f"the gyro reads ({values}) rad/s too much about x, y, z ({reading.source})",
        treatment="left to the estimators, which carry a gyro bias",
        remedy=None,
        harmful=False,
    )


def _standstill(sequence: Sequence) -> _Reading | None:
    motion = sequence.motion
    if not isinstance(motion, TwistSamples):
        return None
    stands = (np.linalg.norm(motion.v_mps, axis=1) < STANDING_MPS) & np.isfinite(motion.w_radps).all(axis=1)
    if stands.sum() < LEAST_STANDING:
        return None
    return _Reading(motion.w_radps[stands], SYSTEMATIC_STANDING, f"{stands.sum()} samples at standstill")


def _against_camera(evidence: Evidence) -> _Reading | None:
    intervals = evidence.intervals
    if intervals is None:
        return None
    w_imu = intervals.w_cam_radps @ evidence.sequence.rig.T_imu_cam[:3, :3].T
    source = f"against the camera's rotation over {len(w_imu)} intervals"
    return _Reading(intervals.w_radps - w_imu, SYSTEMATIC_CAMERA, source)


FAULT = Fault(
    "gyro-bias",
    "a constant gyro bias",
    check,
    after=("mixed-axes", "twist-lag", "time-offset"),
)
