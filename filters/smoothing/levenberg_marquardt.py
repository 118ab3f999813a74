"""Levenberg-Marquardt, one iteration at a time, with the ways a solve can go wrong checked.

GTSAM's optimizer returns unchanged values without a message when an error is not a number, so the error is checked
first. GTSAM also passes a Python factor a copy of all values at each call, which makes a thousand twist factors take
ten times as long as sixty thousand stereo factors. Graphs with Python factors are therefore solved here, and factors of
one form are linearised and evaluated at once if a stack of them is given. The damping is Levenberg's multiple of the
identity in both cases: it is divided by ten after a step that lowered the error, and multiplied by ten after one that
did not.

A step of GTSAM's turns a pose about itself and moves a landmark along a straight line, and the two separate where the
step is long. A weakly determined direction, such as the drift of a long drive, is then damped as if it overshot, and a
solve converges slowly or stops far from the minimum (37 m from it, in the mean of the 1010 frames of Dataset 03). From
the first step on that raises the error, landmarks are therefore moved in images
(:class:`~filters.smoothing.landmark_steps.FirstImages`), with hardly any damping.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol, TypeVar

import gtsam
import numpy as np

from filters.smoothing.indeterminate import variable_named
from filters.smoothing.landmark_steps import FirstImages
from filters.smoothing.mixed_graph import MixedGraph
from toolkit.errors import EstimatorError
from toolkit.progress import SILENT, Progress

_FIRST_DAMPING, _MOST_DAMPING, _DAMPING_FACTOR = 1e-3, 1e8, 10.0
# Damping of steps in images, which overshoot little; with less, GTSAM finds far landmarks undetermined.
_DAMPING_IN_IMAGES = 1e-7
# Least decrease of the error, half a sum of squares in sigma: with exact measurements the error is near zero, and a
# relative criterion is never met.
_LEAST_DECREASE = 1e-12
# If a step raises the error by less than this share of it, the solve is at a minimum.
_NEGLIGIBLE_INCREASE = 1e-5


@dataclass(frozen=True)
class Stopping:
    """When to stop: at a small decrease of the error, absolute or relative to it, or after too many iterations.

    ``at_overshoot`` is for a solve that need not reach the minimum: it ends at the first step that raises the error
    after one that lowered it, where steps are taken here, because damping that step until it lowers the error takes an
    elimination for each attempt. A solve that has used up its iterations still counts as converged if the last one
    gained no more than a share ``enough`` of the error.
    """

    relative_decrease: float = 1e-5
    max_iterations: int = 50
    decrease: float = _LEAST_DECREASE
    at_overshoot: bool = False
    enough: float = 0.0


class Solution(NamedTuple):
    """The values reached, their error (half the sum of squares), the iterations taken and whether it converged.

    ``overshot`` says whether a step of landmarks in metres raised the error.
    """

    values: gtsam.Values
    error: float
    iterations: int
    converged: bool
    overshot: bool = False


def solve(
    graph: gtsam.NonlinearFactorGraph | MixedGraph,
    start: gtsam.Values,
    stopping: Stopping,
    progress: Progress = SILENT,
    stage: str = "solving",
    landmarks: FirstImages | None = None,
    ordering: gtsam.Ordering | None = None,
) -> Solution:
    """Minimise the error of a graph from a start; ``progress`` is called at every iteration with the stage's name.

    ``landmarks`` are the images in which the graph's landmarks are moved once a step in metres has raised the error.
    ``ordering`` is the elimination order, by default COLAMD's.

    If no step, however short, lowers the error, the start is a minimum. Raises EstimatorError if the error at the start
    is not finite: some measurement or initial value is NaN.
    """
    mixed = graph if isinstance(graph, MixedGraph) else MixedGraph(graph)
    error = mixed.error(start)
    if not np.isfinite(error):
        raise EstimatorError("the smoother's error is not a number at its start; look for NaN in the measurements")
    advance = partial(progress.advance, total=stopping.max_iterations, stage=stage)
    if ordering is None:
        ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(mixed.whole)
    in_metres = _GraphSolver(mixed, ordering, stopping.at_overshoot)
    solver = _ImageSolver(in_metres, landmarks) if landmarks is not None else in_metres
    return _solved(solver, start, error, stopping, advance)._replace(overshot=in_metres.overshot)


class _SolveState(Protocol):
    """The state of a solve: its error, and whether damping kept its last step short."""

    @property
    def error(self) -> float: ...
    @property
    def is_limited(self) -> bool: ...
    def values(self) -> gtsam.Values: ...


State = TypeVar("State", bound=_SolveState)


class _Solver(Protocol[State]):
    """Takes the steps of one solve."""

    def started(self, values: gtsam.Values, error: float) -> State:
        """Return the initial state of the solve."""

    def advanced(self, here: State) -> State:
        """Return the state after the next step that lowers the error; the same state if none does."""


def _solved(
    solver: _Solver[State],
    start: gtsam.Values,
    error: float,
    stopping: Stopping,
    advance: Callable[[int], None],
) -> Solution:
    here, enough = solver.started(start, error), False
    for iteration in range(1, stopping.max_iterations + 1):
        advance(iteration - 1)
        before, here = here.error, solver.advanced(here)
        little = before - here.error <= max(stopping.relative_decrease * here.error, stopping.decrease)
        if little and not here.is_limited:
            return Solution(here.values(), here.error, iteration, converged=True)
        enough = before - here.error <= stopping.enough * here.error and not here.is_limited
    return Solution(here.values(), here.error, stopping.max_iterations, converged=enough)


class _GtsamState(NamedTuple):
    """The state of a solve by GTSAM's optimizer, which has the values and the damping, and its error."""

    optimizer: gtsam.LevenbergMarquardtOptimizer
    error: float
    is_limited: bool = False

    @property
    def damping(self) -> float:
        """Return the damping of the next step."""
        return self.optimizer.lambda_()

    def values(self) -> gtsam.Values:
        """Return a copy of the values: GTSAM's own do not outlive the next iteration."""
        return gtsam.Values(self.optimizer.values())


