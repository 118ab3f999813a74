"""The camera's position and its small rotation against the given extrinsic, from camera and motion samples.

Position: which of two places the camera is at, by the turns of the vehicle. The regression of `alignment` measures it,
in which the scale and the rotation of the camera may also be a little off, as they are in real recordings. To its
scatter the error is added that sound recordings have.

Rotation: by velocities where there are any, else by rates of rotation. Unknowns that are not known better are solved
for with it: beside velocities the scale and the position of the camera (`alignment`), beside rates the gyro's bias.
Slip lasts for seconds and is one event: the standard error is that of a jackknife over stretches no shorter than that.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.alignment import TURN, Alignment, Regression, robust_with_formal_cov
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import INFLATION, Scalar, chance_bound, in_motion
from toolkit.geometry import Array, skew
from toolkit.jackknife import STRETCHES, jackknife_cov
from toolkit.measured_motion import MotionKind
from toolkit.sequence import Sequence

# Logarithms of the odds at which the other position is accepted (1000 to 1), and at which it is excluded (20 to 1
# against it): the position in a file is right more often than not.
LOG_ODDS, LOG_ODDS_AGAINST = float(np.log(1000.0)), float(np.log(20.0))
# The other position is excluded where the measured one is this many standard deviations away.
MOST_SIGMAS = 4.0
# What sound odometry has, chosen with the recordings at hand in view: velocities of another point along the way of
# travel (m; 0.4 to 0.9 in ten cars), and velocities that are off by a share for as long as a turn lasts, as the limits
# of `miscalibration` and `vision-scale` have it. A share of the velocity is that share of the turn's radius.
ALONG_TRAVEL_M, SHARE_IN_TURNS = 0.65, 0.02
# The same of sound recordings beside an IMU (m): 0.06 at most.
BESIDE_IMU_M = 0.05
# Limits beyond the standard errors for a rotation (rad) estimated by velocities, which slip and pitch of cars bias, and
# by rates of rotation. Chosen with the sound recordings at hand in view.
SYSTEMATIC_RAD = {"twist": 0.018, "imu": 0.01}
# Axes about which the error of the rotation is this many times that of the best axis are not judged: a velocity does
# not determine the rotation about its own direction, and slip would bias it.
MOST_ERROR_RATIO = 4.0
# Least bound by chance (rad); without noise it would be zero.
LEAST_BOUND_RAD = 5e-6


def way_gone(sequence: Sequence, intervals: Intervals, found: Alignment, way_m: Array) -> Scalar:
    """Return the camera's position along a vector (3,) m from the given one: 0 is its start, 1 its end."""
    return share_of_way(found.lever_m, found.lever_cov_m2 + _systematic_cov_m2(sequence, intervals), way_m)


def share_of_way(lacking_m: Array, cov_m2: Array, way_m: Array) -> Scalar:
    """Return the same for a measured correction (3,) m with its covariance (3, 3), by weighted least squares."""
    weighted = np.linalg.solve(cov_m2, way_m)
    information = float(weighted @ way_m)
    return Scalar(float(weighted @ lacking_m) / information, float(1.0 / np.sqrt(information)))


def is_there(share: Scalar) -> bool:
    """Say whether the camera is at the end of the vector, and not elsewhere."""
    return not is_excluded(share) and _log_odds(share) > LOG_ODDS


def is_excluded(share: Scalar) -> bool:
    """Say whether the camera is not at the end of the vector."""
    return abs(share.value - 1.0) > MOST_SIGMAS * share.error or _log_odds(share) < -LOG_ODDS_AGAINST


def _log_odds(share: Scalar) -> float:
    """Return the logarithm of the odds of the vector's end against its start, for normal errors."""
    return (share.value - 0.5) / share.error**2


def metres(position: Array) -> str:
    """Return a position (3,) m as text."""
    return "(" + ", ".join(f"{x:z.2f}" for x in position) + ")"


def _systematic_cov_m2(sequence: Sequence, intervals: Intervals) -> Array:
    """Return the covariance (3, 3) of the systematic error of the position in sound recordings."""
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


class Turn(NamedTuple):
    """Small rotations (m,) rad about m axes that can be judged, their standard errors (m,) rad, and bounds by chance.

    They exceed ``by_chance_rad`` (m,) by chance less often than ``robust.LEVEL``.
    """

    rad: Array
    error_rad: Array
    by_chance_rad: Array


def angle_of(turn: Turn) -> Scalar:
    """Return the angle of a turn about the axes that can be judged."""
    angle = float(np.linalg.norm(turn.rad))
    return Scalar(angle, float(np.linalg.norm(turn.rad * turn.error_rad)) / max(angle, 1e-12))


def turn_by_velocities(whole: Regression) -> Turn:
    """Return the turn that brings the camera's velocities onto those of odometry."""
    return _tested(whole.found[TURN], whole.formal[TURN, TURN], whole.cov[TURN, TURN], whole.in_motion, "twist")


def turn_by_rotations(intervals: Intervals, T_imu_cam: Array) -> Turn:
    """Return the turn that brings the camera's rotations onto those of the gyro."""
    seen = intervals.w_cam_radps @ T_imu_cam[:3, :3].T
    bias = np.tile(np.eye(3), (len(seen), 1, 1))
    response, jacobian = intervals.w_radps - seen, np.concatenate([skew(seen), bias], axis=2)
    found, formal = robust_with_formal_cov(response, jacobian)
    cov = jackknife_cov(lambda *rows: robust_with_formal_cov(*rows)[0], response, jacobian)
    return _tested(found[:3], formal[:3, :3], cov[:3, :3], in_motion(seen, STRETCHES), "imu")


def _tested(rad: Array, formal: Array, cov: Array, stretches: float, kind: MotionKind) -> Turn:
    """Return the turn (3,) about axes that can be judged: those of its formal covariance (3, 3).

    The jackknife covariance (3, 3) of a few stretches is too uncertain to choose the axes.
    """
    variance, axes = np.linalg.eigh(formal)
    error_rad = np.sqrt(np.maximum(np.diag(axes.T @ cov @ axes), variance))
    decidable = variance <= MOST_ERROR_RATIO**2 * variance.min()
    by_chance_rad = chance_bound(error_rad[decidable], np.sqrt(variance[decidable]), stretches, INFLATION[kind])
    return Turn((axes.T @ rad)[decidable], error_rad[decidable], np.maximum(by_chance_rad, LEAST_BOUND_RAD))
