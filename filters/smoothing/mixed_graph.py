"""A graph of GTSAM's own factors and of Python factors, linearised and evaluated in stacks or one by one."""

from collections.abc import Sequence

import gtsam
import numpy as np

from filters.smoothing.cached_linearisation import python_factors
from toolkit.models.stacked_factors import StackedFactors, linear_factors


class MixedGraph:
    """A graph in the form a solver takes; ``stacks`` replace its Python factors on the same variables.

    GTSAM passes a Python factor a copy of all values at each call, and calls them one at a time.
    """

    def __init__(self, graph: gtsam.NonlinearFactorGraph, stacks: Sequence[StackedFactors] = ()) -> None:
        self.whole, self.native = graph, gtsam.NonlinearFactorGraph(graph)
        python = python_factors(graph)
        for place in python:
            self.native.remove(place)
        stacked = {keys for stack in stacks for keys in stack.keys}
        self._stacks = stacks
        self._single = [factor for factor in python.values() if tuple(factor.keys()) not in stacked]

    @property
    def has_python(self) -> bool:
        """Say whether the graph has Python factors."""
        return bool(self._stacks or self._single)

    def linear(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        """Return the graph linearised at some values."""
        linear = self.native.linearize(values)
        for stack in self._stacks:
            for factor in linear_factors(stack, values):
                linear.add(factor)
        for single in self._single:
            linear.add(single.linearize(values.extract(single.keys())))
        return linear

    def error(self, values: gtsam.Values) -> float:
        """Return half the sum of squares, or the sum of losses."""
        stacked = sum(0.5 * float(np.square(stack.residuals(values)).sum()) for stack in self._stacks)
        one_by_one = sum(factor.error(values.extract(factor.keys())) for factor in self._single)
        return self.native.error(values) + stacked + one_by_one
