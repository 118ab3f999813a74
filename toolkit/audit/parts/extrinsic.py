"""Position and small rotation of the camera against the given extrinsic, and how significant they are.

Position: which of two positions the camera has, by the turns of the vehicle. The regression of `alignment` estimates
it, with the scale and the rotation of the camera as further unknowns. The systematic error of sound recordings is added
to the covariance.

Rotation: by velocities with odometry, by rates of rotation with an IMU. The regression by velocities has the scale and
the position of the camera as further unknowns (`alignment`), that by rates the gyro's bias. Slip lasts for seconds, so
the standard error is that of a jackknife over stretches that are no shorter.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.alignment import TURN, Regression, TranslationFit, robust_with_formal_cov
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import INFLATION, Scalar, chance_bound, in_motion
from toolkit.geometry import Array, skew
from toolkit.jackknife import STRETCHES, jackknife_cov
from toolkit.measured_motion import MotionKind
from toolkit.sequence import Sequence

# Logarithms of the odds at which the other position is accepted (1000 to 1) and excluded (20 to 1 against it). They
# differ because the position in a file is right more often than not.
LOG_ODDS, LOG_ODDS_AGAINST = float(np.log(1000.0)), float(np.log(20.0))
# The other position is excluded where the measured one is this many standard deviations away.
MOST_SIGMAS = 4.0
# Standard deviations of the systematic error of sound odometry, chosen with the recordings at hand in view: the
# distance along the direction of travel to the point whose velocities are given (m; 0.4 to 0.9 in ten cars), and a
# relative error of the velocity that lasts as long as a turn, which looks like this share of the turn's radius. The
# share agrees with SYSTEMATIC_RAD and SYSTEMATIC_SCALE.
ALONG_TRAVEL_M, SHARE_IN_TURNS = 0.65, 0.02
# The same of sound recordings with an IMU (m), which have 0.06 at most.
BESIDE_IMU_M = 0.05
# Limits beyond the standard errors for a rotation (rad) estimated by velocities, which slip and pitch of cars bias, and
# by rates of rotation. Chosen with the sound recordings at hand in view.
SYSTEMATIC_RAD = {"twist": 0.018, "imu": 0.01}
# Axes whose standard error is more than this many times that of the best axis are not judged: velocities do not
# determine the rotation about their own direction, and slip would bias it.
MOST_ERROR_RATIO = 4.0
# Least bound (rad); without noise it would be zero.
LEAST_BOUND_RAD = 5e-6


def way_gone(sequence: Sequence, intervals: Intervals, found: TranslationFit, way_m: Array) -> Scalar:
    """Return where the camera is along a vector (3,) m from the given position: 0 is its start, 1 its end."""
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
    """Small rotations (m,) rad about m axes that can be judged, their standard errors (m,) rad, and bounds (m,) rad.

    By chance a rotation exceeds ``by_chance_rad`` less often than ``robust.LEVEL``.
    """

    rad: Array
    error_rad: Array
    by_chance_rad: Array


def angle_of(turn: Turn) -> Scalar:
    """Return the angle of a rotation about the axes that can be judged."""
    angle = float(np.linalg.norm(turn.rad))
    return Scalar(angle, float(np.linalg.norm(turn.rad * turn.error_rad)) / max(angle, 1e-12))


def turn_by_velocities(whole: Regression) -> Turn:
    """Return the rotation that aligns the camera's velocities with those of odometry."""
    return _tested(whole.found[TURN], whole.formal[TURN, TURN], whole.cov[TURN, TURN], whole.in_motion, "twist")


def turn_by_rotations(intervals: Intervals, T_imu_cam: Array) -> Turn:
    """Return the rotation that aligns the camera's rates of rotation with those of the gyro."""
    seen = intervals.w_cam_radps @ T_imu_cam[:3, :3].T
    bias = np.tile(np.eye(3), (len(seen), 1, 1))
    response, jacobian = intervals.w_radps - seen, np.concatenate([skew(seen), bias], axis=2)
    found, formal = robust_with_formal_cov(response, jacobian)
    cov = jackknife_cov(lambda *rows: robust_with_formal_cov(*rows)[0], response, jacobian)
    return _tested(found[:3], formal[:3, :3], cov[:3, :3], in_motion(seen, STRETCHES), "imu")


def _tested(rad: Array, formal: Array, cov: Array, stretches: float, kind: MotionKind) -> Turn:
    """Return the rotation (3,) about those principal axes of its formal covariance (3, 3) that can be judged.

    The jackknife covariance ``cov`` (3, 3) of a few stretches is too uncertain to choose the axes.
    """
    variance, axes = np.linalg.eigh(formal)
    error_rad = np.sqrt(np.maximum(np.diag(axes.T @ cov @ axes), variance))
    decidable = variance <= MOST_ERROR_RATIO**2 * variance.min()
    by_chance_rad = chance_bound(error_rad[decidable], np.sqrt(variance[decidable]), stretches, INFLATION[kind])
    return Turn((axes.T @ rad)[decidable], error_rad[decidable], np.maximum(by_chance_rad, LEAST_BOUND_RAD))
