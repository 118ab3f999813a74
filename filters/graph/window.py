"""A window of states held by motion factors and a linear prior, with structureless vision: solve it, shorten it.

Everything is dense: a window has a few hundred unknowns. What leaves is marginalised by a Schur complement, with the
whole of every track it saw, so that each sighting counts once (Dong-Si & Mourikis 2011, "Motion tracking with
fixed-lag smoothing"; Leutenegger et al. 2015, section 3.4).
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from filters.graph import structureless
from filters.graph.structureless import Sightings
from toolkit.errors import EstimatorError
from toolkit.geometry import Array, IntArray
from toolkit.sequence import StereoRig

MOST_ITERATIONS, RELATIVE_DECREASE, ABSOLUTE_DECREASE = 5, 1e-3, 1e-12
_FIRST_DAMPING, _MOST_DAMPING = 1e-6, 1e6


@dataclass(frozen=True, eq=False)
class Prior:
    """Information (D, D) and vector (D,) on the first D unknowns of the window, about values of their states."""

    information: Array
    vector: Array
    about: gtsam.Values

    @classmethod
    def nothing(cls) -> "Prior":
        """Return the prior that says nothing."""
        return cls(np.zeros((0, 0)), np.zeros(0), gtsam.Values())


@dataclass(frozen=True, eq=False)
class Window:
    """States in the order of time, their keys (each [pose, velocity, bias] or [pose, bias]) and what holds them.

    ``motion[i]`` ties state i to the one before it; ``points`` (M, 3) are the landmarks of the sightings.
    """

    keys: tuple[tuple[int, ...], ...]
    values: gtsam.Values
    motion: tuple[gtsam.NonlinearFactorGraph, ...]
    prior: Prior
    sightings: Sightings
    points: Array

    @property
    def poses(self) -> Array:
        """Return the poses (K, 4, 4) of the IMU in the world."""
        return np.array([self.values.atPose3(keys[0]).matrix() for keys in self.keys])

    @property
    def size(self) -> int:
        """Return the unknowns of one state."""
        return int(sum(self.values.dims()[key] for key in self.keys[0]))


@dataclass(frozen=True, eq=False)
class _System:
    """The normal equations (D, D), (D,) of a window and the elimination of its landmarks."""

    information: Array
    vector: Array
    vision: structureless.Reduced


def solved(window: Window, rig: StereoRig) -> tuple[Window, Array]:
    """Return the window at its minimum, by Levenberg-Marquardt, and the covariance (d, d) of its newest state.

    The covariance is in GTSAM's spaces and of the last linearisation, a step short of the minimum. Raises
    EstimatorError where the error is not a number or the states are not determined.
    """
    error, damping = _error(window, rig), _FIRST_DAMPING
    if not np.isfinite(error):
        raise EstimatorError("the window's error is not a number; look for NaN in the measurements or the start")
    system = _linearised(window, rig)
    for _ in range(MOST_ITERATIONS):
        moved, error_moved = _tried(window, system, damping, rig)
        while not error_moved <= error and damping < _MOST_DAMPING:
            damping *= 10.0
            moved, error_moved = _tried(window, system, damping, rig)
        if not error_moved <= error:
            break
        decrease, window, error = error - error_moved, moved, error_moved
        if decrease <= RELATIVE_DECREASE * error + ABSOLUTE_DECREASE:
            break
        damping = max(damping / 10.0, _FIRST_DAMPING)
        system = _linearised(window, rig)
    return window, _newest_cov(system, window.size)


def without_oldest(window: Window, rig: StereoRig) -> tuple[Window, IntArray]:
    """Marginalise the oldest state with every track it saw; return the shorter window and those tracks' rows (M,).

    The rows of the other points stay as they are.
    """
    spoken = np.unique(window.sightings.point[window.sightings.pose == 0])
    told = replace(window, sightings=window.sightings.of_points(spoken))
    graph = gtsam.NonlinearFactorGraph(window.motion[0])
    if len(window.motion) > 1:
        graph.push_back(window.motion[1])
    system, d = _linearised(replace(told, motion=(graph,)), rig), window.size
    factor = cho_factor(system.information[:d, :d])
    across = system.information[d:, :d]
    information = system.information[d:, d:] - across @ cho_solve(factor, across.T)
    vector = system.vector[d:] - across @ cho_solve(factor, system.vector[:d])
    values = gtsam.Values(window.values)
    for key in window.keys[0]:
        values.erase(key)
    left = ~np.isin(window.sightings.point, spoken)
    seen = window.sightings
    kept = Sightings(seen.pose[left] - 1, seen.point[left], seen.uv_px[left])
    prior = Prior(0.5 * (information + information.T), vector, values)
    motion = (gtsam.NonlinearFactorGraph(), *window.motion[2:])
    return Window(window.keys[1:], values, motion, prior, kept, window.points), spoken


def _linearised(window: Window, rig: StereoRig) -> _System:
    count, d = len(window.keys), window.size
    information, vector = _of_motion(window)
    held = len(window.prior.vector)
    information[:held, :held] += window.prior.information
    vector[:held] += window.prior.vector - window.prior.information @ _off_prior(window)
    vision = structureless.reduced(window.poses, window.points, window.sightings, rig)
    rows = (d * np.arange(count)[:, None] + np.arange(6)).ravel()
    information[np.ix_(rows, rows)] += vision.information
    vector[rows] += vision.vector
    return _System(information, vector, vision)


def _of_motion(window: Window) -> tuple[Array, Array]:
    dims, flat = window.values.dims(), [key for keys in window.keys for key in keys]
    starts = dict(zip(flat, np.cumsum([0, *(dims[key] for key in flat)]).tolist(), strict=False))
    size = sum(dims[key] for key in flat)
    information, vector = np.zeros((size, size)), np.zeros(size)
    for graph in window.motion:
        if graph.size() == 0:
            continue
        ordering = gtsam.Ordering()
        involved = sorted(graph.keyVector(), key=starts.__getitem__)
        for key in involved:
            ordering.push_back(key)
        block, part = graph.linearize(window.values).hessian(ordering)
        rows = np.concatenate([starts[key] + np.arange(dims[key]) for key in involved])
        information[np.ix_(rows, rows)] += block
        vector[rows] += np.ravel(part)
    return information, vector


def _off_prior(window: Window) -> Array:
    """Return how far (D,) the prior's states are from the values it is about."""
    about = window.prior.about
    held = [key for keys in window.keys for key in keys if about.exists(key)]
    if not held:
        return np.zeros(0)
    delta = about.localCoordinates(window.values.extract(held))
    return np.concatenate([delta.at(key) for key in held])


