"""Python factors in an incremental graph: linearised here, stored as linear containers, relinearised with their states.

GTSAM's Python binding passes a CustomFactor a copy of *all* values at each call. The copy grows with the graph until it
takes most of the time. Such a factor is therefore linearised at the values of its own keys, and the graph holds that
linearisation, which follows its states to first order (LinearContainerFactor). When one of its states is relinearised,
so is the factor, as iSAM2 does with every other factor (Kaess et al. 2012, algorithm 5), with the same residual and the
same noise.
"""

from dataclasses import dataclass
from functools import cached_property

import gtsam


@dataclass(frozen=True, eq=False)
class CachedLinearisation:
    """A Python factor and the values (of its keys) at which it was last linearised."""

    factor: gtsam.CustomFactor
    linearised_at: gtsam.Values

    @cached_property
    def keys(self) -> tuple[int, ...]:
        """Return the keys of the factor; GTSAM builds a new list at each call."""
        return tuple(self.factor.keys())

    def container(self) -> gtsam.LinearContainerFactor:
        """Return the linearisation as a factor."""
        return gtsam.LinearContainerFactor(self.factor.linearize(self.linearised_at), self.linearised_at)


def with_linearisations(
    factors: gtsam.NonlinearFactorGraph, cached: dict[int, CachedLinearisation]
) -> gtsam.NonlinearFactorGraph:
    """Return a copy of the graph with factors replaced by their linearisations."""
    graph = gtsam.NonlinearFactorGraph(factors)
    for place, factor in cached.items():
        graph.replace(place, factor.container())
    return graph
