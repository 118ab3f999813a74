"""Fewer points than a recording has, none of them made up: what a screen can show, in a file that can be mailed."""

from collections.abc import Mapping, Sequence

import numpy as np

from toolkit.documents import number, numbers
from toolkit.geometry import Array, IntArray
from toolkit.report import curves

MOST_POSES = 1500
MOST_SAMPLES = 1200
MOST_OF_COMPONENTS = 400
MOST_LANDMARKS = 5000
_MILLIMETRES = 3
_LARGE_M = 1e7


def evenly(count: int, most: int) -> IntArray:
    """Return at most ``most`` of the indices 0 ... count - 1, evenly spread, the first and the last among them."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.int64))


def with_peaks(values: Array, most: int) -> IntArray:
    """Return at most ``most`` indices into values (N,) that keep the least and the largest of each stretch.

    So a single bad frame among thousands stays visible. NaN never wins; the first and the last index stay.
    """
    if values.size <= most:
        return np.arange(values.size)
    edges = np.linspace(0, values.size, max(most // 2 - 1, 1) + 1).round().astype(np.int64)
    kept = {0, values.size - 1}
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        part = values[begin:end]
        kept |= {begin + int(np.where(np.isnan(part), np.inf, part).argmin())}
        kept |= {begin + int(np.where(np.isnan(part), -np.inf, part).argmax())}
    return np.array(sorted(kept))


def thinned(series: Mapping[str, Sequence[float | None]], leading: str) -> dict[str, list[float | None]]:
    """Return the lists of a series, all thinned alike, so that the peaks of the ``leading`` one stay."""
    values = _as_array(series[leading])
    kept = with_peaks(values, MOST_SAMPLES).tolist()
    return {name: [column[i] for i in kept] for name, column in series.items() if len(column) == values.size}


def running_median(values: Sequence[float | None]) -> list[float | None]:
    """Return the median of the known values around each; None where there are none."""
    return list(numbers(curves.running_median(_as_array(values))))


def _as_array(values: Sequence[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in values], dtype=float)


def coordinates(points: Array) -> dict[str, list[float | None]]:
    """Return points (N, 3) as lists of x, y and z to the millimetre; what flew off keeps six digits."""
    axes = zip("xyz", points.T.tolist(), strict=True)
    return {axis: [_metres(value) for value in values] for axis, values in axes}


def _metres(value: float) -> float | None:
    return round(value, _MILLIMETRES) if abs(value) < _LARGE_M else number(value)