def _error(window: Window, rig: StereoRig) -> float:
    off, prior = _off_prior(window), window.prior
    held = float(0.5 * off @ prior.information @ off - prior.vector @ off)
    motion = sum(graph.error(window.values) for graph in window.motion)
    return held + motion + structureless.loss(window.poses, window.points, window.sightings, rig)


def _tried(window: Window, system: _System, damping: float, rig: StereoRig) -> tuple[Window, float]:
    """Return the window one damped step on, and its error; infinite where the step cannot be computed."""
    d = window.size
    scale = damping * np.diagonal(system.information)
    try:
        step = cho_solve(cho_factor(system.information + np.diag(scale)), system.vector)
    except (np.linalg.LinAlgError, ValueError):
        return window, np.inf
    delta, start, dims = gtsam.VectorValues(), 0, window.values.dims()
    for keys in window.keys:
        for key in keys:
            delta.insert(key, step[start : start + dims[key]])
            start += dims[key]
    pose_steps = step.reshape(-1, d)[:, :6].ravel()
    points = window.points + system.vision.point_steps(pose_steps)
    moved = replace(window, values=window.values.retract(delta), points=points)
    return moved, _error(moved, rig)


def _newest_cov(system: _System, d: int) -> Array:
    size = len(system.vector)
    last = np.zeros((size, d))
    last[size - d :] = np.eye(d)
    try:
        cov: Array = cho_solve(cho_factor(system.information), last)[size - d :]
    except (np.linalg.LinAlgError, ValueError) as refusal:
        raise EstimatorError(f"the window does not determine its newest state ({refusal})") from refusal
    return 0.5 * (cov + cov.T)
