"""Levenberg-Marquardt on GTSAM's linearisation and elimination, with every solve checked.

GTSAM's own optimizer hands a Python factor a fresh copy of all values at each call, which makes a thousand
twist factors ten times dearer than sixty thousand stereo factors; and it returns unchanged values without a
word when an error is not a number. The algorithm is Levenberg's with identity damping, raised and lowered
tenfold (Marquardt 1963), which is what GTSAM's defaults do.
"""

from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np

from toolkit.errors import EstimatorError

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING, _FACTOR = 1e-5, 1e-12, 1e8, 10.0


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


def solve(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, stopping: Stopping) -> Solution:
    """Minimise the error of a graph from a start.

    Raises EstimatorError where the error at the start is not finite: some measurement or initial value is NaN.
    """
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
    values, error, damping = start, graph.error(start), _FIRST_DAMPING
    if not np.isfinite(error):
        raise EstimatorError("the smoother's error is not a number at its start; look for NaN in the measurements")
    for iteration in range(1, stopping.max_iterations + 1):
        linear = graph.linearize(values)
        while True:
            tried = _tried(linear, values, damping, ordering)
            tried_error = np.inf if tried is None else graph.error(tried)
            if np.isfinite(tried_error) and tried_error <= error:
                break
            damping *= _FACTOR
            if damping > _MOST_DAMPING:
                # No step, however short, lowers the error any more: a minimum, if the system could be solved.
                return Solution(values, error, iteration, converged=tried is not None)
        decrease, values, error = error - tried_error, tried, tried_error
        damping = max(damping / _FACTOR, _LEAST_DAMPING)
        if decrease <= stopping.relative_decrease * error:
            return Solution(values, error, iteration, converged=True)
    return Solution(values, error, stopping.max_iterations, converged=False)


def _tried(
    linear: gtsam.GaussianFactorGraph, values: gtsam.Values, damping: float, ordering: gtsam.Ordering
) -> gtsam.Values | None:
    """Return the values after one damped step, or None where even the damped system is indeterminate."""
    damped = gtsam.GaussianFactorGraph()
    damped.push_back(linear)
    for dimension, keys in _keys_by_dimension(values).items():
        prior, zero = np.sqrt(damping) * np.eye(dimension), np.zeros(dimension)
        for key in keys:
            damped.add(key, prior, zero)
    try:
        return values.retract(damped.optimize(ordering))
    except RuntimeError as error:
        if "Indeterminate" in str(error):
            return None
        raise


def _keys_by_dimension(values: gtsam.Values) -> dict[int, list[int]]:
    grouped: dict[int, list[int]] = {}
    for key, dimension in values.dims().items():
        grouped.setdefault(dimension, []).append(key)
    return grouped
