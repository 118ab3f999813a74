"""Cuts samples at the frame times, once, so that every estimator integrates exactly the same interval."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from toolkit.arrays import freeze_arrays
from toolkit.geometry import Array, IntArray, read_only

NS_PER_S = 1_000_000_000

# Which sample describes the motion between two stamps: the one at its start, the one at its end, or their mean.
Pairing = Literal["start", "end", "mean"]
# How IMU samples describe the motion: the mean of two neighbours from stamp to stamp, or each sample for the time
# around it, half-way to its neighbours.
ImuPairing = Literal["mean", "middle"]


def cut_at(
    frames_t_ns: IntArray, t_ns: IntArray, values: Array, pairing: Pairing | ImuPairing
) -> Iterator[tuple[Array, Array]]:
    """Yield, for each interval between frames (K,), durations (n,) s and the values (n, d) that hold over them.

    The samples, stamps (S,) and values (S, d), must span the frames. An interval is divided at the samples
    inside it, with ``middle`` half-way between them; at the frames themselves ``mean`` interpolates linearly.

    The noise of the values equals that of the samples only where no sample contributes to two intervals. With the mean
    of neighbours, an interval of n samples has ``(n - 1/2) / n`` of the variance and a covariance of ``1 / 4 n`` with
    each neighbouring interval, which adds up to the whole variance over many intervals. With ``middle``, no sample is
    shared where the frames are half-way between samples.
    """
    ends = _half_way(t_ns) if pairing == "middle" else t_ns
    inside = ends[(ends > frames_t_ns[0]) & (ends < frames_t_ns[-1])]
    knots = np.union1d(inside, frames_t_ns)
    dt_s = np.diff(knots) / NS_PER_S
    rows = _paired(t_ns, values, knots, pairing)
    for begin, end in pairwise(np.searchsorted(knots, frames_t_ns)):
        yield dt_s[begin:end], rows[begin:end]


def _half_way(t_ns: IntArray) -> IntArray:
    return np.asarray(t_ns[:-1] + np.diff(t_ns) // 2)


def _paired(t_ns: IntArray, values: Array, knots: IntArray, pairing: Pairing | ImuPairing) -> Array:
    """Return the value (n, d) that describes each of the n intervals between knots."""
    if pairing == "middle":
        return values[np.searchsorted(_half_way(t_ns), knots[:-1], side="right")]
    if pairing == "start":
        return values[np.searchsorted(t_ns, knots[:-1], side="right") - 1]
    if pairing == "end":
        return values[np.searchsorted(t_ns, knots[1:], side="left")]
    relative_s, knots_s = (t_ns - knots[0]) / NS_PER_S, (knots - knots[0]) / NS_PER_S
    at_knots: Array = np.stack([np.interp(knots_s, relative_s, column) for column in values.T], axis=1)
    return 0.5 * (at_knots[:-1] + at_knots[1:])


@dataclass(frozen=True, eq=False)
class Bridges:
    """Spans (B,) without measured motion, in which samples were interpolated; these are noisier than the others.

    ``noise_scale`` (B, 2) multiplies the standard deviation of the white noise there, of linear and angular samples.
    """

    begin_t_ns: IntArray
    end_t_ns: IntArray
    noise_scale: Array

    def __post_init__(self) -> None:
        freeze_arrays(self, begin_t_ns=(None,), end_t_ns=(None,), noise_scale=(None, 2))

    def scale_over(self, begin_ns: int, dt_s: Array) -> Array | None:
        """Return the factors (n, 2) over successive pieces (n,) from a stamp on, or None where all was measured."""
        middle_t_ns = begin_ns + np.rint((np.cumsum(dt_s) - 0.5 * dt_s) * NS_PER_S).astype(np.int64)
        inside = (middle_t_ns[:, None] > self.begin_t_ns) & (middle_t_ns[:, None] < self.end_t_ns)  # (n, B)
        if not inside.any():
            return None
        scale: Array = read_only(np.where(inside[:, :, None], self.noise_scale, 1.0).max(axis=1))
        return scale
