"""The chi-square gate of one frame: which innovations may correct, and what its tests add up to."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models.gating import chi2_bound, huber_threshold, huber_weights, mean_below_bound


@dataclass
class FrameGate:
    """Accepts innovations below the chi-square quantile of a probability, counts them, and weighs them by Huber's loss.

    ``huber`` is the loss' threshold for three degrees of freedom, in sigma; None for no loss. ``share`` is the share of
    its information that any accepted innovation counts for.

    ``nis`` and ``dof`` are sums over what was accepted, and ``nis_expected`` what the first is expected to be where the
    innovations are as large as their covariance says: less than ``dof``, for the gate took the largest away. Robust
    weights come after the test and change neither. ``tested`` and ``accepted`` numbers of innovations, and
    ``unconverged`` the number of iterated updates that were broken off.
    """

    probability: float | None
    huber: float | None = None
    share: float = 1.0
    nis: float = 0.0
    dof: int = 0
    nis_expected: float = 0.0
    tested: int = 0
    accepted: int = 0
    unconverged: int = 0

    def bounds(self, most: int) -> Array:
        """Return the NIS that is just accepted at each number of degrees of freedom up to the most, (most + 1,)."""
        return self._table(most).bound[: most + 1]

    def bound(self, dof: IntArray | int) -> Array:
        """Return the NIS that is just accepted at each number of degrees of freedom (N,)."""
        return np.asarray(self._table(dof).bound[dof])

    def _table(self, dof: IntArray | int) -> "_Table":
        most = max(dof, 1) if isinstance(dof, int) else int(np.max(dof, initial=1))
        return _table(self.probability, most.bit_length())

    def accepts(self, nis: Array, dof: IntArray | int, in_front: BoolArray | bool = True) -> BoolArray:
        """Test innovations of NIS (N,) and ``dof`` (N,), and count them; return which pass (N,).

        Only those of points in front of the camera do.
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
        """Say whether what is accepted may count for less than in full."""
        return self.huber is not None or self.share != 1.0

    def weights(self, nis: Array, dof: IntArray | int, accepted: BoolArray) -> Array:
        """Return what innovations of NIS (N,) count for (N,): 0 where not ``accepted`` (N,).

        Else it is Huber's weight, in (0, 1] and 1 without that loss, times the share.
        """
        if self.huber is None:
            return self.share * accepted.astype(float)
        return np.where(accepted, self.share * huber_weights(nis, huber_threshold(dof, self.huber)), 0.0)

    def info(self) -> dict[str, float]:
        """Return the figures by the names an Estimate's info has."""
        return {
            "nis": self.nis,
            "nis_dof": self.dof,
            "nis_expected": self.nis_expected,
            "gate_tested": self.tested,
            "gate_accepted": self.accepted,
            "unconverged": self.unconverged,
        }


class _Table(NamedTuple):
    """At each number of degrees of freedom, from none on, the bound of the NIS and its mean below it."""

    bound: Array
    expected: Array


@lru_cache(maxsize=64)
def _table(probability: float | None, bits: int) -> _Table:
    """Return what a gate needs to know of all numbers of degrees of freedom of so many bits.

    A filter asks for the same few in every frame, and the quantiles take longer than the rest of the gate.
    """
    dof = np.arange(2**bits)
    return _Table(chi2_bound(dof, probability), mean_below_bound(dof, probability))
