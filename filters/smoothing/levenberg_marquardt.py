"""GTSAM's Levenberg-Marquardt, one iteration at a time, with the ways a solve can go wrong checked.

GTSAM's optimizer returns unchanged values without a message when an error is not a number, so the error is looked at
first. And it hands a Python factor a copy of all values at each call, which makes a thousand twist factors take ten
times as long as sixty thousand stereo factors: each takes part by its linearisation at the values of the iteration,
and its own error at the end of a step says whether the step is taken. The damping is Levenberg's multiple of the
identity: a tenth of it after a step that lowered the error, ten times as much after one that did not.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import gtsam
import numpy as np

from filters.smoothing.cached_linearisation import CachedLinearisation, cached_linearisations, with_linearisations
from toolkit.errors import EstimatorError
from toolkit.progress import SILENT, Progress

_FIRST_DAMPING, _MOST_DAMPING, _DAMPING_FACTOR = 1e-3, 1e8, 10.0
# Half a sum of squares of standard deviations: exact measurements have next to none, of which no share is little.
_LEAST_DECREASE = 1e-12


@dataclass(frozen=True)
class Stopping:
    """When to stop: a decrease of the error that is small, in itself or relative to it, or too many iterations."""

    relative_decrease: float = 1e-5
    max_iterations: int = 50
    decrease: float = _LEAST_DECREASE


class Beside(Protocol):
    """Measurements beside the graph, evaluated and linearised in Python for all at once."""

    def error(self, values: gtsam.Values) -> float:
        """Return half the sum of squares, or of a loss."""

    def linearised(self, values: gtsam.Values) -> gtsam.NonlinearFactorGraph:
        """Return linear factors about the values."""


class Solution(NamedTuple):
    """The values reached, their error (half the sum of squares), the iterations taken and whether it converged."""

    values: gtsam.Values
    error: float
    iterations: int
    converged: bool


def solve(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    stopping: Stopping,
    progress: Progress = SILENT,
    stage: str = "solving",
    beside: Beside | None = None,
) -> Solution:
    """Minimise the error of a graph from a start; ``progress`` is called at every iteration with the stage's name.

    Where no step, however short, lowers the error, the start is a minimum. Raises EstimatorError where the error at the
    start is not finite: some measurement or initial value is NaN.
    """
    error = graph.error(start) + (0.0 if beside is None else beside.error(start))
    if not np.isfinite(error):
        raise EstimatorError("the smoother's error is not a number at its start; look for NaN in the measurements")
    solver = _Solver(graph, start, beside)
    here = solver.at(start, error, _FIRST_DAMPING)
    for iteration in range(1, stopping.max_iterations + 1):
        progress.advance(iteration - 1, stopping.max_iterations, stage)
        before, here = here.error, solver.advanced(here)
        if before - here.error <= max(stopping.relative_decrease * here.error, stopping.decrease):
            return Solution(here.values(), here.error, iteration, converged=True)
    return Solution(here.values(), here.error, stopping.max_iterations, converged=False)


class _Reached(NamedTuple):
    """Where a solve has come to: GTSAM's optimizer, which has the values and the damping, and their error."""

    optimizer: gtsam.LevenbergMarquardtOptimizer
    error: float

    def values(self) -> gtsam.Values:
        """Return a copy: GTSAM hands out its own, which do not outlive the next iteration."""
        return gtsam.Values(self.optimizer.values())


class _Solver:
    """Takes the steps of one solve."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, beside: Beside | None) -> None:
        self._graph, self._native, self._beside = graph, gtsam.NonlinearFactorGraph(graph), beside
        self._ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(_together(graph, beside, start))
        self._python = {place: old.factor for place, old in cached_linearisations(graph, start.extract).items()}
        for place in self._python:
            self._native.remove(place)

    def at(self, values: gtsam.Values, error: float, damping: float) -> _Reached:
        """Return an optimizer that goes on from some values, the Python factors linearised there."""
        cached = {place: CachedLinearisation(f, values.extract(f.keys())) for place, f in self._python.items()}
        linearised = with_linearisations(self._graph, cached) if cached else self._graph
        linearised = _together(linearised, self._beside, values)
        return _Reached(gtsam.LevenbergMarquardtOptimizer(linearised, values, self._params(damping)), error)

    def _params(self, damping: float) -> gtsam.LevenbergMarquardtParams:
        params = gtsam.LevenbergMarquardtParams()
        params.setOrdering(self._ordering)
        # On one thread, elimination variable by variable takes three quarters of the time of elimination by cliques.
        params.setLinearSolverType("SEQUENTIAL_CHOLESKY")
        params.setlambdaInitial(damping)
        params.setlambdaUpperBound(_MOST_DAMPING)
        params.setlambdaFactor(_DAMPING_FACTOR)
        return params

    def advanced(self, here: _Reached) -> _Reached:
        """Return where the next step that lowers the error leads; the same place, where none does."""
        if not self._python and self._beside is None:
            here.optimizer.iterate()
            return _Reached(here.optimizer, here.optimizer.error())
        values, tried = here.values(), here.optimizer.lambda_()
        while tried < _MOST_DAMPING:
            here.optimizer.iterate()
            moved = here.values()
            error = self._error(moved)
            if error <= here.error:
                return self.at(moved, error, here.optimizer.lambda_())
            # The linearisations promised more than their factors keep: from here again, in shorter steps.
            tried = _DAMPING_FACTOR * max(tried, _FIRST_DAMPING)
            here = self.at(values, here.error, tried)
        return here

    def _error(self, values: gtsam.Values) -> float:
        own = sum(factor.error(values.extract(factor.keys())) for factor in self._python.values())
        beside = 0.0 if self._beside is None else self._beside.error(values)
        return self._native.error(values) + own + beside


def _together(
    graph: gtsam.NonlinearFactorGraph, beside: Beside | None, values: gtsam.Values
) -> gtsam.NonlinearFactorGraph:
    if beside is None:
        return graph
    whole = gtsam.NonlinearFactorGraph(graph)
    whole.push_back(beside.linearised(values))
    return whole
