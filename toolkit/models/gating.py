"""Which sightings may correct an estimate: the tests every estimator shares, and their thresholds with sources.

Thresholds that a user may choose are settings (:class:`toolkit.settings.Outliers`). Two places have constants of their
own, which do not change with those of the estimators: the search for a start, which triangulates each frame by itself,
and the held-out metric, which must be the same for all estimators.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import chdtr, chdtrc, chdtri

from toolkit.geometry import Array, BoolArray, IntArray

# Standard deviation of a normal variable over its median absolute deviation; median of a chi-square variable with three
# degrees of freedom.
MAD_TO_SIGMA, CHI2_3_MEDIAN = 1.4826, 2.366
# At this disparity and a pixel of noise the depth is uncertain by 100 %: a landmark waits for a better view.
LEAST_DISPARITY_PX = 1.0
# A point nearer to the camera than this is not triangulated: stereo lenses are not focused there.
LEAST_DEPTH_M = 0.1
# A landmark that only one pose has seen constrains no motion.
FEWEST_SIGHTINGS = 2
# A track whose NIS is this many times the gate's bound holds a mismatch: by chance twice the 95 % quantile is exceeded
# once in 740 tracks of three degrees of freedom (two sightings), once in 30,000 of twelve (five sightings).
MISMATCHED_TRACK_FACTOR = 2.0
# Mismatches are single tracks. Where a larger share of the tracks than this disagrees with the state, the state is
# wrong.
MOST_MISMATCHED = 0.5


def chi2_bound(dof: Array | IntArray | float, probability: float | None) -> Array:
    """Return the quantile of chi-square variables with ``dof`` (N,) degrees of freedom at the given probability.

    It is infinite where the probability is None: there is no gate.
    """
    return np.asarray(chdtri(dof, 1.0 - (1.0 if probability is None else probability)), dtype=float)


def mean_below_bound(dof: IntArray | int, probability: float | None) -> Array:
    """Return the mean (N,) of chi-square variables with ``dof`` (N,) degrees of freedom that passed their gate.

    A test that passes below ``q``, the quantile of ``probability``, leaves a truncated variable, whose mean is not
    ``d`` but ``d F(q; d + 2) / F(q; d)``, F being the distribution function: ``x`` times the density for d is ``d``
    times that for d + 2. At 95 % that is 0.877 d for d = 3, 0.919 d for 6, 0.97 d for 33.
    """
    freedom = np.asarray(dof, dtype=float)
    if probability is None:
        return freedom
    return np.asarray(freedom * chdtr(freedom + 2.0, chi2_bound(dof, probability)) / probability, dtype=float)


def mahalanobis_squared(residuals: Array, covs: Array) -> Array:
    """Return r^T S^-1 r (N,) of residuals (N, d) with covariances (N, d, d)."""
    weighted = np.linalg.solve(covs, residuals[..., None])[..., 0]
    distance: Array = np.einsum("ni,ni->n", residuals, weighted)
    return distance


def huber_weights(distances_squared: Array, threshold: Array | float | None) -> Array:
    """Return the weight (N,) in (0, 1] that Huber's loss gives squared whitened residual norms (N,); 1 without a loss.

    A whitened (uL, uR, v) has a norm of 1.54 in the median (chi distribution): a threshold of 1.5 lowers the weight of
    the larger half of sound sightings a little, and that of a mismatch in inverse proportion to its norm.
    """
    if threshold is None:
        return np.ones_like(distances_squared)
    weights: Array = np.minimum(1.0, threshold / np.sqrt(np.maximum(distances_squared, 1e-12)))
    return weights


def huber_losses(distances_squared: Array, threshold: float | None) -> Array:
    """Return Huber's loss (N,) of squared whitened residual norms (N,): half of them where small, or without a loss."""
    half: Array = 0.5 * distances_squared
    if threshold is None:
        return half
    beyond = threshold * (np.sqrt(distances_squared) - threshold / 2)
    return np.where(distances_squared <= threshold**2, half, beyond)


