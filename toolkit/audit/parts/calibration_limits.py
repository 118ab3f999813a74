"""What of a calibration found from tracks beside an IMU is wrong beyond chance and sound recordings, in words.

Where the camera is belongs to `lever_arm`.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.bundle import BASELINE, CENTRE, FOCAL, LATE, TURN
from toolkit.audit.parts.self_calibration import SelfCalibration
from toolkit.sequence import StereoRig

# What is beyond so many standard errors and what sound recordings have counts. On 80 parts of real recordings beside an
# IMU, 4 s to whole, four standard errors leave 0.6 % of the focal lengths, 2.4 px of cy (kitti00), 0.003 rad, 0.2 ms
# and nothing of the rest. Chosen with them in view, about twice that.
SIGMAS = 4.0
SYSTEMATIC_FOCAL, SYSTEMATIC_CENTRE_PX, SYSTEMATIC_BASELINE = 0.012, np.array([2.0, 5.0]), 0.015
SYSTEMATIC_TURN_RAD, SYSTEMATIC_LATE_S = 0.006, 0.0008
# Where more than this of the focal length (a share), the principal point (px) or a turn (rad) would hide, it is said.
HIDDEN_FOCAL, HIDDEN_CENTRE_PX, HIDDEN_TURN_RAD = 0.08, 25.0, 0.05


class Wrong(NamedTuple):
    """One thing that is wrong: what is said of it, and what to check."""

    said: str
    check: str


def wrong(found: SelfCalibration, rig: StereoRig) -> list[Wrong]:
    """Name what is wrong of the rig by which the calibration was begun."""
    return [*_intrinsics(found, rig), *_baseline(found), *_turn(found), *_clock(found)]


def hidden(found: SelfCalibration) -> str | None:
    """Say how large faults of the intrinsics and of where the camera looks would not show, where that is much."""
    focal = SYSTEMATIC_FOCAL + SIGMAS * found.error[FOCAL]
    centre_px = SYSTEMATIC_CENTRE_PX + SIGMAS * found.error[CENTRE]
    parts = [
        f"{name} off by {share:.0%}" for name, share in zip(("fx", "fy"), focal, strict=True) if share > HIDDEN_FOCAL
    ]
    of_centre = zip(("cx", "cy"), centre_px, strict=True)
    parts += [f"{name} off by {off_px:.0f} px" for name, off_px in of_centre if off_px > HIDDEN_CENTRE_PX]
    turn_rad = SYSTEMATIC_TURN_RAD + SIGMAS * float(found.error[TURN].max())
    parts += [f"a camera turned by {turn_rad:.2f} rad"] if turn_rad > HIDDEN_TURN_RAD else []
    return f"too little rotation: {', '.join(parts)} would not show" if parts else None


def _intrinsics(found: SelfCalibration, rig: StereoRig) -> list[Wrong]:
    value, error, told = found.value, found.error, list[Wrong]()
    given_px = np.array([rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px])
    off = np.abs(value[:4]) > np.append(np.full(2, SYSTEMATIC_FOCAL), SYSTEMATIC_CENTRE_PX) + SIGMAS * error[:4]
    fit_px = np.append(given_px[:2] * np.exp(value[FOCAL]), given_px[2:] + value[CENTRE])
    error_px = np.append(fit_px[:2] * error[FOCAL], error[CENTRE])
    for k in np.flatnonzero(off).tolist():
        name = ("fx_px", "fy_px", "cx_px", "cy_px")[k]
        said = f"tracks and IMU fit {name} = {fit_px[k]:.1f} +- {error_px[k]:.1f}, not {given_px[k]:g}"
        told.append(Wrong(said, "K"))
    return told


def _baseline(found: SelfCalibration) -> list[Wrong]:
    share, error = found.value[BASELINE], found.error[BASELINE]
    if abs(share) < SYSTEMATIC_BASELINE + SIGMAS * error:
        return []
    factor = float(np.exp(share))
    return [Wrong(f"a baseline {factor:.3f} +- {factor * error:.3f} times the given one fits", "the baseline")]


def _turn(found: SelfCalibration) -> list[Wrong]:
    turn, error = found.value[TURN], found.error[TURN]
    if not (np.abs(turn) > SYSTEMATIC_TURN_RAD + SIGMAS * error).any():
        return []
    told = ", ".join(f"{t:+.3f} +- {e:.3f}" for t, e in zip(turn, error, strict=True))
    said = f"the camera moves as if it were turned by ({told}) rad about its own x, y, z against T_imu_cam"
    return [Wrong(said, "the rotation of T_imu_cam")]


def _clock(found: SelfCalibration) -> list[Wrong]:
    late_s, error_s = found.value[LATE], found.error[LATE]
    if abs(late_s) < SYSTEMATIC_LATE_S + SIGMAS * error_s:
        return []
    stamped = "early" if late_s > 0.0 else "late"
    said = f"frames are stamped {1e3 * abs(late_s):.1f} +- {1e3 * error_s:.1f} ms too {stamped}"
    return [Wrong(said, "the clocks of the camera and the IMU")]
