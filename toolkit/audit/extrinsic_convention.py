"""An extrinsic of a format that does not settle its direction, nor the axes of its camera.

The same four by four numbers can take the IMU to the camera or the camera to the IMU, and the camera's axes can be
x right, y down, z forward (optical) or x forward, y left, z up (regular). Points triangulated in one frame, moved
by the motion samples through each of the four and projected into the next, miss the tracks the least through the right
one. The intervals' medians decide, which wrong matches do not reach.
"""

import math
from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import median_one_step_px, one_step_px_by_interval
from toolkit.geometry import Array, se3, se3_inverse
from toolkit.sequence import EXTRINSIC_IN_DOUBT, Sequence

# Mean difference of the logarithms of two readings' residuals, in its own standard errors: between readings that a
# file allows alike it needs to be beyond chance only (intervals are correlated over about a second).
AGAINST_SECOND = 4.0
# Optical axes (right, down, forward) in regular ones (forward, left, up).
_T_REGULAR_OPTICAL = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Find which of the four readings of the extrinsic the tracks follow, and take it."""
    sequence = evidence.sequence
    if EXTRINSIC_IN_DOUBT not in sequence.provenance.facts:
        return None
    if evidence.intervals is None:
        return evidence.blind
    readings, camera = _readings(sequence.rig.T_imu_cam), evidence.camera_motion
    misses = {name: one_step_px_by_interval(sequence, camera, T) for name, T in readings.items()}
    logs = {name: np.log(np.maximum(miss, 1e-9)) for name, miss in misses.items()}
    first, *others = sorted(logs, key=lambda name: float(np.mean(logs[name])))
    certainty = {name: _sigmas(logs[name] - logs[first]) for name in others}
    as_good = [name for name in others if not certainty[name] > AGAINST_SECOND]
    if len(as_good) == len(others):
        return Undecided(f"the tracks follow every reading of the extrinsic alike, {first} and {as_good[0]} the best")
    doubt = "".join(f"; it explains the motion as well {name} ({certainty[name]:.1f} sigma)" for name in as_good)
    each_px = ", ".join(f"{median_one_step_px(sequence, camera, T):.2f} px {name}" for name, T in readings.items())
    return Symptom(
        count=1,
        detail=f"one-step reprojection is {each_px}{doubt}",
        treatment=f"the extrinsic is taken {first}",
        remedy=_settled(sequence, readings[first], first),
        harmful=first != next(iter(readings)),
    )


def _readings(T_imu_cam: Array) -> dict[str, Array]:
    """Return T_imu_cam (4, 4), of optical axes, in the four readings of the one given; that itself is the first."""
    inverse = se3_inverse(T_imu_cam)
    return {
        "as given, camera axes optical": T_imu_cam,
        "as given, camera axes regular": T_imu_cam @ _T_REGULAR_OPTICAL,
        "inverted, camera axes optical": inverse,
        "inverted, camera axes regular": inverse @ _T_REGULAR_OPTICAL,
    }


def _settled(sequence: Sequence, T_imu_cam: Array, reading: str) -> Sequence:
    """Return the sequence with this extrinsic, which is in no doubt any more."""
    facts = (fact for fact in sequence.provenance.facts if fact != EXTRINSIC_IN_DOUBT)
    provenance = replace(sequence.provenance, facts=(*facts, f"the extrinsic is taken {reading}"))
    return replace(sequence, rig=replace(sequence.rig, T_imu_cam=T_imu_cam), provenance=provenance)


def _sigmas(difference: Array) -> float:
    """Return the mean of differences (M,) in standard errors of that mean."""
    error = float(np.std(difference)) / math.sqrt(difference.size)
    return float(np.mean(difference)) / max(error, 1e-12)


FAULT = Fault(
    "extrinsic-convention",
    "an extrinsic whose direction and camera axes the file's format leaves open",
    check,
    after=("stale-frames", "doubled-disparity", "no-disparity", "time-gap", "intrinsics", "units"),
)
