"""Decides which results of a self-calibration are beyond chance and beyond sound recordings, and describes them.

The position of the camera is judged by `lever_arm`. With odometry, whose scale is known no better than vision's, the
baseline is judged by `vision_scale` and the clock by `time_offset`.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.bundle import BASELINE, CENTRE, FOCAL, LATE, TURN
from toolkit.audit.parts.self_calibration import RIGHT, RIGHT_SIGMAS, SelfCalibration
from toolkit.geometry import Array
from toolkit.measured_motion import MotionKind
from toolkit.sequence import StereoRig


class Limits(NamedTuple):
    """Limits in standard errors, limits of sound recordings, and sizes of undetected errors that are reported.

    They are a share of a focal length, px of cx and cy, a rotation in rad, a share of the baseline, s of the clock, px
    and rad of the right image. An infinite limit means that the quantity is not judged. Where an error larger than a
    ``hidden`` limit would go undetected, that is reported.
    """

    sigmas: float
    focal: float
    centre_px: tuple[float, float]
    turn_rad: float
    baseline: float
    late_s: float
    right_shift_px: float
    right_roll_rad: float
    hidden_focal: float
    hidden_centre_px: float
    hidden_turn_rad: float
    hidden_right_shift_px: float
    hidden_right_roll_rad: float


# With an IMU, 80 parts of real recordings (4 s to the whole) exceed four standard errors by at most 0.6 % of the focal
# lengths, 2.4 px of cy (kitti00), 0.003 rad and 0.2 ms, and by nothing in the other quantities. With odometry, parts of
# eleven recordings (8 s to the whole) exceed six standard errors by at most 3.4 % of fx, 3.0 px of cx, 0.3 px of cy and
# 0.025 rad, because tracks drift from image to image and twists contain slip. The limits were chosen with these in
# view, at about twice that and more for cy. With an IMU, undetected errors are reported from the size on that makes
# errors of estimators three times as large: 2 % of a focal length (8 to 11 times on `flight`), 1 degree of rotation
# (3.4 times on `drive-imu`). With odometry, `miscalibration` reports undetected rotations of the camera, by the
# velocities from frame to frame. The right image of 141 parts with an IMU exceeds four standard errors only by a roll,
# 0.0015 and 0.0018 rad on two parts of kitti00 (0.0007 rad beyond); that of 75 parts with odometry does not exceed six.
# With an IMU, the limit of the roll is three times that. The limit of the shift is half of a tenth of a pixel; a tenth
# makes the errors of estimators three times as large, as a roll of 0.005 rad does. An undetected shift is reported from
# half a pixel on, which makes them 9 to 27 times as large, because only long recordings determine less.
LIMITS: dict[MotionKind, Limits] = {
    "imu": Limits(
        RIGHT_SIGMAS["imu"], 0.012, (2.0, 5.0), 0.006, 0.015, 0.0008, 0.05, 0.002, 0.02, 10.0, 0.02, 0.5, 0.01
    ),
    "twist": Limits(
        RIGHT_SIGMAS["twist"], 0.06, (8.0, 12.0), 0.06, np.inf, np.inf, 0.3, 0.003, 0.16, np.inf, np.inf, 1.5, 0.02
    ),
}
BESIDE = {"imu": "IMU", "twist": "odometry"}


class Wrong(NamedTuple):
    """One wrong part: the message, and what to check."""

    summary: str
    check: str


def wrong(found: SelfCalibration, rig: StereoRig, kind: MotionKind) -> list[Wrong]:
    """Return the wrong parts of the rig from which the self-calibration started."""
    limits = LIMITS[kind]
    return [
        *_intrinsics(found, rig, limits, BESIDE[kind]),
        *_baseline(found, limits),
        *_turn(found, limits),
        *_clock(found, limits),
        *_right_image(found, limits),
    ]


def doubtful(found: SelfCalibration, rig: StereoRig, kind: MotionKind) -> str | None:
    """Say which parts are wrong by more than chance but no more than in sound recordings."""
    nothing = {"right_shift_px": 0.0, "right_roll_rad": 0.0}
    by_chance = LIMITS[kind]._replace(focal=0.0, centre_px=(0.0, 0.0), turn_rad=0.0, **nothing)
    of_rig, of_right = _intrinsics(found, rig, by_chance, BESIDE[kind]), _right_image(found, by_chance)
    differences = [*of_rig, *_turn(found, by_chance), *of_right]
    if not differences:
        return None
    summary = "; ".join(one.summary for one in differences)
    return f"{summary}: that is more than chance and no more than in recordings without faults"


def hidden(found: SelfCalibration, kind: MotionKind) -> str | None:
    """Describe which errors of the intrinsics and the camera's rotation would go undetected, if they are large."""
    limits = LIMITS[kind]
    focal = limits.focal + limits.sigmas * found.error[FOCAL]
    centre_px = np.array(limits.centre_px) + limits.sigmas * found.error[CENTRE]
    of_focal = zip(("fx", "fy"), focal, strict=True)
    parts = [f"{name} off by {share:.0%}" for name, share in of_focal if share > limits.hidden_focal]
    of_centre = zip(("cx", "cy"), centre_px, strict=True)
    parts += [f"{name} off by {off_px:.0f} px" for name, off_px in of_centre if off_px > limits.hidden_centre_px]
    turn_rad = limits.turn_rad + limits.sigmas * float(found.error[TURN].max())
    parts += [f"a camera turned by {turn_rad:.2f} rad"] if turn_rad > limits.hidden_turn_rad else []
    right = _hidden_right(found, limits)
    undetected = [f"too little rotation: {', '.join(parts)} would not show"] if parts else []
    undetected += [f"too little motion sideways to near points: {' and '.join(right)} would not show"] if right else []
    return "; ".join(undetected) or None


