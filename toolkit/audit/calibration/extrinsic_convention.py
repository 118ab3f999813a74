"""An extrinsic whose direction and camera axes its file format leaves open.

The same 4 x 4 matrix can take coordinates from the IMU to the camera or from the camera to the IMU, and the camera's
axes can be x right, y down, z forward (optical) or x forward, y left, z up (regular). Points triangulated in one frame,
moved by the motion samples through each of the four readings and projected into the next frame, have the smallest
residuals under the right one. Medians over each interval are compared, which wrong matches hardly affect. Two readings
under which the camera looks in nearly the same direction, as an extrinsic in regular axes and its inverse, differ in
the position of the camera; the camera's own velocity in turns then decides between them.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.one_step import median_one_step_px, one_step_px_by_interval
from toolkit.audit.parts.robust import Scalar, mean_in_sigmas, slope
from toolkit.geometry import Array, se3, se3_inverse, so3_log
from toolkit.sequence import EXTRINSIC_UNCERTAIN, Sequence

# Least mean difference of the logarithms of two readings' residuals, in its own standard errors. The file allows all
# readings, so the difference only has to be beyond chance (intervals are correlated over about a second).
AGAINST_SECOND = 4.0
# Two readings look the same way if their cameras differ by less than this angle. The noise of the samples, which the
# lever arm turns into motion of the camera, then changes the residuals more than the choice of the reading.
SAME_WAY_RAD = 0.05
# Largest standard error of the share between two readings: two of them reach from either reading to the middle.
LARGEST_ERROR = 0.25
# From optical axes (right, down, forward) to regular ones (forward, left, up).
_T_REGULAR_OPTICAL = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Find which of the four readings of the extrinsic the tracks follow, and take it."""
    sequence = evidence.sequence
    if EXTRINSIC_UNCERTAIN not in sequence.provenance.facts:
        return None
    if evidence.intervals is None:
        return evidence.blind
    readings, camera = _readings(sequence.rig.T_imu_cam), evidence.camera_motion
    misses = {name: one_step_px_by_interval(sequence, camera, T) for name, T in readings.items()}
    logs = {name: np.log(np.maximum(miss, 1e-9)) for name, miss in misses.items()}
    first, *others = sorted(logs, key=lambda name: float(np.mean(logs[name])))
    certainty = {name: mean_in_sigmas(logs[name] - logs[first]) for name in others}
    as_good = [name for name in others if not certainty[name] > AGAINST_SECOND]
    if len(as_good) == len(others):
        return Undecided(f"the tracks fit every reading of the extrinsic equally, best {first} and {as_good[0]}")
    doubt = "".join(f"; {name} explains the motion equally well ({certainty[name]:.1f} sigma)" for name in as_good)
    for name in others:
        same_way = _turned_rad(readings[first], readings[name]) < SAME_WAY_RAD
        if not (same_way or name in as_good):
            continue
        share = _share(evidence.intervals, readings[first], readings[name])
        if share is not None:
            way = f"{share.value:.2f} +- {share.error:.2f} of the way from {first} to {name}"
            doubt += f"; during rotation the camera's velocity is {way}"
            first = name if share.value > 0.5 else first
        elif same_way:
            doubt += (
                f"; {name} has the same orientation, and there is too little rotation to determine the camera's "
                "position"
            )
    each_px = ", ".join(f"{median_one_step_px(sequence, camera, T):.2f} px {name}" for name, T in readings.items())
    return Symptom(
        count=1,
        detail=f"one-step reprojection is {each_px}{doubt}",
        treatment=f"the extrinsic is read {first}",
        remedy=_settled(sequence, readings[first], first),
        harmful=first != next(iter(readings)),
    )


def _readings(T_imu_cam: Array) -> dict[str, Array]:
    """Return T_imu_cam (4, 4), with optical camera axes, in the four readings of the given one, which is the first."""
    inverse = se3_inverse(T_imu_cam)
    return {
        "as given, camera axes optical": T_imu_cam,
        "as given, camera axes regular": T_imu_cam @ _T_REGULAR_OPTICAL,
        "inverted, camera axes optical": inverse,
        "inverted, camera axes regular": inverse @ _T_REGULAR_OPTICAL,
    }


def _share(intervals: Intervals, T_imu_first: Array, T_imu_other: Array) -> Scalar | None:
    """Return where the measured velocity lies between those that two extrinsics predict: 0 is the first, 1 the other.

    Constant differences are removed, because slip of a wheel and an error of the rotation cause them. The measured rate
    of rotation is the instrument: the errors of the camera's rotation and velocity are correlated, and those of the
    gyro are independent of both. None where no velocity is measured, or there is too little rotation.
    """
    if intervals.v_mps is None:
        return None
    one, other = (_velocities(intervals, T) for T in (T_imu_first, T_imu_other))
    in_turns = -np.cross(intervals.w_radps, T_imu_other[:3, 3] - T_imu_first[:3, 3])
    share = slope(*(_centred(values) for values in (in_turns, other - one, intervals.v_mps - one)))
    return share if share.error < LARGEST_ERROR else None


def _velocities(intervals: Intervals, T_imu_cam: Array) -> Array:
    """Return the velocity (M, 3) of the IMU by the camera's own motion and an extrinsic."""
    w_imu = intervals.w_cam_radps @ T_imu_cam[:3, :3].T
    return np.asarray(intervals.v_cam_mps @ T_imu_cam[:3, :3].T - np.cross(w_imu, T_imu_cam[:3, 3]))


def _centred(values: Array) -> Array:
    return np.asarray(values - np.median(values, axis=0))


def _turned_rad(T_imu_first: Array, T_imu_other: Array) -> float:
    return float(np.linalg.norm(so3_log(T_imu_first[:3, :3].T @ T_imu_other[:3, :3])))


def _settled(sequence: Sequence, T_imu_cam: Array, reading: str) -> Sequence:
    """Return the sequence with this extrinsic, and without the fact that its convention is in doubt."""
    facts = (fact for fact in sequence.provenance.facts if fact != EXTRINSIC_UNCERTAIN)
    provenance = replace(sequence.provenance, facts=(*facts, f"the extrinsic is read {reading}"))
    return replace(sequence, rig=replace(sequence.rig, T_imu_cam=T_imu_cam), provenance=provenance)


FAULT = Fault(
    "extrinsic-convention",
    "an extrinsic whose direction and camera axes the file's format leaves open",
    check,
    after=("stale-frames", "doubled-disparity", "no-disparity", "time-gap", "intrinsics", "units"),
)
