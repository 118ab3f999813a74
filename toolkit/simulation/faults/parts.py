"""Parts of several faults: the time span that they affect, and edits of a recording."""

from dataclasses import replace

import numpy as np

from toolkit.geometry import Array
from toolkit.measurements import NS_PER_S
from toolkit.sequence import Sequence


def span_s(sequence: Sequence, length_s: float, seed: int) -> tuple[float, float]:
    """Return begin and end (s from the first frame) of a span in the middle half, where one of that length fits."""
    begin_s = sequence.duration_s * np.random.default_rng(seed).uniform(0.3, 0.6)
    begin_s = max(min(begin_s, 0.9 * sequence.duration_s - length_s), 0.0)
    return begin_s, begin_s + length_s


def ns(seconds: float) -> int:
    """Return seconds as whole nanoseconds."""
    return round(seconds * NS_PER_S)


def with_pixels(sequence: Sequence, uv_px: Array) -> Sequence:
    """Return the sequence with other pixels (N, 3) of its sightings."""
    return replace(sequence, observations=replace(sequence.observations, uv_px=uv_px))