@dataclass
class FrameGate:
    """Accepts innovations below the chi-square quantile of a probability, counts them, and weighs them by Huber's loss.

    ``huber`` is the loss' threshold for three degrees of freedom, in sigma; None for no loss. ``track_weight``, a
    factor in (0, 1] on an innovation's information, is part of its weight; 1 where the update applies the rig's itself.

    ``nis`` and ``dof`` are sums over the accepted innovations. ``nis_expected`` is the expected sum of NIS if the
    innovations match their covariance; it is less than ``dof``, because the gate has removed the largest ones. Robust
    weights are applied after the test and change neither sum. ``tested`` and ``accepted`` count innovations,
    ``unconverged`` counts iterated updates that did not converge.
    """

    probability: float | None
    huber: float | None = None
    track_weight: float = 1.0
    nis: float = 0.0
    dof: int = 0
    nis_expected: float = 0.0
    tested: int = 0
    accepted: int = 0
    unconverged: int = 0

    def limits(self, most: int) -> tuple[Array, Array]:
        """Return the bound of the NIS and Huber's threshold, infinite without that loss, at 0 to ``most`` degrees."""
        table = self._table(most)
        return table.bound, table.threshold

    def bound(self, dof: IntArray | int) -> Array:
        """Return the gate's bound of the NIS at each number of degrees of freedom (N,)."""
        return np.asarray(self._table(dof).bound[dof])

    def _table(self, dof: IntArray | int) -> "_Table":
        return _table(self.probability, self.huber, _bits(dof))

    def accepts(self, nis: Array, dof: IntArray | int, in_front: BoolArray | bool = True) -> BoolArray:
        """Test and count innovations of NIS (N,) and ``dof`` (N,); return which pass (N,) and are ``in_front``."""
        accepted = np.asarray((nis < self._table(dof).bound[dof]) & in_front)
        self.count(nis, dof, accepted)
        return accepted

    def count(self, nis: Array, dof: IntArray | int, accepted: BoolArray) -> None:
        """Count innovations of NIS (N,) and ``dof`` (N,), of which the ``accepted`` (N,) have passed."""
        passed = nis[accepted]
        count = passed.size
        self.nis += float(passed.sum())
        if isinstance(dof, int):
            self.dof += dof * count
            self.nis_expected += float(self._table(dof).expected[dof]) * count
        elif count:
            freedom = dof[accepted]
            self.dof += int(freedom.sum())
            self.nis_expected += float(self._table(freedom).expected[freedom].sum())
        self.tested += accepted.size
        self.accepted += count

    def weights(self, nis: Array, dof: IntArray | int, accepted: BoolArray) -> Array:
        """Return the weights (N,) of innovations of NIS (N,) and ``dof`` (N,); 0 where not ``accepted`` (N,).

        An accepted innovation has Huber's weight, in (0, 1] and 1 without that loss, times the weight of tracks.
        """
        if self.huber is None:
            return self.track_weight * accepted.astype(float)
        return np.where(accepted, self.track_weight * huber_weights(nis, self._table(dof).threshold[dof]), 0.0)

    def info(self) -> dict[str, float]:
        return {
            "nis": self.nis,
            "nis_dof": self.dof,
            "nis_expected": self.nis_expected,
            "gate_tested": self.tested,
            "gate_accepted": self.accepted,
            "unconverged": self.unconverged,
        }


class _Table(NamedTuple):
    """At each number of degrees of freedom: the gate's bound of the NIS, the mean NIS below it, Huber's threshold."""

    bound: Array
    expected: Array
    threshold: Array


def _bits(dof: IntArray | int) -> int:
    """Return how many bits the largest number of degrees of freedom has."""
    return (max(dof, 1) if isinstance(dof, int) else int(np.max(dof, initial=1))).bit_length()


@lru_cache(maxsize=64)
def _table(probability: float | None, huber: float | None, bits: int) -> _Table:
    """Return bounds, means and thresholds for all numbers of degrees of freedom of at most ``bits`` bits.

    Kept between calls: a filter needs the same few in every frame, and the quantiles take longer than the rest of the
    gate.
    """
    dof = np.arange(2**bits)
    # Exceeded as often as ``huber`` is by residuals of three degrees of freedom.
    threshold = np.full(dof.size, np.inf) if huber is None else np.sqrt(chdtri(dof, chdtrc(3, huber**2)))
    return _Table(chi2_bound(dof, probability), mean_below_bound(dof, probability), threshold)
