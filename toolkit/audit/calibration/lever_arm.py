"""A camera at another position than the extrinsic says, or velocities of another point of the vehicle.

In a turn of rate w, a camera whose position is wrong by p moves by w x p more than expected, so that residuals appear
in turns only. The data do not show which of the two is wrong. With an IMU the self-calibration, which follows points
over seconds, is used where it finds a calibration near the given one. The regression of `parts.alignment` over a few
seconds has errors that last as long as these and that its standard errors do not contain.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.bundle import LEVER
from toolkit.audit.parts.calibration_limits import LIMITS
from toolkit.audit.parts.extrinsic import MOST_SIGMAS, is_there, metres, share_of_way
from toolkit.audit.parts.self_calibration import OFF_BY
from toolkit.geometry import Array, BoolArray

# Limits of an axis: so many standard errors (by the self-calibration, as many as for its other unknowns) beyond what
# sound recordings at hand have (m). The velocities of cars are those of another point, or slip: 0.43 to 0.85 m along x
# in all seven. With IMUs the regression is off by 0.06 m at most, a self-calibration by nothing.
SIGMAS, SYSTEMATIC_M, SYSTEMATIC_FITTED_M = 5.0, {"twist": 0.6, "imu": 0.05}, 0.015
# An axis along which the standard error of the position is larger than this (m) is not judged.
LARGEST_ERROR_M = 0.25
# Where only a camera farther off than this (m) would be found, the finding is undecided and says so.
HIDDEN_M = {"twist": 1.2, "imu": 0.5}
# The prior of the self-calibration is removed again, by the share of the information that comes from the data; the
# share is no less than this.
LEAST_BY_DATA = 1e-3
# A position that a mistake in the file explains must be so far (m) from the given one. The second number (m) is the
# systematic error that is added to the standard errors.
LEAST_APART_M, SLIP_M = 0.05, 0.02


class _Place(NamedTuple):
    """Correction of the camera's position in the IMU frame, its standard errors, and its limits, (3,) m each.

    ``slip`` names the mistake in writing the file that explains the correction, if there is one.
    """

    lacking_m: Array
    error_m: Array
    least_m: Array
    slip: str = ""


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Report the axes along which the camera is not at the position of the extrinsic."""
    if evidence.intervals is None:
        return evidence.blind
    found, kind = _place(evidence), evidence.sequence.motion_kind
    if found is None or not (decidable := found.error_m < LARGEST_ERROR_M).any():
        errors = "" if found is None else f" to {', '.join(f'{error:.1f}' for error in found.error_m)} m"
        return Undecided(f"too little rotation: the camera's position along x, y and z is not known{errors}")
    off = decidable & (np.abs(found.lacking_m) > found.least_m)
    if not off.any() and not found.slip:
        return _hidden(found, decidable, HIDDEN_M[kind])
    axes = np.flatnonzero(off if off.any() else decidable).tolist()
    axes_m = [f"{found.lacking_m[k]:+.2f} +- {found.error_m[k]:.2f} m along {'xyz'[k]}" for k in axes]
    other_point = "" if kind == "imu" else ", and which point of the vehicle the velocities are of"
    given = metres(evidence.sequence.rig.T_imu_cam[:3, 3])
    return Symptom.warning(
        count=len(axes),
        detail=(
            f"residuals are correlated with rotation: the camera is off by {', '.join(axes_m)} from {given}, its "
            f"position in T_imu_cam{found.slip}"
        ),
        treatment=f"check the translation of T_imu_cam{other_point}",
    )


def _hidden(found: _Place, decidable: BoolArray, most_m: float) -> Undecided | None:
    """Return how far off the camera could be along the judged axes without being found, where that is far."""
    far = np.flatnonzero(decidable & (found.least_m > most_m)).tolist()
    if not far:
        return None
    parts = ", ".join(f"{found.least_m[k]:.1f} m along {'xyz'[k]}" for k in far)
    return Undecided(f"too little rotation: a camera that is off by less than {parts} would not show")


def _place(evidence: Evidence) -> _Place | None:
    """Return the position by the self-calibration or, where there is none, by the regression."""
    fitted, regressed = evidence.self_calibration, evidence.alignment
    if fitted is not None:
        by_data = np.maximum(1.0 - (fitted.error[LEVER] / OFF_BY[LEVER]) ** 2, LEAST_BY_DATA)
        error_m = fitted.error[LEVER] / np.sqrt(by_data)
        slip = _slip(fitted.value[LEVER], fitted.cov[LEVER, LEVER], evidence.sequence.rig.T_imu_cam)
        return _Place(
            fitted.value[LEVER] / by_data, error_m, SYSTEMATIC_FITTED_M + LIMITS["imu"].sigmas * error_m, slip
        )
    if regressed is None:
        return None
    least_m = SYSTEMATIC_M[evidence.sequence.motion_kind] + SIGMAS * regressed.lever_error_m
    return _Place(regressed.lever_m, regressed.lever_error_m, least_m)


def _slip(lacking_m: Array, cov_m2: Array, T_imu_cam: Array) -> str:
    """Return in words the mistake in the translation that puts the camera where it was found; empty if none does."""
    given = T_imu_cam[:3, 3]
    meant = {"its sign were changed": -given, "it were that of the inverse": -T_imu_cam[:3, :3].T @ given}
    likely = {how: place for how, place in meant.items() if _explains(place - given, lacking_m, cov_m2)}
    if not likely:
        return ""
    how, place = min(likely.items(), key=lambda one: float(np.linalg.norm(one[1] - given - lacking_m)))
    return f", as if {how}: {metres(place)}"


def _explains(way_m: Array, lacking_m: Array, cov_m2: Array) -> bool:
    """Say whether the camera is at the end of a vector (3,) m from the given position, and not beside the vector."""
    if float(np.linalg.norm(way_m)) < LEAST_APART_M:
        return False
    cov_m2 = cov_m2 + SLIP_M**2 * np.eye(3)
    share = share_of_way(lacking_m, cov_m2, way_m)
    beside = lacking_m - share.value * way_m
    return is_there(share) and float(beside @ np.linalg.solve(cov_m2, beside)) <= MOST_SIGMAS**2


FAULT = Fault(
    "lever-arm",
    "a position of the camera that differs from the extrinsic's, as residuals during rotation show",
    check,
    after=("accelerometer-axes", "disagreement"),
)
