"""Levenberg-Marquardt on GTSAM's linearisation and elimination, with every solve checked.

GTSAM's own optimizer hands a Python factor a fresh copy of all values at each call, which makes a thousand
twist factors take ten times as long as sixty thousand stereo factors; and it returns unchanged values without a
message when an error is not a number. The damping is Levenberg's multiple of the identity, updated by how well
the linear model predicted the decrease (Madsen, Nielsen & Tingleff 2004, "Methods for non-linear least squares
problems", algorithm 3.16): a step that was right lowers it, a wrong one raises it ever faster.
"""

from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np

from toolkit.errors import EstimatorError
from toolkit.progress import SILENT, Progress

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-9, 1e8


@dataclass(frozen=True)
class Stopping:
    """When to stop: a relative decrease of the error that is small, or too many iterations."""

    relative_decrease: float = 1e-5
    max_iterations: int = 50


class Solution(NamedTuple):
    """The values reached, their error (half the sum of squares), the iterations taken and whether it converged."""

    values: gtsam.Values
    error: float
    iterations: int
    converged: bool


class _Linearised(NamedTuple):
    """Values, their error, and the graph linearised there."""

    values: gtsam.Values
    error: float
    linear: gtsam.GaussianFactorGraph


class _DampedStep(NamedTuple):
    values: gtsam.Values
    error: float
    gain: float


def solve(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    stopping: Stopping,
    progress: Progress = SILENT,
    stage: str = "solving",
) -> Solution:
    """Minimise the error of a graph from a start; ``progress`` hears of every iteration, under the stage's name.

    Raises EstimatorError where the error at the start is not finite: some measurement or initial value is NaN.
    """
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
    keys = _keys_by_dimension(start)
    values, error, damping = start, graph.error(start), _FIRST_DAMPING
    if not np.isfinite(error):
        raise EstimatorError("the smoother's error is not a number at its start; look for NaN in the measurements")
    for iteration in range(1, stopping.max_iterations + 1):
        progress.advance(iteration - 1, stopping.max_iterations, stage)
        here = _Linearised(values, error, graph.linearize(values))
        factor, step = 2.0, None
        while step is None:
            step = _tried(graph, here, _damped(here.linear, keys, damping), ordering)
            if step is None or not step.error <= error:
                solvable, step = step is not None, None
                damping, factor = damping * factor, factor * 2.0
                if damping > _MOST_DAMPING:
                    # No step, however short, lowers the error: a minimum, if the system could be solved at all.
                    return Solution(values, error, iteration, converged=solvable)
        decrease, values, error = error - step.error, step.values, step.error
        damping = max(damping * max(1.0 / 10.0, 1.0 - (2.0 * min(step.gain, 1.0) - 1.0) ** 3), _LEAST_DAMPING)
        if decrease <= stopping.relative_decrease * error:
            return Solution(values, error, iteration, converged=True)
    return Solution(values, error, stopping.max_iterations, converged=False)


def _damped(linear: gtsam.GaussianFactorGraph, keys: dict[int, list[int]], damping: float) -> gtsam.GaussianFactorGraph:
    damped = gtsam.GaussianFactorGraph()
    damped.push_back(linear)
    for dimension, keys_of_dimension in keys.items():
        pull, zero = np.sqrt(damping) * np.eye(dimension), np.zeros(dimension)
        for key in keys_of_dimension:
            damped.add(key, pull, zero)
    return damped


def _tried(
    graph: gtsam.NonlinearFactorGraph,
    here: _Linearised,
    damped: gtsam.GaussianFactorGraph,
    ordering: gtsam.Ordering,
) -> _DampedStep | None:
    """Return where one damped step leads, or None where even the damped system is indeterminate."""
    try:
        delta = damped.optimize(ordering)
    except RuntimeError as refusal:
        if "Indeterminate" in str(refusal):
            return None
        raise
    moved = here.values.retract(delta)
    predicted = here.linear.error(here.values.zeroVectors()) - here.linear.error(delta)
    error = graph.error(moved)
    return _DampedStep(moved, error, (here.error - error) / max(predicted, np.finfo(float).tiny))


def _keys_by_dimension(values: gtsam.Values) -> dict[int, list[int]]:
    grouped: dict[int, list[int]] = {}
    for key, dimension in values.dims().items():
        grouped.setdefault(dimension, []).append(key)
    return grouped