def _hidden_right(found: SelfCalibration, limits: Limits) -> list[str]:
    shift_px, roll_rad = np.array([limits.right_shift_px, limits.right_roll_rad]) + limits.sigmas * found.error[RIGHT]
    parts = [f"a right image shifted by {shift_px:.1f} px"] if shift_px > limits.hidden_right_shift_px else []
    return parts + ([f"a right image rolled by {roll_rad:.3f} rad"] if roll_rad > limits.hidden_right_roll_rad else [])


def hidden_baseline(found: SelfCalibration, kind: MotionKind) -> float:
    """Return the least relative error of the baseline that is detected in either direction."""
    limits = LIMITS[kind]
    return float(limits.baseline + limits.sigmas * found.error[BASELINE] + abs(found.value[BASELINE]))


def _intrinsics(found: SelfCalibration, rig: StereoRig, limits: Limits, beside: str) -> list[Wrong]:
    value, wrongs = found.value, list[Wrong]()
    given_px = np.array([rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px])
    least = np.array([limits.focal, limits.focal, *limits.centre_px])
    off, error = np.abs(value[:4]) > least + limits.sigmas * found.error[:4], _with_systematic(found.error[:4], least)
    fit_px = np.append(given_px[:2] * np.exp(value[FOCAL]), given_px[2:] + value[CENTRE])
    error_px = np.append(fit_px[:2] * error[FOCAL], error[CENTRE])
    for k in np.flatnonzero(off).tolist():
        name = ("fx_px", "fy_px", "cx_px", "cy_px")[k]
        summary = f"tracks and {beside} fit {name} = {fit_px[k]:.1f} +- {error_px[k]:.1f}, not {given_px[k]:g}"
        wrongs.append(Wrong(summary, "K"))
    return wrongs


def _baseline(found: SelfCalibration, limits: Limits) -> list[Wrong]:
    share, error = found.value[BASELINE], found.error[BASELINE]
    if abs(share) < limits.baseline + limits.sigmas * error:
        return []
    factor = float(np.exp(share))
    summary = f"a baseline {factor:.3f} +- {factor * error:.3f} times the given one fits"
    # A shift of an image has the same effect on far points.
    return [Wrong(summary, "the baseline, the rectification of the pair")]


def _turn(found: SelfCalibration, limits: Limits) -> list[Wrong]:
    turn, error = found.value[TURN], found.error[TURN]
    if not (np.abs(turn) > limits.turn_rad + limits.sigmas * error).any():
        return []
    error = _with_systematic(error, limits.turn_rad)
    wrongs = ", ".join(f"{t:+.3f} +- {e:.3f}" for t, e in zip(turn, error, strict=True))
    summary = f"the camera moves as if it were turned by ({wrongs}) rad about its own x, y, z against T_imu_cam"
    return [Wrong(summary, "the rotation of T_imu_cam")]


def _clock(found: SelfCalibration, limits: Limits) -> list[Wrong]:
    late_s, error_s = found.value[LATE], found.error[LATE]
    if abs(late_s) < limits.late_s + limits.sigmas * error_s:
        return []
    stamped = "early" if late_s > 0.0 else "late"
    summary = f"frames are stamped {1e3 * abs(late_s):.1f} +- {1e3 * error_s:.1f} ms too {stamped}"
    return [Wrong(summary, "the clocks of the camera and the IMU")]


def _right_image(found: SelfCalibration, limits: Limits) -> list[Wrong]:
    value, least = found.value[RIGHT], np.array([limits.right_shift_px, limits.right_roll_rad])
    off, error = np.abs(value) > least + limits.sigmas * found.error[RIGHT], _with_systematic(found.error[RIGHT], least)
    summaries = (
        f"the right image's columns are {value[0]:+.2f} +- {error[0]:.2f} px off",
        f"the right camera looks rolled about its optical axis by {value[1]:+.4f} +- {error[1]:.4f} rad",
    )
    return [Wrong(summaries[k], "the rectification of the pair") for k in np.flatnonzero(off).tolist()]


def _with_systematic(error: Array, limit: Array | float) -> Array:
    """Return standard errors that include the largest error of sound recordings, half of the limits."""
    return np.hypot(error, 0.5 * np.asarray(limit))
