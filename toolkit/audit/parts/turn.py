"""By how much the camera's axes are turned against those of the samples, where the extrinsic is nearly right.

Velocities tell it, or else rotations. What turns and what is not known better is solved for together: beside velocities
the scale and the place of the camera (`alignment`), beside rotations the gyro's bias. Slip lasts for seconds and is one
event: the standard error is that of a jackknife over stretches no shorter than that.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.alignment import TURN, formal_cov, robust_solution, velocity_equations
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import (
    INFLATION,
    chance_bound,
    in_motion,
    slip_stretches,
)
from toolkit.geometry import Array, skew
from toolkit.jackknife import STRETCHES, jackknife_cov

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


def turn_of_camera(intervals: Intervals, T_imu_cam: Array, duration_s: float = np.inf) -> Turn:
    """Return the turn that brings the camera's motion onto the measured one, by velocities, or else by rotations."""
    if intervals.v_mps is None:
        kind, stretches, seen = "imu", STRETCHES, intervals.w_cam_radps @ T_imu_cam[:3, :3].T
        bias = np.tile(np.eye(3), (len(seen), 1, 1))
        found = _turn(intervals.w_radps - seen, np.concatenate([skew(seen), bias], axis=2), stretches)
    else:
        kind, stretches = "twist", slip_stretches(duration_s)
        measured, seen, jacobian = velocity_equations(intervals, intervals.v_mps, T_imu_cam)
        turn_first = np.concatenate([jacobian[:, :, TURN], np.delete(jacobian, TURN, axis=2)], axis=2)
        found = _turn(measured - seen, turn_first, stretches)
    by_chance_rad = chance_bound(found.error_rad, found.formal_rad, in_motion(seen, stretches), INFLATION[kind])
    return Turn(found.rad, found.error_rad, np.maximum(by_chance_rad, LEAST_BOUND_RAD))


class _Found(NamedTuple):
    rad: Array
    error_rad: Array
    formal_rad: Array


def _turn(response: Array, jacobian: Array, stretches: int) -> _Found:
    """Solve response (M, 3) = jacobian (M, 3, n) x, the turn being the first three unknowns.

    The axes are those of its formal covariance: that of a few stretches has none of its own.
    """
    formal, axes = np.linalg.eigh(formal_cov(response, jacobian)[:3, :3])
    cov = jackknife_cov(_first_three, response, jacobian, stretches=stretches)
    error_rad = np.sqrt(np.maximum(np.diag(axes.T @ cov @ axes), formal))
    judged = formal <= MOST_ERROR_RATIO**2 * formal.min()
    return _Found((axes.T @ _first_three(response, jacobian))[judged], error_rad[judged], np.sqrt(formal[judged]))


def _first_three(response: Array, jacobian: Array) -> Array:
    return robust_solution(response, jacobian)[:3]
