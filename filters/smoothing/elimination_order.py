"""The elimination order of a smoother's graph: COLAMD's, or the order of time where the vehicle stands still.

COLAMD (Davis, Gilbert, Larimore and Ng 2004, "A column approximate minimum degree ordering algorithm") is faster where
landmarks come and go. While a vehicle stands, hundreds of states see the same landmarks. In the order of time such a
landmark is eliminated after the last state that saw it, and a state depends only on the next state and the landmarks
not yet eliminated. The choice is made by counting: both orders are eliminated symbolically, and the one with fewer
operations is taken. Counting takes the time of half an iteration, so it is done only where a landmark is seen so often
that the two orders may differ.
"""

from collections import defaultdict
from collections.abc import Callable
from itertools import combinations

import gtsam
import numpy as np

from toolkit.geometry import IntArray
from toolkit.measurements import StereoFrame
from toolkit.models.factors import L, X, kind_of, ordering_of

Order = Callable[[gtsam.NonlinearFactorGraph, list[StereoFrame]], gtsam.Ordering]

# In the order of time, a landmark seen from more states than this is eliminated after the last of them.
_MOST_TIED = 50
# If no landmark is seen from more states than this, COLAMD is taken without counting.
_FEWEST_STANDING = 150
# Dimension of each kind of variable. The bias of twists has half of it, which does not change the choice.
_SIZES = {"x": 6, "v": 3, "b": 6, "l": 3}


def cheaper_order(motion: gtsam.NonlinearFactorGraph, frames: list[StereoFrame]) -> Order:
    """Return the cheaper order for a graph with these motion factors; state k sees the landmarks of frame k."""
    if max((count for _, count, _ in _landmarks(frames)), default=0) <= _FEWEST_STANDING:
        return by_colamd
    graph = _symbolic(motion, frames)
    colamd, along = gtsam.Ordering.ColamdSymbolicFactorGraph(graph), in_time(graph, frames)
    return in_time if _operations(graph, along) < _operations(graph, colamd) else by_colamd


def by_colamd(graph: gtsam.NonlinearFactorGraph, _frames: list[StereoFrame]) -> gtsam.Ordering:
    return gtsam.Ordering.ColamdNonlinearFactorGraph(graph)


def in_time(graph: gtsam.NonlinearFactorGraph | gtsam.SymbolicFactorGraph, frames: list[StereoFrame]) -> gtsam.Ordering:
    """Return landmarks first, then states in time, each followed by the landmarks last seen from it, the rest last."""
    wait = {L(track_id): last for track_id, count, last in _landmarks(frames) if count > _MOST_TIED}
    first, of_states, rest = list[int](), defaultdict[int, list[int]](list), list[int]()
    for key in sorted(graph.keys()):  # landmarks come before poses and velocities
        kind = kind_of(key)
        if kind == "l" and key not in wait:
            first.append(key)
        elif kind in "xvbl":
            of_states[wait.get(key, gtsam.Symbol(key).index())].append(key)
        else:
            rest.append(key)
    return ordering_of([*first, *(key for k in sorted(of_states) for key in of_states[k]), *rest])


def _operations(graph: gtsam.SymbolicFactorGraph, ordering: gtsam.Ordering) -> int:
    """Return the operations of an elimination, in proportion: rows times the squared number of columns they involve."""
    net, total = graph.eliminateSequential(ordering), 0
    for conditional in map(net.at, range(net.size())):
        sizes = [_SIZES[kind_of(key)] for key in conditional.keys()]  # noqa: SIM118 - not a mapping
        total += sizes[0] * sum(sizes) ** 2
    return total


def _landmarks(frames: list[StereoFrame]) -> list[tuple[int, int, int]]:
    """Return the id of each track, the number of frames that see it, and the last of them."""
    sizes = [frame.track_ids.size for frame in frames]
    frame: IntArray = np.repeat(np.arange(len(frames)), sizes)
    ids, track, counts = np.unique(
        np.concatenate([f.track_ids for f in frames]), return_inverse=True, return_counts=True
    )
    last = np.zeros(ids.size, dtype=np.int64)
    np.maximum.at(last, track, frame)
    return list(zip(ids.tolist(), counts.tolist(), last.tolist(), strict=True))


def _symbolic(motion: gtsam.NonlinearFactorGraph, frames: list[StereoFrame]) -> gtsam.SymbolicFactorGraph:
    graph = gtsam.SymbolicFactorGraph()
    for keys in (motion.at(i).keys() for i in range(motion.size())):
        for tied in combinations(keys, 2) if len(keys) > 1 else [keys]:
            graph.push_factor(*tied)
    for k, frame in enumerate(frames):
        for track_id in frame.track_ids.tolist():
            graph.push_factor(X(k), L(track_id))
    return graph
