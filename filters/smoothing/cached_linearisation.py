"""Python factors in an incremental graph: linearised here, kept as linear containers, renewed as their states move.

GTSAM's Python binding hands a CustomFactor a copy of *all* values at each call, which grows with the graph until it
is most of the time. Such a factor is therefore linearised at the values of its own keys, and the graph has that
linearisation, which follows its states to first order (LinearContainerFactor). Once a state has moved further than
a threshold it is replaced by a new one at the states' values: what iSAM2 does to every other factor (Kaess et al.
2012, algorithm 5), with the same residual and the same noise.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

Read = Callable[[list[int]], gtsam.Values]

# The first order errs by half the square of this times the step's length: far below the step's noise.
RENEW_BEYOND = 0.01


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

    def moved(self, values: gtsam.Values) -> bool:
        """Say whether a state is no longer where the factor was linearised."""
        delta = self.linearised_at.localCoordinates(values)
        return any(np.abs(delta.at(key)).max() > RENEW_BEYOND for key in self.keys)


def cached_linearisations(factors: gtsam.NonlinearFactorGraph, read: Read) -> dict[int, CachedLinearisation]:
    """Linearise the Python factors of a graph at the values ``read`` gives; return them by their place in it."""
    places = ((i, factors.at(i)) for i in range(factors.size()))
    return {i: CachedLinearisation(f, read(f.keys())) for i, f in places if isinstance(f, gtsam.CustomFactor)}


def with_linearisations(
    factors: gtsam.NonlinearFactorGraph, cached: dict[int, CachedLinearisation]
) -> gtsam.NonlinearFactorGraph:
    """Return a copy of the graph with linearisations in their factors' places."""
    graph = gtsam.NonlinearFactorGraph(factors)
    for place, factor in cached.items():
        graph.replace(place, factor.container())
    return graph


def renewed(cached: Iterable[tuple[int, CachedLinearisation]], read: Read) -> dict[int, CachedLinearisation]:
    """Return, by slot, new linearisations of those factors whose states have moved."""
    now = ((slot, old, read(old.factor.keys())) for slot, old in cached)
    return {slot: CachedLinearisation(old.factor, values) for slot, old, values in now if old.moved(values)}
