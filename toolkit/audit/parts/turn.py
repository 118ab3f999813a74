"""By how much the camera's axes are turned against those of the samples, where the extrinsic is nearly right.

Velocities tell it, or else rotations. What turns and what is not known better is solved for together: beside velocities
the scale and the place of the camera (`alignment`), beside rotations the gyro's bias. Slip lasts for seconds and is one
event: the standard error is that of a jackknife over stretches no shorter than that.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.alignment import TURN, formal_cov, robust_solution, velocity_equations
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import LEAST_STRETCHES, STRETCHES, jackknife_cov
from toolkit.geometry import Array, skew

# Axes about which the turn is known worse than this many times the best one are not judged: about its own direction a
# velocity says nothing, and slip feigns something.
MOST_ERROR_RATIO = 4.0
# Beside velocities, how long slip lasts (s); chosen with the parts of the recordings at hand in view.
SLIP_S = 1.5


class Turn(NamedTuple):
    """Small rotations (m,) rad about m axes that can be judged, and their standard errors (m,) rad.

    Those are of so many ``stretches``: one in which the vehicle stands still does not count.
    """

    rad: Array
    error_rad: Array
    stretches: float


def turn_of_camera(intervals: Intervals, T_imu_cam: Array, duration_s: float = np.inf) -> Turn:
    """Return the turn that brings the camera's motion onto the measured one, by velocities, or else by rotations."""
    if intervals.v_mps is None:
        seen = intervals.w_cam_radps @ T_imu_cam[:3, :3].T
        bias = np.tile(np.eye(3), (len(seen), 1, 1))
        return _turn(intervals.w_radps - seen, np.concatenate([skew(seen), bias], axis=2), seen, STRETCHES)
    measured, seen, jacobian = velocity_equations(intervals, intervals.v_mps, T_imu_cam)
    turn_first = np.concatenate([jacobian[:, :, TURN], np.delete(jacobian, TURN, axis=2)], axis=2)
    return _turn(measured - seen, turn_first, seen, int(np.clip(duration_s / SLIP_S, LEAST_STRETCHES, STRETCHES)))


def _turn(response: Array, jacobian: Array, seen: Array, stretches: int) -> Turn:
    """Solve response (M, 3) = jacobian (M, 3, n) x, the turn being the first three unknowns.

    The axes are those of its formal covariance: that of a few stretches has none of its own.
    """
    formal, axes = np.linalg.eigh(formal_cov(response, jacobian)[:3, :3])
    cov = jackknife_cov(_first_three, response, jacobian, stretches=stretches)
    error_rad = np.sqrt(np.maximum(np.diag(axes.T @ cov @ axes), formal))
    judged = formal <= MOST_ERROR_RATIO**2 * formal.min()
    return Turn((axes.T @ _first_three(response, jacobian))[judged], error_rad[judged], _in_motion(seen, stretches))


def _first_three(response: Array, jacobian: Array) -> Array:
    return robust_solution(response, jacobian)[:3]


def _in_motion(seen: Array, stretches: int) -> float:
    """Return how many of the stretches there are by the ways (or angles) gone in them: (sum w)^2 / sum w^2 (Kish)."""
    stretch = np.arange(len(seen)) * stretches // len(seen)
    gone = np.bincount(stretch, np.linalg.norm(seen, axis=1), stretches)
    return float(gone.sum() ** 2 / max(float(np.sum(gone**2)), 1e-12))
