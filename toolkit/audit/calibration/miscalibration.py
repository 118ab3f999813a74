"""Small errors of the calibration: the rotation of the camera, a focal length, the principal point, a sensor's scale.

They are too small to show in single frames and large enough to bend every trajectory. From frame to frame, a camera
rotated by an angle cannot be distinguished from a principal point that is off by the focal length times that angle.
Points followed over a second distinguish most of the errors (`parts.self_calibration`). With odometry, whose slip lasts
as long, the rotation estimated from frame to frame is judged as well.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.calibration_limits import BESIDE, Wrong, doubtful, hidden, wrong
from toolkit.audit.parts.extrinsic import SYSTEMATIC_RAD, angle_of, turn_by_rotations, turn_by_velocities
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.ratios import MOST_FORCE_RATIO, MOST_RATIO, force_ratio, rotation_ratio
from toolkit.audit.parts.robust import Scalar
from toolkit.audit.parts.self_calibration import SelfCalibration, self_calibration
from toolkit.measured_motion import MotionKind
from toolkit.sequence import StereoRig

SIGMAS = 5.0
# Limits of the ratios of specific force to gravity and of the gyro's rates to the camera's, beyond five standard
# errors. The noise of the camera's rates lowers the second ratio, so only values above one count. Of 699 parts of sound
# recordings, two beside odometry exceed one by 0.011 at most beyond five standard errors, and none beside an IMU
# exceeds it. Chosen with them in view.
SYSTEMATIC_FORCE, SYSTEMATIC_RATE = 0.05, {"twist": 0.025, "imu": 0.01}
# Where only a rotation (rad) larger than this would be found, the finding is undecided and says so.
LARGEST_RAD = 0.05


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Report the errors that the self-calibration, the direction of the motion, or ratios of rates and forces show."""
    intervals = evidence.intervals
    if intervals is None:
        return evidence.blind
    calibration = _calibration(evidence, intervals)
    wrongs, rotation = list(calibration.wrongs), rotation_ratio(intervals)
    if 1.0 < rotation.value < MOST_RATIO and _is_off(rotation, SYSTEMATIC_RATE[evidence.sequence.motion_kind]):
        summary = f"the gyro turns {rotation.value:.3f} +- {rotation.error:.3f} times as fast as the camera"
        wrongs.append(Wrong(summary, "the scale of the gyro and the focal length"))
    force = force_ratio(evidence.sequence)
    if (
        force is not None
        and 1.0 / MOST_FORCE_RATIO < force.value < MOST_FORCE_RATIO
        and _is_off(force, SYSTEMATIC_FORCE)
    ):
        summary = f"the accelerometer reads {force.value:.3f} +- {force.error:.3f} times gravity (median)"
        wrongs.append(Wrong(summary, "the scale and the bias of the accelerometer"))
    if not wrongs:
        return None if calibration.hidden is None else Undecided(calibration.hidden)
    return Symptom.warning(
        count=len(wrongs),
        detail="; ".join(one.summary for one in wrongs),
        treatment=f"check {', '.join(dict.fromkeys(one.check for one in wrongs))}",
    )


class _Calibration(NamedTuple):
    """What is wrong, and in words which errors would not be found (None where these are small)."""

    wrongs: list[Wrong]
    hidden: str | None


def _calibration(evidence: Evidence, intervals: Intervals) -> _Calibration:
    """Judge by the self-calibration; with odometry, and where there is none, also by the motion from frame to frame."""
    sequence = evidence.sequence
    kind, found = sequence.motion_kind, evidence.self_calibration
    if kind == "twist":
        found = self_calibration(sequence, evidence.camera_motion, intervals)
    fitted = _fitted(found, sequence.rig, kind)
    if found is not None and kind == "imu":
        return fitted
    looks = _by_turn(evidence, intervals)
    unseen = [one for one in (looks.hidden, fitted.hidden) if one is not None]
    return _Calibration(fitted.wrongs or looks.wrongs, "; ".join(unseen) or None)


def _fitted(found: SelfCalibration | None, rig: StereoRig, kind: MotionKind) -> _Calibration:
    if found is not None:
        doubt = doubtful(found, rig, kind) if kind == "imu" else None  # with odometry `steady_difference` reports it
        return _Calibration(wrong(found, rig, kind), "; ".join(filter(None, (doubt, hidden(found, kind)))) or None)
    unseen = f"no tracks are long enough to be compared with the {BESIDE[kind]}"
    return _Calibration([], f"the intrinsics: {unseen}, or no calibration near the given one fits them")


def _by_turn(evidence: Evidence, intervals: Intervals) -> _Calibration:
    """Judge the rotation of the camera by the motion from frame to frame, which does not determine the intrinsics."""
    rig, kind = evidence.sequence.rig, evidence.sequence.motion_kind
    whole = None if evidence.alignment is None else evidence.alignment.by_velocities
    turn = turn_by_rotations(intervals, rig.T_imu_cam) if whole is None else turn_by_velocities(whole)
    least_rad = SYSTEMATIC_RAD[kind] + turn.by_chance_rad
    if not (np.abs(turn.rad) > least_rad).any():
        return _Calibration([], _undecided(float(least_rad.min()), kind == "twist"))
    angle, error = angle_of(turn)
    summary = (
        f"the camera moves as if it were turned by {angle:.3f} +- {error:.3f} rad against "
        f"T_imu_cam, or its principal point were {angle * rig.fx_px:.0f} px off"
    )
    return _Calibration([Wrong(summary, "the extrinsic and the principal point")], None)


def _undecided(least_rad: float, by_velocity: bool) -> str | None:
    if least_rad < LARGEST_RAD:
        return None
    cause = "wheel slip that lasts for seconds is as large" if by_velocity else "too little change of rotation"
    hidden = (
        "any rotation of it" if not np.isfinite(least_rad) else f"a rotation of it by less than {least_rad:.2f} rad"
    )
    return f"the camera's orientation: {hidden} would not show, for {cause}"


def _is_off(ratio: Scalar, systematic: float) -> bool:
    return abs(ratio.value - 1.0) > SIGMAS * ratio.error + systematic


FAULT = Fault(
    "miscalibration",
    "a camera rotated slightly against its extrinsic, or a slight error of scale",
    check,
    after=("accelerometer-axes", "disagreement"),
)
