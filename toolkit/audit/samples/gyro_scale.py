"""An axis of the gyro that turns faster or slower than the camera: a channel of another sensitivity.

The gyro's rates regressed on the camera's have too small a slope, for the camera's have noise, and the inverse of the
slope of the camera's on the gyro's is too large for the noise of those: the sensitivity is between the two (Frisch,
"Statistical confluence analysis", 1934). Where the one is above 1 or the other below it, noise is no excuse.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import Scalar, slope
from toolkit.geometry import Array
from toolkit.jackknife import jackknife_error

# A sensitivity counts beyond so many standard errors, a jackknife's, and this share. Tracks that creep make 2.3 %
# beyond them about one axis of kitti00 and 1.6 % of 8 s of a drive, and nothing in twenty others; chosen with them in
# view.
SIGMAS, SYSTEMATIC = 5.0, 0.05
# About an axis of which the rates of the two have less in common than this share there is next to no rotation.
LEAST_IN_COMMON = 0.8


class _Bounds(NamedTuple):
    """Between which the sensitivity of an axis is: by the slope on the camera's rates, and by that of these."""

    least: float
    most: float


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Name the axes about which the gyro's rates are a multiple of the camera's."""
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
            said = f"{found.value:.3f} +- {found.error:.3f} times as fast as the camera about {axis}"
            (off if beyond > SYSTEMATIC else doubtful).append(said)
    if off:
        return Symptom.warning(
            count=len(off),
            detail=f"the gyro turns {', '.join(off)}",
            treatment="check the scale of each of its axes; no estimator carries one",
        )
    if doubtful:
        within = f"by less than {100.0 * SYSTEMATIC:g} % beyond chance, as tracks that creep make it seem"
        return Undecided(f"the gyro turns {', '.join(doubtful)}, {within}")
    return None


def _rates(evidence: Evidence, intervals: Intervals) -> list[tuple[Array, Array]]:
    """Return the gyro's and the camera's rates of rotation (M,) about each axis of the IMU, less their medians."""
    seen = intervals.w_cam_radps @ evidence.sequence.rig.T_imu_cam[:3, :3].T
    both = [rates - np.median(rates, axis=0) for rates in (intervals.w_radps, seen)]
    return [(both[0][:, k], both[1][:, k]) for k in range(3)]


def _sensitivity(measured: Array, seen: Array) -> Scalar | None:
    """Return the end of the bounds that is nearer to 1, with its error; None where they enclose it or are far apart."""
    bounds = _Bounds(_slope(measured, seen), _inverse_slope(measured, seen))
    if not bounds.least > LEAST_IN_COMMON * bounds.most > 0.0 or bounds.least <= 1.0 <= bounds.most:
        return None
    if bounds.least > 1.0:
        return Scalar(bounds.least, jackknife_error(_slope, measured, seen))
    return Scalar(bounds.most, jackknife_error(_inverse_slope, measured, seen))


def _slope(response: Array, regressor: Array) -> float:
    return slope(regressor[:, None], regressor[:, None], response[:, None]).value


def _inverse_slope(measured: Array, seen: Array) -> float:
    """Return one over the slope of what is seen on what is measured, infinite where there is none."""
    found = _slope(seen, measured)
    return 1.0 / found if found > 0.0 else np.inf


FAULT = Fault(
    "gyro-scale",
    "an axis of the gyro that turns faster or slower than the camera",
    check,
    after=("accelerometer-axes", "disagreement"),
)
