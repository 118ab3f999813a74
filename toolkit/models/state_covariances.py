"""The covariance of every state of a solved graph: eliminate once forward in time, recover once backward.

With the landmarks eliminated first and the states in the order of time, each state is a linear function of a few
later ones plus noise: ``x = -R^-1 S x_S + n``. So the joint covariance of a short stretch of states, carried from
the end to the beginning, yields every state's (Golub & Plemmons 1980; Kaess & Dellaert 2009, "Covariance recovery
from a square root information matrix for data association"). GTSAM's Marginals traverses its Bayes tree anew for
each state, which takes a hundred times as long.

Rounding may grow on the way back, where steps between states are known far better than the states, as where the errors
of sightings are correlated and the camera stands. So the covariance of the first state, where the way ends, is also had
by itself: where the two differ, all are refused.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import gtsam
import numpy as np

from toolkit.geometry import Array, IntArray
from toolkit.models.factors import joint_cov
from toolkit.models.motion import MotionModel

_STATES_AT_A_TIME = 10
# A standard deviation may be off by so much of itself: a tenth of what anybody reads in it.
_MOST_ROUNDED = 0.01


class RoundingError(RuntimeError):
    """The covariances of the states came out wrong, and are not known."""


def state_covs(
    linear: gtsam.GaussianFactorGraph, landmark_keys: Sequence[int], motion: MotionModel, poses: Array
) -> Array:
    """Return the covariance (K, d, d) of the states 0 to K - 1, in the order and on the side of an Estimate.

    ``poses`` (K, 4, 4) are theirs. Raises RuntimeError, as GTSAM does, where the graph does not determine them, and
    RoundingError.
    """
    return covs_beside(linear, landmark_keys, motion, poses, ())[0]


def covs_beside(
    linear: gtsam.GaussianFactorGraph,
    landmark_keys: Sequence[int],
    motion: MotionModel,
    poses: Array,
    beside: Sequence[int],
) -> tuple[Array, Array]:
    """Return the covariances of the states as :func:`state_covs`, and (m, m) of the variables beside them.

    Those are of no frame, as the scale of disparities is: they are eliminated after all states.
    """
    states = [motion.keys(k) for k in range(len(poses))]
    together = [*states[:-1], [*states[-1], *beside]]
    covs = list(_recovered(_eliminated(linear, landmark_keys, together), together))[::-1]
    size = motion.layout.size
    covs, of_beside = [cov[:size, :size] for cov in covs], covs[-1][size:, size:]
    _check_first(covs[0], linear, states[0])
    return np.stack([motion.estimate_cov(cov, T[:3, :3]) for cov, T in zip(covs, poses, strict=True)]), of_beside


def _check_first(cov: Array, linear: gtsam.GaussianFactorGraph, keys: list[int]) -> None:
    """Raise RoundingError where the covariance of the first state is not what it is by itself."""
    last = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, keys)
    expected = np.diag(joint_cov(linear.eliminateMultifrontal(last), keys))
    if not np.allclose(np.diag(cov), expected, rtol=2.0 * _MOST_ROUNDED, atol=0.0):
        raise RoundingError("they were lost to rounding on the way from the last state to the first")


def _eliminated(
    linear: gtsam.GaussianFactorGraph, landmark_keys: Sequence[int], states: Sequence[Sequence[int]]
) -> list[gtsam.GaussianConditional]:
    """Return each state's variables given later ones, in the order of time.

    Some states are eliminated at a time, after the landmarks first seen from them. A landmark without its sightings is
    a dense factor on all states that saw it: of all landmarks at once they would take gigabytes.
    """
    parts, rest = _parts(linear, landmark_keys, states), gtsam.GaussianFactorGraph()
    conditionals: list[gtsam.GaussianConditional] = []
    for factors, landmarks, keys in parts:
        factors.push_back(rest)
        net, rest = factors.eliminatePartialSequential(_ordering([*landmarks, *keys]))
        found = {one.firstFrontalKey(): one for one in (net.at(i) for i in range(net.size()))}
        conditionals += [found[key] for key in keys]
    return conditionals


class _Part(NamedTuple):
    """The factors of which some landmarks and states are the first to be eliminated, and the keys of both."""

    factors: gtsam.GaussianFactorGraph
    landmarks: list[int]
    states: list[int]


def _parts(
    linear: gtsam.GaussianFactorGraph, landmark_keys: Sequence[int], states: Sequence[Sequence[int]]
) -> list[_Part]:
    """Divide a graph among stretches of states: a landmark belongs to the first that saw it, with its sightings."""
    part_of = {key: k // _STATES_AT_A_TIME for k, keys in enumerate(states) for key in keys}
    landmarks, count = set(landmark_keys), len(states)
    factors = [linear.at(i) for i in range(linear.size())]
    keys_of = [factor.keys() for factor in factors]
    for keys in keys_of:
        seen_from = [part_of[key] for key in keys if key not in landmarks]
        for key in landmarks.intersection(keys):
            part_of[key] = min([part_of.get(key, count), *seen_from])
    parts = [_Part(gtsam.GaussianFactorGraph(), [], []) for _ in range(0, count, _STATES_AT_A_TIME)]
    for factor, keys in zip(factors, keys_of, strict=True):
        parts[min(part_of[key] for key in keys)].factors.push_back(factor)
    for key in landmark_keys:
        parts[part_of[key]].landmarks.append(key)
    for k, of_state in enumerate(states):
        parts[k // _STATES_AT_A_TIME].states.extend(of_state)
    return parts


def _ordering(keys: Sequence[int]) -> gtsam.Ordering:
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return ordering


class _Stretch:
    """The joint covariance of the states that earlier ones still depend on."""

    def __init__(self) -> None:
        self._keys: list[int] = []
        self._sizes: list[int] = []
        self._cov = np.empty((0, 0))

    def add(self, conditional: gtsam.GaussianConditional) -> None:
        """Add the variable a conditional gives from variables that are here."""
        key, *parents = conditional.keys()
        root = np.linalg.inv(conditional.R())
        gain = -root @ conditional.S()
        cross = gain @ self._cov[self._rows(parents)]
        own = root @ root.T + cross[:, self._rows(parents)] @ gain.T
        self._cov = np.block([[self._cov, cross.T], [cross, own]])
        self._keys.append(key)
        self._sizes.append(len(root))

    def joint(self, keys: Sequence[int]) -> Array:
        """Return the joint covariance of some of the variables."""
        rows = self._rows(keys)
        return np.asarray(self._cov[np.ix_(rows, rows)])

    def keep(self, needed: set[int]) -> None:
        """Forget all other variables."""
        kept = [i for i, key in enumerate(self._keys) if key in needed]
        rows = self._rows([self._keys[i] for i in kept])
        self._cov = self._cov[np.ix_(rows, rows)]
        self._keys, self._sizes = [self._keys[i] for i in kept], [self._sizes[i] for i in kept]

    def _rows(self, keys: Sequence[int]) -> IntArray:
        ends = np.cumsum(self._sizes)
        row_of = {key: range(end - size, end) for key, size, end in zip(self._keys, self._sizes, ends, strict=True)}
        return np.array([row for key in keys for row in row_of[key]], dtype=np.int64)


def _recovered(conditionals: list[gtsam.GaussianConditional], states: Sequence[Sequence[int]]) -> Iterator[Array]:
    """Yield the covariance of each state from the last to the first."""
    stretch, end = _Stretch(), len(conditionals)
    needed_until = _first_dependents(conditionals)
    for keys in reversed(states):
        begin = end - len(keys)
        for conditional in reversed(conditionals[begin:end]):
            stretch.add(conditional)
        yield stretch.joint(keys)
        stretch.keep({key for key, first in needed_until.items() if first < begin})
        end = begin


def _first_dependents(conditionals: list[gtsam.GaussianConditional]) -> dict[int, int]:
    """Return for each variable the first conditional that depends on it."""
    first: dict[int, int] = {}
    for place, conditional in enumerate(conditionals):
        for parent in list(conditional.keys())[1:]:
            first.setdefault(parent, place)
    return first
