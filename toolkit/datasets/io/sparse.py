"""Dense arrays that are mostly filler, streamed and kept sparse, and the stereo corners in one of features."""

import math
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from toolkit.arrays import check_shape
from toolkit.datasets.io.fields import check_numeric
from toolkit.errors import DataError
from toolkit.geometry import Array, IntArray

# Small enough for the processor's cache, large enough that the Python around it does not show.
_CHUNK_BYTES = 1 << 18


class Named(NamedTuple):
    """What an array is called in an error: its file and its key."""

    path: Path
    key: str


class ArrayLayout(NamedTuple):
    """What must be known of an array to read its bytes."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[np.generic]


class SparseArray(NamedTuple):
    """The entries of a dense array that differ from its filler: indices per axis, each (E,), and values (E,)."""

    shape: tuple[int, ...]
    indices: tuple[IntArray, ...]
    value: Array


def sparse_array(
    named: Named, layout: ArrayLayout, shape: tuple[int | None, ...], stream: IO[bytes], filler: float
) -> SparseArray:
    """Read an array of a shape (None = any) from a stream, in either memory order; keep what is not the filler.

    NaN is not, unless the array has no filler at all: then it stands for it. Raises DataError, naming file and key,
    where it holds no real numbers, has another shape, or the stream ends before it.
    """
    path, key = named
    check_numeric(path, key, layout.dtype)
    check_shape(f"{path}: {key}", layout.shape, shape)
    expected = math.prod(layout.shape)
    size, position, value = _kept_entries(stream, layout.dtype, expected, filler)
    if size != expected:
        raise DataError(f"{path}: {key} ends after {size} of {expected} values; save it again")
    if value.size == expected and np.isnan(value).any():
        position, value = position[~np.isnan(value)], value[~np.isnan(value)]
    indices = np.unravel_index(position, layout.shape, order="F" if layout.fortran_order else "C")
    return SparseArray(layout.shape, indices, value)


def _kept_entries(
    stream: IO[bytes], dtype: np.dtype[np.generic], count: int, filler: float
) -> tuple[int, IntArray, Array]:
    """Return how many of so many values a stream has, and where and which differ from the filler."""
    chunk_values = _CHUNK_BYTES // dtype.itemsize
    size, positions, kept_values = 0, [np.empty(0, dtype=np.int64)], [np.empty(0)]
    while chunk := stream.read(min(chunk_values, count - size) * dtype.itemsize):
        values = np.frombuffer(chunk, dtype=dtype, count=len(chunk) // dtype.itemsize)
        kept = np.flatnonzero(values != filler)
        positions.append(kept + size)
        kept_values.append(values[kept].astype(np.float64))
        size += values.size
        if not values.size:
            break
    return size, np.concatenate(positions), np.concatenate(kept_values)


def corners_of(features: SparseArray) -> tuple[IntArray, IntArray, Array]:
    """Return frame (N,), track (N,) and uL, vL, uR, vR (N, 4) px of features (4, M, T).

    A sighting that lacks a coordinate has NaN there: both of the right image, or one, for the audit to find.
    """
    coordinate, track, frame = features.indices
    tracks = max(features.shape[1], 1)
    cell, row = np.unique(frame * tracks + track, return_inverse=True)
    corners_px: Array = np.full((cell.size, 4), np.nan)
    corners_px[row, coordinate] = features.value
    return cell // tracks, cell % tracks, corners_px
