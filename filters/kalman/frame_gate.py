"""The chi-square gate of one frame: which innovations may correct the state, and the sums over its tests."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models.gating import chi2_bound, huber_threshold, huber_weights, mean_below_bound


@dataclass
class FrameGate:
    """Accepts innovations below the chi-square quantile of a probability, counts them, and weighs them by Huber's loss.

    ``huber`` is the loss' threshold for three degrees of freedom, in sigma; None for no loss. Every accepted innovation
    is weighted by ``track_weight``, a factor in (0, 1] on its information: the rig's.

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

    def bounds(self, most: int) -> Array:
        """Return the gate's bound of the NIS at each number of degrees of freedom from 0 to ``most``, (most + 1,)."""
        return self._table(most).bound[: most + 1]

    def bound(self, dof: IntArray | int) -> Array:
        """Return the gate's bound of the NIS at each number of degrees of freedom (N,)."""
        return np.asarray(self._table(dof).bound[dof])

    def _table(self, dof: IntArray | int) -> "_Table":
        most = max(dof, 1) if isinstance(dof, int) else int(np.max(dof, initial=1))
        return _table(self.probability, most.bit_length())

    def accepts(self, nis: Array, dof: IntArray | int, in_front: BoolArray | bool = True) -> BoolArray:
        """Test innovations of NIS (N,) and ``dof`` (N,), and count them; return which pass (N,).

        A point that is not ``in_front`` of the camera does not pass.
        """
        accepted = np.asarray((nis < self._table(dof).bound[dof]) & in_front)
        self.count(nis, dof, accepted)
        return accepted

    def count(self, nis: Array, dof: IntArray | int, accepted: BoolArray) -> None:
        """Count innovations of NIS (N,) and ``dof`` (N,), of which the ``accepted`` (N,) have passed."""
        table, count = self._table(dof), int(np.count_nonzero(accepted))
        self.nis += float(nis[accepted].sum())
        if isinstance(dof, int):
            self.dof += dof * count
            self.nis_expected += float(table.expected[dof]) * count
        else:
            self.dof += int(dof[accepted].sum())
            self.nis_expected += float(table.expected[dof][accepted].sum())
        self.tested += accepted.size
        self.accepted += count

    @property
    def weighs(self) -> bool:
        """Say whether accepted innovations may have a weight below 1."""
        return self.huber is not None or self.track_weight != 1.0

    def weights(self, nis: Array, dof: IntArray | int, accepted: BoolArray) -> Array:
        """Return the weights (N,) of innovations of NIS (N,) and ``dof`` (N,); 0 where not ``accepted`` (N,).

        An accepted innovation has Huber's weight, in (0, 1] and 1 without that loss, times the weight of tracks.
        """
        if self.huber is None:
            return self.track_weight * accepted.astype(float)
        return np.where(accepted, self.track_weight * huber_weights(nis, huber_threshold(dof, self.huber)), 0.0)

    def info(self) -> dict[str, float]:
        """Return the counts and sums under the keys of an Estimate's info."""
        return {
            "nis": self.nis,
            "nis_dof": self.dof,
            "nis_expected": self.nis_expected,
            "gate_tested": self.tested,
            "gate_accepted": self.accepted,
            "unconverged": self.unconverged,
        }


class _Table(NamedTuple):
    """At each number of degrees of freedom, from 0 on: the gate's bound of the NIS, and the mean NIS below it."""

    bound: Array
    expected: Array


@lru_cache(maxsize=64)
def _table(probability: float | None, bits: int) -> _Table:
    """Return bounds and means for all numbers of degrees of freedom of at most ``bits`` bits.

    Kept between calls: a filter needs the same few in every frame, and the quantiles take longer than the rest of the
    gate.
    """
    dof = np.arange(2**bits)
    return _Table(chi2_bound(dof, probability), mean_below_bound(dof, probability))
