"""Which of two places the camera is at, by the turns of the vehicle: the odds of the one against the other.

The place is that of the regression which also lets the scale and the turn of the camera be a little off, as they are in
real recordings (`alignment`). Beside its scatter stands what sound recordings misplace the camera by.
"""

import numpy as np

from toolkit.audit.parts.alignment import Alignment
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import Scalar
from toolkit.geometry import Array, skew
from toolkit.sequence import Sequence

# Logarithms of the odds from which the other place is taken, a thousand to one, and from which it is not thought of any
# more, twenty to one against it: what a file says is right more often than not.
LOG_ODDS, LOG_ODDS_AGAINST = float(np.log(1000.0)), float(np.log(20.0))
# Standard deviations from which on the measured place is not the other one.
MOST_SIGMAS = 4.0
# What sound odometry has, chosen with the recordings at hand in view: velocities of another point along the way of
# travel (m; 0.4 to 0.9 in ten cars), and velocities that are off by a share for as long as a turn lasts, as the limits
# of `miscalibration` and `vision-scale` have it. A share of the velocity is that share of the turn's radius.
ALONG_TRAVEL_M, SHARE_IN_TURNS = 0.65, 0.02
# The same of sound recordings beside an IMU (m): 0.06 at most.
BESIDE_IMU_M = 0.05


def way_gone(sequence: Sequence, intervals: Intervals, found: Alignment, way_m: Array) -> Scalar:
    """Return how far along a way (3,) m from the place given the camera is: 1 is its end."""
    return share_of_way(found.lever_m, found.lever_cov_m2 + _systematic_cov_m2(sequence, intervals), way_m)


def share_of_way(lacking_m: Array, cov_m2: Array, way_m: Array) -> Scalar:
    """Return the same of a place that lacks (3,) m, with its covariance (3, 3), by weighted least squares."""
    weighted = np.linalg.solve(cov_m2, way_m)
    information = float(weighted @ way_m)
    return Scalar(float(weighted @ lacking_m) / information, float(1.0 / np.sqrt(information)))


def is_there(share: Scalar) -> bool:
    """Say whether the camera is at the way's end, and not elsewhere."""
    return not is_excluded(share) and _log_odds(share) > LOG_ODDS


def is_excluded(share: Scalar) -> bool:
    """Say whether the camera is not at the way's end."""
    return abs(share.value - 1.0) > MOST_SIGMAS * share.error or _log_odds(share) < -LOG_ODDS_AGAINST


def _log_odds(share: Scalar) -> float:
    """Return the logarithm of the odds of the way's end against its begin, of normal errors."""
    return (share.value - 0.5) / share.error**2


def metres(position: Array) -> str:
    """Return a position (3,) m as text."""
    return "(" + ", ".join(f"{x:z.2f}" for x in position) + ")"


def _systematic_cov_m2(sequence: Sequence, intervals: Intervals) -> Array:
    """Return the covariance (3, 3) of the place in sound recordings, without that of its scatter."""
    if intervals.v_mps is None:
        return BESIDE_IMU_M**2 * np.eye(3)
    R_imu_cam = sequence.rig.T_imu_cam[:3, :3]
    w_radps, v_mps = intervals.w_cam_radps @ R_imu_cam.T, intervals.v_cam_mps @ R_imu_cam.T
    speed_mps, travel = np.linalg.norm(v_mps, axis=1), np.median(v_mps, axis=0)
    travel /= max(float(np.linalg.norm(travel)), 1e-9)
    lever = skew(w_radps)
    axes = np.linalg.eigh(np.einsum("nij,nik->jk", lever, lever)).eigenvectors
    turned = np.linalg.norm(lever @ axes, axis=1)  # (M, 3) rates that move a camera which is off along each axis
    radius_m = speed_mps @ turned**2 / np.maximum(np.sum(turned**3, axis=0), 1e-12)
    in_turns = axes @ np.diag((SHARE_IN_TURNS * radius_m) ** 2) @ axes.T
    return np.asarray(in_turns + ALONG_TRAVEL_M**2 * np.outer(travel, travel))
