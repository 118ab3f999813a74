"""Levenberg-Marquardt, one iteration at a time, with the ways a solve can go wrong checked.

The damping is Levenberg's multiple of the identity, as in GTSAM's optimizer: it is divided by ten after a step that
lowered the error, and multiplied by ten after one that did not. GTSAM's optimizer itself would not do: it returns
unchanged values without a message when an error is not a number, it is slow with Python factors (``mixed_graph``), and
it moves landmarks in metres only.

A step of GTSAM's turns a pose about itself and moves a landmark along a straight line, and the two separate where the
step is long. A weakly determined direction, such as the drift of a long drive, is then damped as if it overshot, and a
solve converges slowly or stops far from the minimum (37 m from it, in the mean of the 1010 frames of Dataset 03). From
the first step on that raises the error, landmarks are therefore moved in images
(:class:`~filters.smoothing.landmark_steps.FirstImages`), with hardly any damping.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

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
    after one that lowered it, because damping that step until it lowers the error takes an elimination for each
    attempt. A solve that has used up its iterations still counts as converged if the last one gained no more than a
    share ``enough`` of the error.
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


class _Reached(NamedTuple):
    """The values that a solve has reached, their error, and the damping of its next step."""

    values: gtsam.Values
    error: float
    damping: float


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
    if ordering is None:
        ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(mixed.whole)
    steps = _Steps(mixed, ordering, start.dims(), stopping.at_overshoot)
    in_images = landmarks if landmarks is not None and landmarks.at_once else None
    here = _Reached(start, mixed.error(start), _FIRST_DAMPING if in_images is None else _DAMPING_IN_IMAGES)
    if not np.isfinite(here.error):
        raise EstimatorError("the smoother's error is not a number at its start; look for NaN in the measurements")
    overshot = False
    for iteration in range(1, stopping.max_iterations + 1):
        progress.advance(iteration - 1, total=stopping.max_iterations, stage=stage)
        before, here = here, steps.next(here, in_images)
        gained = before.error - here.error
        if in_images is None and here.damping >= before.damping:
            overshot = True
            if landmarks is not None:
                # That step's damping does not show how near the minimum is, so it never ends the solve.
                in_images, here, gained = landmarks, here._replace(damping=_DAMPING_IN_IMAGES), np.inf
        if gained <= max(stopping.relative_decrease * here.error, stopping.decrease):
            return Solution(here.values, here.error, iteration, True, overshot)
    enough = gained <= stopping.enough * here.error
    return Solution(here.values, here.error, stopping.max_iterations, enough, overshot)


class _Steps:
    """Takes the steps of one solve."""

    def __init__(
        self, graph: MixedGraph, ordering: gtsam.Ordering, sizes: Mapping[int, int], ends_at_overshoot: bool
    ) -> None:
        self._graph, self._ordering, self._sizes, self._ends = graph, ordering, sizes, ends_at_overshoot
        self._has_lowered = False
        # Those of the last damping alone, which far along a solve stays: each takes some megabytes.
        self._damped_by, self._damping_factors = -1.0, gtsam.GaussianFactorGraph()

    def next(self, here: _Reached, images: FirstImages | None) -> _Reached:
        """Return the least damped step that lowers the error, with landmarks moved in images or, if None, in metres.

        Returns the same if none does. If a step raises the error only negligibly the solve is at a minimum: more
        damping would gain no more (GTSAM's rule).
        """
        linear, damping = self._graph.linear(here.values), here.damping
        while damping < _MOST_DAMPING:
            step = self._eliminated(linear, damping)
            if step is not None:
                there = here.values.retract(step) if images is None else images.taken(here.values, step)
                error = self._graph.error(there)
                if error <= here.error:
                    self._has_lowered = True
                    least = 0.0 if images is None else _DAMPING_IN_IMAGES
                    return _Reached(there, error, max(damping / _DAMPING_FACTOR, least))
                if error - here.error < _NEGLIGIBLE_INCREASE * here.error or (self._ends and self._has_lowered):
                    break
            damping *= _DAMPING_FACTOR
        return here

    def _eliminated(self, linear: gtsam.GaussianFactorGraph, damping: float) -> gtsam.VectorValues | None:
        """Return the damped step; None if the linear system does not determine it."""
        if damping != self._damped_by:
            self._damped_by, self._damping_factors = damping, _damping_factors(self._sizes, damping)
        damped = gtsam.GaussianFactorGraph()
        damped.push_back(linear)
        damped.push_back(self._damping_factors)
        try:
            return damped.eliminateSequential(self._ordering).optimize()
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
