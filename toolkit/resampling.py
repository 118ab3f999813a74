"""Cuts samples at the frame times, once, so that every estimator integrates exactly the same interval."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Literal

import numpy as np

from toolkit.geometry import Array, IntArray

NS_PER_S = 1_000_000_000

# Which sample describes the motion between two stamps: the one at its start, the one at its end, or their mean.
Pairing = Literal["start", "end", "mean"]


def cut_at(frames_t_ns: IntArray, t_ns: IntArray, values: Array, pairing: Pairing) -> Iterator[tuple[Array, Array]]:
    """Yield, for each interval between frames (K,), durations (n,) s and the values (n, d) that hold over them.

    The samples, stamps (S,) and values (S, d), must span the frames. An interval is divided at the samples
    inside it; at the frames themselves ``mean`` interpolates linearly.
    """
    inside = t_ns[(t_ns > frames_t_ns[0]) & (t_ns < frames_t_ns[-1])]
    knots = np.union1d(inside, frames_t_ns)
    dt_s = np.diff(knots) / NS_PER_S
    rows = _paired(t_ns, values, knots, pairing)
    for begin, end in pairwise(np.searchsorted(knots, frames_t_ns)):
        yield dt_s[begin:end], rows[begin:end]


def _paired(t_ns: IntArray, values: Array, knots: IntArray, pairing: Pairing) -> Array:
    """Return the value (n, d) that stands for each of the n intervals between knots."""
    if pairing == "start":
        return values[np.searchsorted(t_ns, knots[:-1], side="right") - 1]
    if pairing == "end":
        return values[np.searchsorted(t_ns, knots[1:], side="left")]
    relative_s, knots_s = (t_ns - knots[0]) / NS_PER_S, (knots - knots[0]) / NS_PER_S
    at_knots: Array = np.stack([np.interp(knots_s, relative_s, column) for column in values.T], axis=1)
    return 0.5 * (at_knots[:-1] + at_knots[1:])
