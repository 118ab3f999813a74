"""Python factors in an incremental graph: linearised here, kept as linear containers, renewed with their states.

GTSAM's Python binding hands a CustomFactor a copy of *all* values at each call, which grows with the graph until it
is most of the time. Such a factor is therefore linearised at the values of its own keys, and the graph has that
linearisation, which follows its states to first order (LinearContainerFactor). Where one of its states is linearised
anew the factor is, too: what iSAM2 does to every other factor (Kaess et al. 2012, algorithm 5), with the same residual
and the same noise.
"""

from dataclasses import dataclass
from functools import cached_property

import gtsam


@dataclass(frozen=True, eq=False)
class CachedLinearisation:
    """A Python factor and the values (of its keys) it was last linearised at."""

    factor: gtsam.CustomFactor
    linearised_at: gtsam.Values

    @cached_property
    def keys(self) -> tuple[int, ...]:
        """Return the keys of the factor, which GTSAM hands out as a new list each time."""
        return tuple(self.factor.keys())

    def container(self) -> gtsam.LinearContainerFactor:
        """Return the linearisation as a factor of its own."""
        return gtsam.LinearContainerFactor(self.factor.linearize(self.linearised_at), self.linearised_at)


def python_factors(factors: gtsam.NonlinearFactorGraph) -> dict[int, gtsam.CustomFactor]:
    """Return the Python factors of a graph by their place in it."""
    places = ((i, factors.at(i)) for i in range(factors.size()))
    return {i: factor for i, factor in places if isinstance(factor, gtsam.CustomFactor)}


def with_linearisations(
    factors: gtsam.NonlinearFactorGraph, cached: dict[int, CachedLinearisation]
) -> gtsam.NonlinearFactorGraph:
    """Return a copy of the graph with linearisations in their factors' places."""
    graph = gtsam.NonlinearFactorGraph(factors)
    for place, factor in cached.items():
        graph.replace(place, factor.container())
    return graph
