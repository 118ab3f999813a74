"""A camera that stands elsewhere on the vehicle than the extrinsic says, or velocities of another point of it.

In a turn of rate w a camera that is off by p moves by w x p against what is expected of it: residuals that come and go
with the turns. Neither source tells which is wrong. Beside an IMU the points that are followed for a second show it
better, where a calibration near the given one fits them: what a regression of a few seconds errs by lasts as long.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.bundle import LEVER
from toolkit.audit.parts.calibration_limits import SIGMAS as FITTED_SIGMAS
from toolkit.audit.parts.self_calibration import OFF_BY
from toolkit.geometry import Array

# Each axis counts from so many standard errors on (by the self-calibration, as many as all that it finds), beyond what
# sound recordings at hand have (m). The velocities of cars are those of another point, or slip: 0.43 to 0.85 m along x
# in all of seven; beside IMUs it is 0.06 m at most.
SIGMAS, SYSTEMATIC_M = 5.0, {"twist": 0.6, "imu": 0.05}
# An axis about which the position is known worse than this (m) is not judged.
LARGEST_ERROR_M = 0.25
# The prior of the self-calibration is taken off again: by the share of what is known that the data tell, or this.
LEAST_BY_DATA = 1e-3


class _Place(NamedTuple):
    """What the camera's position in the IMU frame lacks (3,) m, its standard errors (3,) m, and how many count."""

    lacking_m: Array
    error_m: Array
    sigmas: float


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Name the axes along which the camera is not where the extrinsic has it."""
    if evidence.intervals is None:
        return evidence.blind
    found, kind = _place(evidence), evidence.sequence.motion_kind
    if found is None or not (judged := found.error_m < LARGEST_ERROR_M).any():
        errors = "" if found is None else f" to {', '.join(f'{error:.1f}' for error in found.error_m)} m"
        return Undecided(f"too little rotation: where the camera is along x, y and z is not known{errors}")
    off = judged & (np.abs(found.lacking_m) > SYSTEMATIC_M[kind] + found.sigmas * found.error_m)
    if not off.any():
        return None
    axes = np.flatnonzero(off).tolist()
    told = [f"{found.lacking_m[k]:+.2f} +- {found.error_m[k]:.2f} m along {'xyz'[k]}" for k in axes]
    other_point = "" if kind == "imu" else ", and which point of the vehicle the velocities are of"
    return Symptom(
        count=len(axes),
        detail=f"residuals turn with the vehicle: the camera is off by {', '.join(told)} from where T_imu_cam has it",
        treatment=f"check the translation of T_imu_cam{other_point}",
        remedy=None,
        harmful=False,
        warns=True,
    )


def _place(evidence: Evidence) -> _Place | None:
    """Return the place by the self-calibration or, where there is none, by the regression."""
    fitted, regressed = evidence.self_calibration, evidence.alignment
    if fitted is not None:
        by_data = np.maximum(1.0 - (fitted.error[LEVER] / OFF_BY[LEVER]) ** 2, LEAST_BY_DATA)
        return _Place(fitted.value[LEVER] / by_data, fitted.error[LEVER] / np.sqrt(by_data), FITTED_SIGMAS)
    return None if regressed is None else _Place(regressed.lever_m, regressed.lever_error_m, SIGMAS)


FAULT = Fault(
    "lever-arm",
    "a camera that stands elsewhere than the extrinsic says, as its turns show",
    check,
    after=("accelerometer-axes", "disagreement"),
)
