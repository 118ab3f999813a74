"""An axis of the gyro whose rates are larger or smaller than the camera's: a channel with a wrong scale.

Noise of the camera's rates makes the slope of the gyro's rates on the camera's too small. Noise of the gyro's rates
makes the inverse of the slope of the camera's rates on the gyro's too large. The scale lies between the two (Frisch,
"Statistical confluence analysis", 1934). Where both are above 1, or both below, noise does not explain it.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import Scalar, slope
from toolkit.geometry import Array
from toolkit.jackknife import jackknife_error

# A scale is reported beyond so many standard errors, by a jackknife, and this share. Beyond five standard errors,
# tracks that drift cause 2.3 % for one axis of kitti00, 1.6 % in 8 s of a drive, and nothing in twenty other sound
# recordings. Chosen with them in view.
SIGMAS, SYSTEMATIC = 5.0, 0.05
# An axis is judged only if the lower bound is more than this share of the upper one; otherwise there is too little
# rotation about it.
LEAST_IN_COMMON = 0.8


class _Bounds(NamedTuple):
    """Bounds of the scale of an axis: the slope of its rates on the camera's, and the inverse of the opposite slope."""

    least: float
    most: float


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Report the axes whose rates are a multiple of the camera's."""
    intervals = evidence.intervals
    if intervals is None:
        return evidence.blind
    off, doubtful = list[str](), list[str]()
    for axis, (measured, seen) in zip("xyz", _rates(evidence, intervals), strict=True):
        found = _sensitivity(measured, seen)
        if found is None:
            continue
        beyond = abs(found.value - 1.0) - SIGMAS * found.error
        if beyond > 0.0:
            excess = f"{found.value:.3f} +- {found.error:.3f} times as fast as the camera about {axis}"
            (off if beyond > SYSTEMATIC else doubtful).append(excess)
    if off:
        return Symptom.warning(
            count=len(off),
            detail=f"the gyro turns {', '.join(off)}",
            treatment="check the scale of each of its axes; no estimator estimates it",
        )
    if doubtful:
        within = f"by less than {100.0 * SYSTEMATIC:g} % beyond chance, which drifting tracks can cause"
        return Undecided(f"the gyro turns {', '.join(doubtful)}, {within}")
    return None


def _rates(evidence: Evidence, intervals: Intervals) -> list[tuple[Array, Array]]:
    """Return the gyro's and the camera's rates of rotation (M,) about each axis of the IMU, less their medians."""
    seen = intervals.w_cam_radps @ evidence.sequence.rig.T_imu_cam[:3, :3].T
    both = [rates - np.median(rates, axis=0) for rates in (intervals.w_radps, seen)]
    return [(both[0][:, k], both[1][:, k]) for k in range(3)]


def _sensitivity(measured: Array, seen: Array) -> Scalar | None:
    """Return the bound nearer to 1, with its standard error; None where the bounds enclose 1 or are far apart."""
    bounds = _Bounds(_slope(measured, seen), _inverse_slope(measured, seen))
    if not bounds.least > LEAST_IN_COMMON * bounds.most > 0.0 or bounds.least <= 1.0 <= bounds.most:
        return None
    if bounds.least > 1.0:
        return Scalar(bounds.least, jackknife_error(_slope, measured, seen))
    return Scalar(bounds.most, jackknife_error(_inverse_slope, measured, seen))


def _slope(response: Array, regressor: Array) -> float:
    return slope(regressor[:, None], regressor[:, None], response[:, None]).value


def _inverse_slope(measured: Array, seen: Array) -> float:
    """Return the inverse of the slope of the camera's rates on the measured ones; infinite where it is not positive."""
    found = _slope(seen, measured)
    return 1.0 / found if found > 0.0 else np.inf


FAULT = Fault(
    "gyro-scale",
    "an axis of the gyro that measures faster or slower rotation than the camera",
    check,
    after=("accelerometer-axes", "disagreement"),
)
