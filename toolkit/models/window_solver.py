"""The minimum of a window of states, the covariance of each of them, and the window without its oldest states.

States that leave are marginalised by a Schur complement, together with every track they saw, so that each sighting is
used once (Dong-Si & Mourikis 2011, "Motion tracking with fixed-lag smoothing"; Leutenegger et al. 2015, section 3.4).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.linalg import cho_solve, solve_triangular

from toolkit.errors import EstimatorError
from toolkit.geometry import Array, IntArray
from toolkit.models.reduced_vision import RobustCamera, Sightings, Vision
from toolkit.models.stereo_window import Evaluated, MarginalPrior, StereoWindow, System

MOST_ITERATIONS = 5
# Newton's method converges quadratically: after a step shorter than this, in sigmas of all states together, the next is
# a tenth of a sigma, and is taken with the next frame. If a step gains hardly anything, further ones gain nothing.
LAST_STEP_SIGMAS, RELATIVE_DECREASE = 2.0, 1e-3
# Used only after a step that fails: a millionth of the sightings' information on one pose, given the rest, is more than
# the information on position and heading in the world, and would fix these.
_FIRST_DAMPING, _MOST_DAMPING = 1e-6, 1e6
# Parts of a landmark's step that are tried if the window's step raises the cost; damping the poses does not shorten it.
_SHARES = (1.0, 0.5, 0.25, 0.0)


@dataclass(frozen=True, eq=False)
class SolvedWindow:
    """A window at its minimum, and the root of its information, linearised one step before the minimum."""

    window: StereoWindow
    root: Array

    def cov(self, i: int) -> Array:
        """Return the marginal covariance (d, d) of state i, in GTSAM's tangent spaces.

        The root's rows are in the order of time, and rows before the state do not involve it.
        """
        d = self.window.size
        later = self.root[i * d :, i * d :]
        half = solve_triangular(later, np.eye(len(later), d), lower=True, check_finite=False)
        return np.asarray(half.T @ half)


def solve_window(window: StereoWindow, camera: RobustCamera, iterations: int = MOST_ITERATIONS) -> SolvedWindow:
    """Return the window at its minimum, by Levenberg-Marquardt.

    Raises EstimatorError where the error is not a number or the states are not determined.
    """
    here, damping = Evaluated.of(window, camera), 0.0
    if not np.isfinite(here.error):
        raise EstimatorError("the window's error is not a number; look for NaN in the measurements or the start")
    for _ in range(iterations):
        system = here.linearised()
        step = _descent(here, system, damping, camera)
        decrease, here = here.error - step.there.error, step.there
        if step.sigmas <= LAST_STEP_SIGMAS or decrease <= RELATIVE_DECREASE * here.error:
            break
        damping = step.damping / 10.0 if step.damping > _FIRST_DAMPING else 0.0
    try:
        return SolvedWindow(here.window, system.root)
    except np.linalg.LinAlgError as refusal:
        raise EstimatorError(f"the window does not determine its states ({refusal})") from refusal


def without_oldest(window: StereoWindow, count: int, camera: RobustCamera) -> StereoWindow:
    """Marginalise the ``count`` oldest states with every track they saw; the row numbers of other points stay."""
    seen = window.sightings
    leaving_points = np.unique(seen.point[seen.pose < count])
    leaving = replace(_with_points(window, leaving_points), motion=window.motion[: count + 1])
    system, gone = Evaluated.of(leaving, camera).linearised(), count * window.size
    root = np.linalg.cholesky(system.information[:gone, :gone])
    across = solve_triangular(root, system.information[:gone, gone:], lower=True)
    information = system.information[gone:, gone:] - across.T @ across
    vector = system.vector[gone:] - across.T @ solve_triangular(root, system.vector[:gone], lower=True)
    values = gtsam.Values(window.values)
    for keys in window.keys[:count]:
        for key in keys:
            values.erase(key)
    left = ~np.isin(seen.point, leaving_points)
    kept = Sightings(seen.pose[left] - count, seen.point[left], seen.uv_px[left])
    prior = MarginalPrior(information, vector, values)
    motion = (gtsam.NonlinearFactorGraph(), *window.motion[count + 1 :])
    return StereoWindow(window.keys[count:], values, motion, prior, kept, window.points)


def _with_points(window: StereoWindow, points: IntArray) -> StereoWindow:
    """Return the window with some points (M,), by their ascending rows, and their sightings."""
    seen = window.sightings.of_points(points)
    rows = np.searchsorted(points, seen.point).astype(np.int64)
    return replace(window, points=window.points[points], sightings=Sightings(seen.pose, rows, seen.uv_px))


class _DescentStep(NamedTuple):
    """The window after a step, the step's length in standard deviations of all states together, and its damping."""

    there: Evaluated
    sigmas: float
    damping: float


def _descent(here: Evaluated, system: System, damping: float, camera: RobustCamera) -> _DescentStep:
    """Return the least damped step that does not raise the cost, or a step of length zero."""
    while damping <= _MOST_DAMPING:
        try:
            step = cho_solve((system.damped_root(damping), True), system.vector, check_finite=False)
            moved = _moved(here.window, system, step)
            there = Evaluated.of(moved, camera)
            if not there.error <= here.error:
                there = Evaluated.of(_with_shortened_landmark_steps(moved, here.window.points, camera), camera)
            if there.error <= here.error:
                return _DescentStep(there, float(np.sqrt(step @ system.vector)), damping)
        except np.linalg.LinAlgError:
            pass
        damping = max(10.0 * damping, _FIRST_DAMPING)
    return _DescentStep(here, 0.0, damping)


def _with_shortened_landmark_steps(moved: StereoWindow, before: Array, camera: RobustCamera) -> StereoWindow:
    """Return the window with each landmark (M,) moved by the part of its step with the lowest cost of its sightings.

    A landmark that comes nearer by metres may overshoot to behind a camera, and alone would make every step fail.
    """
    places = np.array([before + share * (moved.points - before) for share in _SHARES])
    costs = [Vision.at(moved.poses, points, moved.sightings, camera).loss_of_points for points in places]
    cheapest = np.nan_to_num(costs, nan=np.inf).argmin(axis=0)
    return replace(moved, points=places[cheapest, np.arange(len(before))])


def _moved(window: StereoWindow, system: System, step: Array) -> StereoWindow:
    """Return the window after a step (D,) of its states and the corresponding steps of its landmarks."""
    delta, start, dims = gtsam.VectorValues(), 0, window.values.dims()
    for key in window.all_keys:
        delta.insert(key, step[start : start + dims[key]])
        start += dims[key]
    pose_steps = step.reshape(len(window.keys), -1)[:, :6].ravel()
    points = window.points + system.vision.point_steps(pose_steps)
    return replace(window, values=window.values.retract(delta), points=points)