class _DampedState(NamedTuple):
    """The state of a solve: its values, its error, and the damping of its next step."""

    reached: gtsam.Values
    error: float
    damping: float
    is_limited: bool = False

    def values(self) -> gtsam.Values:
        """Return the values."""
        return self.reached


class _GraphSolver:
    """Takes the steps of a solve of factors alone: by GTSAM's optimizer if none of them is a Python factor."""

    def __init__(self, graph: MixedGraph, ordering: gtsam.Ordering, ends_at_overshoot: bool = False) -> None:
        self._graph, self._ordering, self._ends_at_overshoot = graph, ordering, ends_at_overshoot
        # Whether a step raised the error, and whether one lowered it.
        self.overshot, self._lowered = False, False
        self._damping_factors: dict[float, gtsam.GaussianFactorGraph] = {}

    def started(self, values: gtsam.Values, error: float) -> _GtsamState | _DampedState:
        """Return the initial state of the solve."""
        if self._graph.has_python:
            return _DampedState(values, error, _FIRST_DAMPING)
        optimizer = gtsam.LevenbergMarquardtOptimizer(self._graph.native, values, self._params())
        return _GtsamState(optimizer, error)

    def _params(self) -> gtsam.LevenbergMarquardtParams:
        params = gtsam.LevenbergMarquardtParams()
        params.setOrdering(self._ordering)
        # On one thread, elimination by variables takes three quarters of the time of elimination by cliques.
        params.setLinearSolverType("SEQUENTIAL_CHOLESKY")
        params.setlambdaInitial(_FIRST_DAMPING)
        params.setlambdaUpperBound(_MOST_DAMPING)
        params.setlambdaFactor(_DAMPING_FACTOR)
        return params

    def advanced(self, here: _GtsamState | _DampedState) -> _GtsamState | _DampedState:
        """Return the state after the next step that lowers the error; the same state if none does."""
        tried, there = here.damping, self._stepped_in_metres(here)
        self.overshot |= there.damping >= tried
        return there

    def _stepped_in_metres(self, here: _GtsamState | _DampedState) -> _GtsamState | _DampedState:
        if isinstance(here, _DampedState):
            return self.stepped(here, gtsam.Values.retract, 0.0)
        here.optimizer.iterate()
        return _GtsamState(here.optimizer, here.optimizer.error())

    def stepped(
        self,
        here: _DampedState,
        taken: Callable[[gtsam.Values, gtsam.VectorValues], gtsam.Values],
        least_damping: float,
    ) -> _DampedState:
        """Return the state after the least damped step that lowers the error; ``taken`` applies a step to values.

        If a step raises the error only negligibly the state is at a minimum: more damping would gain no more (GTSAM's
        rule).
        """
        linear, damping = self._graph.linear(here.reached), here.damping
        while damping < _MOST_DAMPING:
            step = self._step(linear, here.reached, damping)
            if step is not None:
                there = taken(here.reached, step)
                error = self._graph.error(there)
                if error <= here.error:
                    self._lowered = True
                    return _DampedState(there, error, max(damping / _DAMPING_FACTOR, least_damping))
                if error - here.error < _NEGLIGIBLE_INCREASE * here.error or (
                    self._ends_at_overshoot and self._lowered
                ):
                    break
            damping *= _DAMPING_FACTOR
        return here._replace(is_limited=False)

    def _step(
        self, linear: gtsam.GaussianFactorGraph, values: gtsam.Values, damping: float
    ) -> gtsam.VectorValues | None:
        """Return the damped step from some values; None if the linear system does not determine it."""
        if damping not in self._damping_factors:
            self._damping_factors[damping] = _damping_factors(values.dims(), damping)
        return _eliminated(_joined(linear, self._damping_factors[damping]), self._ordering)


