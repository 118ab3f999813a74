"""A calibration that is nearly right: the camera turned in its mount, a principal point or a scale a little off.

Too little to be told from noise in single frames, and enough to bend every trajectory. What is wrong the recording does
not say: a camera turned by an angle and a principal point off by the focal length times that angle look the same.
"""

import numpy as np

from toolkit.audit.disagreement import MOST_FORCE_RATIO, MOST_RATIO
from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.robust import Scalar
from toolkit.audit.parts.turn import turn_of_camera
from toolkit.audit.parts.units import force_ratio, rotation_ratio

SIGMAS = 5.0
# What sound recordings at hand have beyond their standard errors: turns (rad) by velocities, for cars slip and pitch,
# and by rotations. Chosen with them in view.
SYSTEMATIC_RAD = {"twist": 0.018, "imu": 0.01}
SYSTEMATIC_RATIO = 0.05
# Where a turn must be larger than this to be seen, it is said.
LARGEST_RAD = 0.05


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare directions and sizes of the camera's motion with the measured ones."""
    intervals, rig = evidence.intervals, evidence.sequence.rig
    if intervals is None:
        return evidence.blind
    said, checks, turn = list[str](), list[str](), turn_of_camera(intervals, rig.T_imu_cam, evidence.known_s)
    least_rad = SYSTEMATIC_RAD[evidence.sequence.motion_kind] + turn.by_chance_rad
    if (np.abs(turn.rad) > least_rad).any():
        angle = float(np.linalg.norm(turn.rad))
        said.append(
            f"the camera moves as if it were turned by {angle:.3f} +- {np.linalg.norm(turn.error_rad):.3f} rad against "
            f"T_imu_cam, or its principal point were {angle * rig.fx_px:.0f} px off"
        )
        checks.append("the extrinsic and the principal point")
    rotation = rotation_ratio(intervals)
    if 1.0 < rotation.value < MOST_RATIO and _is_off(rotation):
        said.append(f"the gyro turns {rotation.value:.3f} +- {rotation.error:.3f} times as fast as the camera")
        checks.append("the scale of the gyro and the focal length")
    force = force_ratio(evidence.sequence)
    if force is not None and 1.0 / MOST_FORCE_RATIO < force.value < MOST_FORCE_RATIO and _is_off(force):
        said.append(f"the accelerometer reads {force.value:.3f} +- {force.error:.3f} times gravity (median)")
        checks.append("the scale and the bias of the accelerometer")
    if not said:
        return _undecided(float(least_rad.min()), intervals.v_mps is not None)
    return Symptom(
        count=len(said),
        detail="; ".join(said),
        treatment=f"check {', '.join(checks)}",
        remedy=None,
        harmful=False,
        warns=True,
    )


def _undecided(least_rad: float, by_velocity: bool) -> Undecided | None:
    if least_rad < LARGEST_RAD:
        return None
    cause = "what odometry slips by for seconds is no less" if by_velocity else "too little change of rotation"
    hidden = "any turn of it" if not np.isfinite(least_rad) else f"a turn of it by less than {least_rad:.2f} rad"
    return Undecided(f"where the camera looks: {hidden} would not show, for {cause}")


def _is_off(ratio: Scalar) -> bool:
    return abs(ratio.value - 1.0) > SIGMAS * ratio.error + SYSTEMATIC_RATIO


FAULT = Fault(
    "miscalibration",
    "a camera turned a little against its extrinsic, or a scale that is a little off",
    check,
    after=("accelerometer-axes", "disagreement"),
)
