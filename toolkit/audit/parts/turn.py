"""By how much the camera's axes are turned against those of the samples, where the extrinsic is nearly right.

Velocities tell it, or else rotations. What turns and what is not known better is solved for together: beside velocities
the scale and the place of the camera (`alignment`), beside rotations the gyro's bias. Slip lasts for seconds and is one
event: the standard error is that of a jackknife over stretches no shorter than that.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.alignment import TURN, Regression, robust_with_formal_cov
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import INFLATION, Scalar, chance_bound, in_motion
from toolkit.geometry import Array, skew
from toolkit.jackknife import STRETCHES, jackknife_cov
from toolkit.measured_motion import MotionKind

# Axes about which the turn is known worse than this many times the best one are not judged: about its own direction a
# velocity says nothing, and slip feigns something.
MOST_ERROR_RATIO = 4.0
# No bound of chance is less (rad): without noise it would be none.
LEAST_BOUND_RAD = 5e-6


class Turn(NamedTuple):
    """Small rotations (m,) rad about m axes that can be judged, their standard errors (m,) rad, and what is no chance.

    ``by_chance_rad`` (m,) is what they are beyond by chance less often than ``robust.LEVEL``.
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

    The covariance (3, 3) of a few stretches has none of its own.
    """
    variance, axes = np.linalg.eigh(formal)
    error_rad = np.sqrt(np.maximum(np.diag(axes.T @ cov @ axes), variance))
    decidable = variance <= MOST_ERROR_RATIO**2 * variance.min()
    by_chance_rad = chance_bound(error_rad[decidable], np.sqrt(variance[decidable]), stretches, INFLATION[kind])
    return Turn((axes.T @ rad)[decidable], error_rad[decidable], np.maximum(by_chance_rad, LEAST_BOUND_RAD))