class _ImageSolver:
    """Takes steps in metres until one raises the error, and from then on steps whose landmarks move in images.

    The rejected step's damping does not show how near the minimum is, so that step never ends the solve.
    """

    def __init__(self, in_metres: _GraphSolver, images: FirstImages) -> None:
        self._in_metres, self._images = in_metres, images

    def started(self, values: gtsam.Values, error: float) -> _GtsamState | _DampedState:
        """Return the initial state of the solve."""
        if self._images.at_once:
            return _DampedState(values, error, _DAMPING_IN_IMAGES)
        return self._in_metres.started(values, error)

    def advanced(self, here: _GtsamState | _DampedState) -> _GtsamState | _DampedState:
        """Return the state after the next step that lowers the error; the same state if none does."""
        if self._images.at_once or self._in_metres.overshot:
            assert isinstance(here, _DampedState)
            return self._in_metres.stepped(here, self._images.taken, _DAMPING_IN_IMAGES)
        there = self._in_metres.advanced(here)
        if self._in_metres.overshot:
            return _DampedState(there.values(), there.error, _DAMPING_IN_IMAGES, is_limited=True)
        return there


def _joined(one: gtsam.GaussianFactorGraph, other: gtsam.GaussianFactorGraph) -> gtsam.GaussianFactorGraph:
    both = gtsam.GaussianFactorGraph()
    both.push_back(one)
    both.push_back(other)
    return both


def _eliminated(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.VectorValues | None:
    """Return the solution of a linear system; None if it is indeterminate."""
    try:
        return linear.eliminateSequential(ordering).optimize()
    except RuntimeError as refusal:
        variable_named(refusal)
        return None


def _damping_factors(sizes: Mapping[int, int], damping: float) -> gtsam.GaussianFactorGraph:
    """Return factors that damp variables, whose keys have sizes, at their values."""
    graph = gtsam.GaussianFactorGraph()
    of_size = {size: np.sqrt(damping) * np.eye(size) for size in set(sizes.values())}
    for key, size in sizes.items():
        graph.add(key, of_size[size], np.zeros(size), gtsam.noiseModel.Unit.Create(size))
    return graph
