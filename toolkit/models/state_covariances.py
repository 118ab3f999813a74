"""The covariance of every state of a solved graph: eliminate once, recover from the root of the elimination down.

After elimination each variable is a linear function of some that are eliminated later plus noise,
``x = -R^-1 S x_S + n``, and the joint covariance recovered for the first of those contains all of them (Golub &
Plemmons 1980; Kaess & Dellaert 2009, "Covariance recovery from a square root information matrix for data association").
GTSAM's Marginals traverses its Bayes tree again for each state, which takes a hundred times as long.

Variables that depend on the same later ones, as pose, velocity and biases of one state do, are recovered together: one
by one, in the second order below, all digits are lost within seconds of an IMU.

Two orders are tried, in a sequence that depends on the graph, and the first that holds is taken (docs/estimators.md,
the covariances of `batch`): the order of time, in which every state is recovered from the next, and nested dissection
(George 1973, "Nested dissection of a regular finite element mesh"), in which rounding does not grow from state to
state, but which is slow where landmarks are seen for long and connect hundreds of states. An order holds if some of its
covariances equal those computed for these states separately: for the order of time the first state, where rounding
accumulates, else a few states.

Where neither holds, every landmark is expressed in the directions that the measurements determine, each scaled by its
standard deviation, and undetermined directions are left out: a linear change of a landmark's coordinates changes no
state's covariance, and the depth in metres of one that is thousands of baselines away is nearly undetermined. Where
this does not help either, RoundingError is raised.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import NamedTuple, Self

import gtsam
import numpy as np

from toolkit.geometry import Array
from toolkit.models.factors import linear_factor, ordering_of
from toolkit.models.graph_state import MotionModel

# Accepted relative error of a standard deviation, which is read to a tenth.
_MOST_ROUNDED = 0.01
# A landmark seen by more states than this is eliminated among them and not before.
_MOST_TIED = 50
# Where a landmark is seen by states farther apart, as while a vehicle stands, the order of time is tried first.
_STANDING = 150
# A direction of a variable with less than this share of the information on its best direction is lost in double
# precision: for instance the depth of a landmark beyond 1e10 baselines.
_LEAST_DETERMINED = 1e-10
_dissected = gtsam.Ordering.MetisGaussianFactorGraph


class RoundingError(RuntimeError):
    """Rounding spoilt the covariances of the states; they are not available."""


def state_covs(linear: gtsam.GaussianFactorGraph, motion: MotionModel, poses: Array) -> Array:
    """Return the covariance (K, d, d) of the states 0 to K - 1, in the order and on the side of an Estimate.

    ``poses`` (K, 4, 4) are theirs. Raises RuntimeError, as GTSAM does, where the graph does not determine them, and
    RoundingError.
    """
    states, has_velocity = [motion.keys(k) for k in range(len(poses))], "v" in motion.variable_sizes
    try:
        covs = _of_states(linear, states, has_velocity)
    except RuntimeError:
        kept = {key for state in states for key in state}
        covs = _of_states(_with_orthonormal_landmarks(linear, kept), states, has_velocity)
    return np.stack([motion.estimate_cov(cov, T[:3, :3]) for cov, T in zip(covs, poses, strict=True)])


def _of_states(linear: gtsam.GaussianFactorGraph, states: Sequence[list[int]], has_velocity: bool) -> list[Array]:
    """Return the joint covariance of the variables of each state."""
    tied = _with_states_connected(linear, states)
    some = sorted({0, len(states) // 3, 2 * len(states) // 3})
    failure: RuntimeError = RoundingError("they were lost to rounding")
    spans = _spans(tied, states)
    in_time = partial(_in_time, tied, states, spans), some[:1]
    dissected = partial(_dissected, tied), some
    holds_in_time = has_velocity or any(last - first > _STANDING for first, last in spans.values())
    for order, checked in (in_time, dissected) if holds_in_time else (dissected, in_time):
        try:
            covs = _recovered(_eliminated(tied, order(), states), states)
            pairs = zip(checked, _variances(linear, [states[k] for k in checked]), strict=True)
            if all(np.allclose(np.diag(covs[k]), known, rtol=2.0 * _MOST_ROUNDED, atol=0.0) for k, known in pairs):
                return covs
        except RuntimeError as error:  # a variable that this order finds undetermined
            failure = error
    raise failure


def _with_orthonormal_landmarks(linear: gtsam.GaussianFactorGraph, kept: Collection[int]) -> gtsam.GaussianFactorGraph:
    """Return the graph with all variables but ``kept`` in coordinates whose Jacobians are orthonormal.

    A variable keeps the directions that the graph determines, and is left out if there are none.
    """
    factors, sizes = [linear.at(i) for i in range(linear.size())], linear.gradientAtZero()
    blocks = defaultdict[int, list[Array]](list)
    for factor in factors:
        for key, block in _terms(factor, sizes):
            if key not in kept:
                blocks[key].append(block)
    directions = {key: _determined_directions(np.vstack(rows)) for key, rows in blocks.items()}
    graph = gtsam.GaussianFactorGraph()
    for factor in factors:
        terms = [(key, block @ directions[key] if key in directions else block) for key, block in _terms(factor, sizes)]
        if left := [(key, block) for key, block in terms if block.shape[1]]:
            graph.add(linear_factor(left, factor.jacobian()[1]))
    return graph


def _terms(factor: gtsam.GaussianFactor, sizes: gtsam.VectorValues) -> list[tuple[int, Array]]:
    """Return the variables of a factor with their whitened Jacobians."""
    keys = list(factor.keys())
    ends = np.cumsum([sizes.at(key).size for key in keys])
    return list(zip(keys, np.split(factor.jacobian()[0], ends[:-1], axis=1), strict=True))


def _determined_directions(jacobian: Array) -> Array:
    """Return the directions (d, r) that a Jacobian (m, d) determines, each scaled to its standard deviation."""
    _, per_unit, directions = np.linalg.svd(jacobian, full_matrices=False)
    determined = per_unit > _LEAST_DETERMINED * per_unit[0]
    return np.asarray(directions[determined].T / per_unit[determined])


def _variances(linear: gtsam.GaussianFactorGraph, states: Sequence[list[int]]) -> list[Array]:
    """Return the variances of the variables of some states, all others eliminated variable by variable.

    Elimination by cliques would fail here: after hundreds of frames a pose is so much more uncertain than a step that
    both in one clique exceed the condition number that GTSAM allows.
    """
    keys = [key for state in states for key in state]
    last = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, keys)
    _, left = linear.eliminatePartialSequential(ordering_of(_others(last, keys)))
    information, _ = left.hessian(ordering_of(keys))
    size = linear.gradientAtZero()
    ends = np.cumsum([sum(size.at(key).size for key in state) for state in states])
    return np.split(np.diag(np.linalg.inv(information)), ends[:-1])


def _with_states_connected(
    linear: gtsam.GaussianFactorGraph, states: Iterable[Sequence[int]]
) -> gtsam.GaussianFactorGraph:
    """Return the graph with added factors of zero information that connect the variables of each state."""
    graph, sizes = gtsam.GaussianFactorGraph(), linear.gradientAtZero()
    graph.push_back(linear)
    unit = gtsam.noiseModel.Unit.Create(1)
    for first, *others in states:
        for other in others:
            nothing = [np.zeros((1, sizes.at(key).size)) for key in (first, other)]
            graph.add(gtsam.JacobianFactor(first, nothing[0], other, nothing[1], np.zeros(1), unit))
    return graph


def _in_time(
    graph: gtsam.GaussianFactorGraph, states: Sequence[Sequence[int]], spans: Mapping[int, tuple[int, int]]
) -> gtsam.Ordering:
    """Return the order of the states as given, after the landmarks.

    Eliminating a landmark leaves a dense factor on all states that saw it. A landmark seen for long, as while a vehicle
    stands, is eliminated after the last of these states and until then is in the clique of each: some hundred rows
    instead of thousands.
    """
    landmarks = _others(gtsam.Ordering.ColamdGaussianFactorGraph(graph), {key for state in states for key in state})
    waiting = {key: last for key, (first, last) in spans.items() if last - first > _MOST_TIED}
    before = defaultdict[int, list[int]](list)
    for key, last in waiting.items():
        before[last].append(key)
    in_states = [key for i, state in enumerate(states) for key in (*before[i], *state)]
    return ordering_of([*(key for key in landmarks if key not in waiting), *in_states])


def _spans(graph: gtsam.GaussianFactorGraph, states: Sequence[Sequence[int]]) -> dict[int, tuple[int, int]]:
    """Return the first and the last state with which each landmark shares a factor."""
    place = {key: i for i, state in enumerate(states) for key in state}
    # As arrays: a long recording has a hundred thousand factors.
    count = graph.size()
    keys = np.fromiter(chain.from_iterable(graph.at(i).keys() for i in range(count)), np.int64)
    factor = np.repeat(np.arange(count), [graph.at(i).size() for i in range(count)])
    different, row = np.unique(keys, return_inverse=True)
    state_of = np.array([place.get(key, -1) for key in different.tolist()])[row]
    inside = state_of >= 0
    low, high = np.full(count, len(states)), np.full(count, -1)
    np.minimum.at(low, factor[inside], state_of[inside])
    np.maximum.at(high, factor[inside], state_of[inside])
    shared = ~inside & (high[factor] >= 0)
    others, row = np.unique(keys[shared], return_inverse=True)
    first, last = np.full(others.size, len(states)), np.full(others.size, -1)
    np.minimum.at(first, row, low[factor[shared]])
    np.maximum.at(last, row, high[factor[shared]])
    return dict(zip(others.tolist(), zip(first.tolist(), last.tolist(), strict=True), strict=True))


def _others(ordering: gtsam.Ordering, without: Collection[int]) -> list[int]:
    left_out = frozenset(without)
    return [key for key in (ordering.at(i) for i in range(ordering.size())) if key not in left_out]


def _eliminated(
    graph: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, states: Iterable[Sequence[int]]
) -> list[gtsam.GaussianConditional]:
    """Return the conditionals on later variables, in the order of elimination, of states and of what these depend on.

    Those of the other variables, landmarks mostly, are not kept: of a minute indoors they are 150 MB.
    """
    net, kept = graph.eliminateSequential(ordering), list[gtsam.GaussianConditional]()
    needed = {key for state in states for key in state}
    for conditional in (net.at(i) for i in range(net.size())):
        if conditional.firstFrontalKey() in needed:
            needed.update(conditional.keys())
            kept.append(conditional)
    return kept


class _Clique(NamedTuple):
    """Conditionals of variables, eliminated one after the other, that depend on the same later ones.

    ``sizes`` are the variables' dimensions (f in all) by key, ``later`` the keys of those that they depend on.
    """

    conditionals: Sequence[gtsam.GaussianConditional]
    sizes: dict[int, int]
    later: list[int]

    @classmethod
    def of(cls, conditionals: Sequence[gtsam.GaussianConditional]) -> Self:
        sizes = {one.firstFrontalKey(): len(one.R()) for one in conditionals}
        return cls(conditionals, sizes, list(conditionals[-1].keys())[1:])

    def gain_and_cov(self, later_sizes: dict[int, int]) -> tuple[Array, Array]:
        """Return the gain (f, m) and the covariance (f, f) of n: ``R x = -S x_later + e`` as ``x = gain x_later + n``.

        They are made when they are needed: those of all cliques together take as much memory as their conditionals.
        """
        columns, size = _rows(self.sizes | later_sizes), sum(self.sizes.values())
        terms = np.zeros((size, size + sum(later_sizes.values())))
        for conditional in self.conditionals:
            key, *after = conditional.keys()
            terms[np.ix_(columns[key], columns[key])] = conditional.R()
            terms[np.ix_(columns[key], _together(columns, after))] = conditional.S()
        root = np.linalg.inv(terms[:, :size])
        return -root @ terms[:, size:], root @ root.T


def _cliques(conditionals: Sequence[gtsam.GaussianConditional]) -> list[_Clique]:
    """Return conditionals as cliques, in the order of elimination."""
    parts, later = list[list[gtsam.GaussianConditional]](), frozenset[int]()
    for conditional in conditionals:
        key, *after = conditional.keys()
        if parts and later == {key, *after}:
            parts[-1].append(conditional)
        else:
            parts.append([conditional])
        later = frozenset(after)
    return [_Clique.of(part) for part in parts]


class _Joint(NamedTuple):
    """The joint covariance of variables, with the rows of each by its key."""

    rows: dict[int, range]
    cov: Array

    def of(self, keys: Sequence[int]) -> Array:
        """Return the joint covariance of some of the variables, in the order of the keys."""
        rows = _together(self.rows, keys)
        return np.asarray(self.cov[np.ix_(rows, rows)])

    def extended(self, clique: _Clique) -> "_Joint":
        """Return the joint covariance of a clique and of what it depends on, all of which must be present."""
        later, later_sizes = self.of(clique.later), {key: len(self.rows[key]) for key in clique.later}
        gain, own = clique.gain_and_cov(later_sizes)
        across = gain @ later
        cov = np.block([[own + across @ gain.T, across], [across.T, later]])
        return _Joint(_rows(clique.sizes | later_sizes), cov)


def _rows(sizes: Mapping[int, int]) -> dict[int, range]:
    ends = np.cumsum(list(sizes.values())).tolist()
    return {key: range(end - size, end) for (key, size), end in zip(sizes.items(), ends, strict=True)}


def _together(rows: Mapping[int, range], keys: Iterable[int]) -> list[int]:
    return [row for key in keys for row in rows[key]]


def _recovered(conditionals: list[gtsam.GaussianConditional], states: Sequence[Sequence[int]]) -> list[Array]:
    """Return the joint covariance of the variables of each state, from the conditionals in the order of elimination."""
    place = {one.firstFrontalKey(): i for i, one in enumerate(conditionals)}
    cliques = _cliques(conditionals)
    clique_of = {key: i for i, clique in enumerate(cliques) for key in clique.sizes}
    # The first variable that a clique depends on depends itself on all the others.
    next_of = [clique_of[min(one.later, key=place.__getitem__)] if one.later else None for one in cliques]
    states_of = defaultdict[int, list[Sequence[int]]](list)
    for state in states:
        states_of[clique_of[min(state, key=place.__getitem__)]].append(state)
    joints, waiting, covs = dict[int | None, _Joint](), Counter(next_of), dict[int, Array]()
    joints[None] = _Joint({}, np.empty((0, 0)))
    for i in reversed(range(len(cliques))):
        joint = joints[next_of[i]].extended(cliques[i])
        covs |= {state[0]: joint.of(state) for state in states_of[i]}
        if waiting[i]:
            joints[i] = joint
        waiting[next_of[i]] -= 1
        if not waiting[next_of[i]]:
            del joints[next_of[i]]
    return [covs[state[0]] for state in states]
