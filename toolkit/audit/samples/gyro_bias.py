"""A constant bias of the gyro: reported and left to the estimators, unless the recording's prior excludes it.

With odometry and a standstill, the bias is the median rate while the vehicle stands. With an IMU it is one of the
unknowns of the self-calibration, accurate to 0.002 rad/s. Otherwise the gyro is compared with the rotation that the
tracks show from frame to frame, which is accurate to 0.5 degrees a second only.

An estimator with a prior of 0 +- 0.0005 rad/s diverges at a bias of 0.05 rad/s, so the covariance of such a prior is
widened by the difference. With odometry and without a prior, estimators start from a bias of zero; a bias that is too
large for that is subtracted.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.bundle import GYRO_BIAS
from toolkit.audit.parts.robust import median_error
from toolkit.geometry import Array, BoolArray
from toolkit.measured_motion import TwistSamples
from toolkit.sequence import Prior, Sequence

# Measured speed (m/s) below which the vehicle stands, and the fewest samples of a standstill that are used.
STANDING_MPS = 0.05
LEAST_STANDING = 50
# Systematic errors (rad/s), added to the standard error of the median: a standing vehicle vibrates, and the camera's
# own rotation is off by up to 0.0045 on KITTI drives whose gyro has no bias. A bias is reported beyond SIGMAS of the
# sum. The constants were chosen on the recordings at hand.
SYSTEMATIC_STANDING = 0.00075
SYSTEMATIC_CAMERA = 0.00125
# The same for self-calibrations: on V2_01 they are off by up to 0.0009 rad/s, six of their standard errors.
SYSTEMATIC_FIT = 0.0004
SIGMAS = 4.0
# With odometry and without a prior, estimators start from a bias of zero with this standard deviation (rad/s).
UNKNOWN_SIGMA_RADPS = 0.02


class _Reading(NamedTuple):
    """The bias of a gyro (3,) rad/s, its standard error with the systematic one, and how it was estimated."""

    bias_radps: Array
    error_radps: Array
    source: str


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Count the axes with a significant bias; it is left to the estimators where they can start with it."""
    reading = _standstill(evidence.sequence) or _fitted(evidence) or _against_camera(evidence)
    if reading is None:
        return evidence.blind
    bias_radps, error_radps, source = reading
    prior = evidence.sequence.prior
    denied = np.zeros(3, dtype=bool) if prior is None else _denied(prior, bias_radps, error_radps)
    biased = (np.abs(bias_radps) > SIGMAS * error_radps) | denied
    if not biased.any():
        return None
    values = ", ".join(f"{b:z.4f} +- {e:.4f}" for b, e in zip(bias_radps, error_radps, strict=True))
    detail = f"the gyro reads ({values}) rad/s too much about x, y, z ({source})"
    if prior is None and _is_too_much(evidence.sequence, bias_radps, error_radps):
        return Symptom(
            count=int(biased.sum()),
            detail=f"{detail}, more than expected by estimators that start without a bias",
            treatment="it is subtracted",
            remedy=_taken_off(evidence.sequence, bias_radps),
        )
    if prior is None or not denied.any():
        return Symptom.information(
            count=int(biased.sum()),
            detail=detail,
            treatment="left to the estimators, which estimate a gyro bias",
        )
    stated = ", ".join(f"{b:z.4f} +- {_sigma_radps(prior)[k]:.4f}" for k, b in enumerate(prior.bias[3:]))
    return Symptom(
        count=int(biased.sum()),
        detail=f"{detail}, and the prior has ({stated})",
        treatment="the prior's covariance of it is widened by the difference",
        remedy=replace(evidence.sequence, prior=_widened(prior, bias_radps, error_radps)),
    )


def _denied(prior: Prior, bias_radps: Array, error_radps: Array) -> BoolArray:
    """Say for which axes (3,) a prior excludes the bias, beyond chance."""
    apart = np.abs(bias_radps - prior.bias[3:])
    return np.asarray(apart > SIGMAS * np.hypot(_sigma_radps(prior), error_radps))


def _is_too_much(sequence: Sequence, bias_radps: Array, error_radps: Array) -> bool:
    """Say whether odometry has a bias that estimators do not expect, beyond chance."""
    least_radps = SIGMAS * np.hypot(UNKNOWN_SIGMA_RADPS, error_radps)
    return sequence.motion_kind == "twist" and bool((np.abs(bias_radps) > least_radps).any())


def _taken_off(sequence: Sequence, bias_radps: Array) -> Sequence:
    motion = sequence.motion
    assert isinstance(motion, TwistSamples)
    return replace(sequence, motion=replace(motion, w_radps=motion.w_radps - bias_radps))


def _sigma_radps(prior: Prior) -> Array:
    """Return the standard deviations (3,) rad/s of the gyro's bias in a prior."""
    return np.sqrt(np.diag(prior.cov)[-3:])


def _widened(prior: Prior, bias_radps: Array, error_radps: Array) -> Prior:
    """Return a prior that allows the bias, widened for all axes: one with a smaller difference is known no better."""
    cov = prior.cov.copy()
    cov[-3:, -3:] += np.diag((bias_radps - prior.bias[3:]) ** 2 + error_radps**2)
    return replace(prior, cov=cov, source=f"{prior.source}; its gyro bias widened by the audit")


def _standstill(sequence: Sequence) -> _Reading | None:
    motion = sequence.motion
    if not isinstance(motion, TwistSamples):
        return None
    stands = (np.linalg.norm(motion.v_mps, axis=1) < STANDING_MPS) & np.isfinite(motion.w_radps).all(axis=1)
    if stands.sum() < LEAST_STANDING:
        return None
    return _median(motion.w_radps[stands], SYSTEMATIC_STANDING, f"{stands.sum()} samples at standstill")


def _median(residual_radps: Array, systematic_radps: float, source: str) -> _Reading:
    """Return the median of readings (M, 3) that should be zero."""
    error_radps = np.hypot(median_error(residual_radps), systematic_radps)
    return _Reading(np.median(residual_radps, axis=0), error_radps, source)


def _fitted(evidence: Evidence) -> _Reading | None:
    found = evidence.self_calibration
    if found is None:
        return None
    error_radps = np.hypot(found.error[GYRO_BIAS], SYSTEMATIC_FIT)
    return _Reading(found.value[GYRO_BIAS], error_radps, "the bias for which tracks and IMU agree")


def _against_camera(evidence: Evidence) -> _Reading | None:
    intervals = evidence.intervals
    if intervals is None:
        return None
    w_imu = intervals.w_cam_radps @ evidence.sequence.rig.T_imu_cam[:3, :3].T
    source = f"against the camera's rotation over {len(w_imu)} intervals"
    return _median(intervals.w_radps - w_imu, SYSTEMATIC_CAMERA, source)


FAULT = Fault(
    "gyro-bias",
    "a constant gyro bias",
    check,
    after=("mixed-axes", "twist-lag", "time-offset"),
)
