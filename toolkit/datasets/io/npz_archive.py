"""NumPy archives read member by member; a huge array that is mostly filler is streamed and kept sparse.

The dense features of a long drive take more than a gigabyte, their sightings a few megabytes. Nothing is
ever unpickled. Format: numpy.lib.format, versions 1 to 3.
"""

import math
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
import numpy.typing as npt

from toolkit.arrays import check_shape
from toolkit.datasets.io.fields import Fields, check_numeric
from toolkit.errors import DataError
from toolkit.files.reading import is_regular, open_input
from toolkit.geometry import Array, IntArray

# Small enough for the processor's cache, large enough that the Python around it does not show.
_CHUNK_BYTES = 1 << 18
# A dense array of a recording is far smaller: an hour of IMU samples at 1 kHz has 200 MB.
_MOST_BYTES = 2 << 30
_ZIP_MAGIC = b"PK\x03\x04"
_ZIP_HEADER = struct.Struct("<26xHH")
_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, struct.error, NotImplementedError, RuntimeError, MemoryError)


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


@dataclass(frozen=True)
class NpzArchive:
    """An open archive; keys are member names without their ``.npy``."""

    path: Path
    archive: zipfile.ZipFile

    @property
    def keys(self) -> list[str]:
        """The keys of all arrays."""
        return _keys(self.archive)

    def fields(self, *left_out: str) -> Fields:
        """Read every array whole, but for the keys left out."""
        return Fields(self.path, {key: self._dense(key) for key in self.keys if key not in left_out})

    def sparse(self, key: str, shape: tuple[int | None, ...], filler: float) -> SparseArray:
        """Stream one array of the given shape, in either memory order; keep what differs from the filler (NaN does)."""
        with self.archive.open(f"{key}.npy") as stream:
            header = self._header(key, stream)
            return sparse_array(Named(self.path, key), header, shape, stream, filler)

    def _dense(self, key: str) -> npt.NDArray[np.generic]:
        with self.archive.open(f"{key}.npy") as stream:
            self._check_size(key, self._header(key, stream))
        with self.archive.open(f"{key}.npy") as stream:
            try:
                array: npt.NDArray[np.generic] = np.lib.format.read_array(stream, allow_pickle=False)
            except ValueError as error:
                pickled = "Object arrays" in str(error)
                why = "it holds objects, which are never unpickled" if pickled else _first_line(error)
                raise DataError(f"{self.path}: {key} cannot be read: {why}; save it as plain numbers") from error
        return array

    def _header(self, key: str, stream: IO[bytes]) -> ArrayLayout:
        try:
            version = np.lib.format.read_magic(stream)
            # Version 3 differs from 2 in the encoding of field names only, and plain numbers have none.
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            header = ArrayLayout(*read(stream))
        except (ValueError, TypeError, SyntaxError, OverflowError) as error:
            raise DataError(f"{self.path}: {key} has no valid .npy header: {_first_line(error)}") from error
        return header

    def _check_size(self, key: str, header: ArrayLayout) -> None:
        """Raise DataError where a header asks for more memory than its array fills, or than is sensible."""
        size = math.prod(header.shape) * header.dtype.itemsize
        stored = self.archive.getinfo(f"{key}.npy").file_size
        if header.dtype.kind != "O" and size > stored:
            raise DataError(f"{self.path}: {key} ends after {stored} of {size} bytes; save it again")
        if size > _MOST_BYTES:
            raise DataError(
                f"{self.path}: {key} takes {size / 1e9:.1f} GB, more than is read at once; cut the recording"
            )


@contextmanager
def opened(path: Path) -> Iterator[NpzArchive]:
    """Open an archive; damage met while it is open is raised as DataError."""
    try:
        with open_input(path) as file, zipfile.ZipFile(file) as archive:
            twice = [key for key, times in Counter(_keys(archive)).items() if times > 1]
            if twice:
                raise DataError(f"{path}: {twice[0]} is in the archive twice; save it with one array of that name")
            yield NpzArchive(path, archive)
    except (OSError, *_DAMAGE) as error:
        raise DataError(f"{path}: damaged or truncated npz ({_first_line(error)}); copy or save it again") from error


def array_names(path: Path) -> set[str]:
    """Return the keys of an archive without reading arrays; of a damaged one its first key, of anything else none."""
    if not is_regular(path):
        return set()
    try:
        with open_input(path) as file, zipfile.ZipFile(file) as archive:
            return set(_keys(archive))
    except (OSError, *_DAMAGE):
        return _first_key(path)


def _keys(archive: zipfile.ZipFile) -> list[str]:
    return [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]


def _first_key(path: Path) -> set[str]:
    """Read the name in the first local header: a truncated archive has lost the directory at its end."""
    with path.open("rb") as stream:
        header = stream.read(_ZIP_HEADER.size)
        if len(header) < _ZIP_HEADER.size or not header.startswith(_ZIP_MAGIC):
            return set()
        name_length, _ = _ZIP_HEADER.unpack(header)
        return {stream.read(name_length).decode(errors="replace").removesuffix(".npy")}


def _first_line(error: BaseException) -> str:
    return str(error).partition("\n")[0] or type(error).__name__
