"""NumPy's files, read without running anything in them: the arrays of an npz, and the plain data of an object npy.

A pickle is a program: every name that it refers to is answered with a description of an array or a number, never with
an object of a module. Sizes are checked before memory is taken, long arrays of a pickle are views of the mapped file,
and an array that is mostly filler is streamed and kept sparse: the dense features of a long drive take more than a
gigabyte, their sightings a few megabytes. Formats: numpy.lib.format, versions 1 to 3, and pickletools.
"""

import io
import math
import mmap
import pickle
import re
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from toolkit.arrays import check_shape
from toolkit.datasets.io.fields import Fields, check_numeric
from toolkit.errors import DataError, printable
from toolkit.files.reading import is_regular, open_input
from toolkit.geometry import Array, IntArray

MAGIC = b"\x93NUMPY"
# Small enough for the processor's cache, large enough that the Python around it does not show.
_CHUNK_BYTES = 1 << 18
# Longer byte strings of a pickle stay in the file.
_LONG_BYTES = 1 << 16
_ZIP_MAGIC, _LOOKED_AT = b"PK\x03\x04", 1 << 16
_DAMAGED_ZIP = (zipfile.BadZipFile, zlib.error, EOFError, struct.error, NotImplementedError, RuntimeError, MemoryError)
_DAMAGED_PICKLE = (
    *(ValueError, TypeError, LookupError, AttributeError, OverflowError, EOFError, MemoryError, RecursionError),
    *(struct.error, pickle.UnpicklingError),
)


class _Layout(NamedTuple):
    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[np.generic]


def _header(stream: IO[bytes], what: str) -> _Layout:
    try:
        version = np.lib.format.read_magic(stream)
        # Version 3 differs from 2 in the encoding of field names only, and plain numbers have none.
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        return _Layout(*read(stream))
    except (ValueError, TypeError, SyntaxError, OverflowError) as error:
        raise DataError(f"{what} has no valid .npy header: {_first_line(error)}; copy or save it again") from error


def _first_line(error: BaseException) -> str:
    return printable(str(error).partition("\n")[0])[:200] or type(error).__name__


# Features -----------------------------------------------------------------------------------------------------

_NOT_SEEN = -1.0


class Corners(NamedTuple):
    """Frame (N,), track (N,) and uL, vL, uR, vR (N, 4) px of sightings, and what to know of those that are none."""

    frame: IntArray
    track: IntArray
    corners_px: Array
    facts: tuple[str, ...]


def corners_of(path: Path, key: str, features: npt.NDArray[np.generic], frame_count: int) -> Corners:
    """Return the sightings of features (4, M, T), which may be larger than memory, as a view of a file is.

    They are -1 where nothing is seen, or NaN where nothing is -1; those that are 0 in every coordinate are none. One
    that lacks a coordinate has NaN there: both of the right image, or one, for the audit to find. Raises DataError,
    naming file and key, where the array holds no real numbers or has another shape.
    """
    is_fortran = features.flags.f_contiguous
    flat, step = features.ravel(order="K"), _CHUNK_BYTES // features.itemsize
    chunks = (flat[at : at + step] for at in range(0, flat.size, step))
    return _corners(path, key, _Layout(features.shape, is_fortran, features.dtype), chunks, frame_count)


def _corners(path: Path, key: str, layout: _Layout, chunks: Iterator[npt.NDArray[Any]], frame_count: int) -> Corners:
    """Return the sightings of features whose values come in the order of their memory."""
    what, size, expected = f"{path}: {key}", 0, math.prod(layout.shape)
    check_numeric(path, key, layout.dtype)
    check_shape(what, layout.shape, (4, None, frame_count))
    positions, kept_values = [np.empty(0, dtype=np.int64)], [np.empty(0)]
    for values in chunks:
        kept = np.flatnonzero(values != _NOT_SEEN)
        positions.append(kept + size)
        kept_values.append(values[kept].astype(np.float64))
        size += values.size
    if size != expected:
        raise DataError(f"{what} ends after {size} of {expected} values; save it again")
    position, value = np.concatenate(positions), np.concatenate(kept_values)
    if value.size == expected and np.isnan(value).any():
        position, value = position[~np.isnan(value)], value[~np.isnan(value)]
    order: Literal["F", "C"] = "F" if layout.fortran_order else "C"
    coordinate, track, frame = np.unravel_index(position, layout.shape, order=order)
    tracks = max(layout.shape[1], 1)
    cell, row = np.unique(frame * tracks + track, return_inverse=True)
    corners_px: Array = np.full((cell.size, 4), np.nan)
    corners_px[row, coordinate] = value
    seen = corners_px.any(axis=1)  # NaN is something
    unseen = int((~seen).sum())
    facts = (f"{unseen} features are 0 in every coordinate: unseen, as those that are -1",) if unseen else ()
    return Corners(cell[seen] // tracks, cell[seen] % tracks, corners_px[seen], facts)


# Archives -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NpzArchive:
    """An open archive; keys are member names without their ``.npy``."""

    path: Path
    archive: zipfile.ZipFile

    @property
    def keys(self) -> list[str]:
        return [name.removesuffix(".npy") for name in self.archive.namelist() if name.endswith(".npy")]

    def fields(self, *left_out: str) -> Fields:
        return Fields(self.path, {key: self._dense(key) for key in self.keys if key not in left_out})

    def corners(self, key: str, frame_count: int) -> Corners:
        """Stream features as :func:`corners_of`; raises DataError also where they end too early."""
        with self.archive.open(f"{key}.npy") as stream:
            layout = _header(stream, f"{self.path}: {key}")
            return _corners(self.path, key, layout, _chunks(stream, layout), frame_count)

    def _dense(self, key: str) -> npt.NDArray[np.generic]:
        what, name = f"{self.path}: {key}", f"{key}.npy"
        with self.archive.open(name) as stream:
            layout = _header(stream, what)
        size, stored = math.prod(layout.shape) * layout.dtype.itemsize, self.archive.getinfo(name).file_size
        if layout.dtype.kind == "O":
            raise DataError(f"{what} holds objects, which are never unpickled; save it as plain numbers")
        if size > stored:
            raise DataError(f"{what} ends after {stored} of {size} bytes; save it again")
        with self.archive.open(name) as stream:
            try:
                array: npt.NDArray[np.generic] = np.lib.format.read_array(stream, allow_pickle=False)
            except ValueError as error:
                raise DataError(f"{what} cannot be read: {_first_line(error)}; save it as plain numbers") from error
        return array


def _chunks(stream: IO[bytes], layout: _Layout) -> Iterator[npt.NDArray[Any]]:
    size, left = layout.dtype.itemsize, math.prod(layout.shape)
    while chunk := stream.read(min(_CHUNK_BYTES // size, left) * size):
        count = len(chunk) // size
        yield np.frombuffer(chunk, layout.dtype, count)
        left -= count
        if not count:
            return


@contextmanager
def opened(path: Path) -> Iterator[NpzArchive]:
    """Open an archive; damage met while it is open is raised as DataError."""
    try:
        with open_input(path) as file, zipfile.ZipFile(file) as archive:
            found = NpzArchive(path, archive)
            twice = [key for key, times in Counter(found.keys).items() if times > 1]
            if twice:
                raise DataError(f"{path}: {twice[0]} is in the archive twice; save it with one array of that name")
            yield found
    except (OSError, *_DAMAGED_ZIP) as error:
        raise DataError(f"{path}: damaged or truncated npz ({_first_line(error)}); copy or save it again") from error


def holds_arrays(path: Path, names: Iterable[str]) -> bool:
    """Say whether a file is an archive, whole or damaged, that has an array of one of these names."""
    if not is_regular(path):
        return False
    with open_input(path) as file:
        begin = file.read(_LOOKED_AT)
        file.seek(max(path.stat().st_size - _LOOKED_AT, 0))
        # An archive lists its members at its end, which one that was cut off has lost; the first is named at the start.
        listed = begin + file.read()
    return begin.startswith(_ZIP_MAGIC) and any(re.search(rf"(?<!\w){name}\.npy".encode(), listed) for name in names)


# Pickles of plain data ----------------------------------------------------------------------------------------

Plain = Any  # None, bool, int, float, str, bytes, arrays, and lists, tuples and dicts of these


def read_dict(path: Path) -> dict[str, Plain]:
    """Return the dict that an object ``.npy`` holds; its arrays (read-only) are views of the file, unread until used.

    Raises DataError where the file is none or damaged, holds anything else, or names an object that is not plain data.
    """
    with open_input(path) as file:
        layout = _header(file, f"{path}:")
        if layout.dtype.kind != "O":
            raise DataError(f"{path}: one array of shape {layout.shape}, expected a dict saved with numpy.save")
        try:
            content = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
            found = _PlainUnpickler(path, _Mapped(content, file.tell())).load()
        except _DAMAGED_PICKLE as error:
            raise DataError(f"{path}: damaged or truncated npy ({_first_line(error)}); save it again") from error
    inner = found[0] if isinstance(found, list) and len(found) == 1 else found
    if not (isinstance(inner, dict) and all(isinstance(key, str) for key in inner)):
        raise DataError(f"{path}: holds no dict of named values; save the recording as one with numpy.save")
    return cast(dict[str, Plain], inner)


class _Mapped:
    """A mapped file, read as a stream: long byte strings are views of it."""

    def __init__(self, content: memoryview, at: int) -> None:
        self._content, self._at = content, at

    def read(self, count: int) -> bytes | memoryview:
        left = len(self._content) - self._at
        if count > left:
            raise ValueError(f"{count} bytes are announced and {left} are left")
        found = self._content[self._at : self._at + count]
        self._at += count
        return found if count >= _LONG_BYTES else bytes(found)

    def readline(self) -> bytes:
        line = io.BytesIO(self._content[self._at : self._at + _LONG_BYTES]).readline()
        self._at += len(line)
        return line


class _Begun:
    """A dtype or an array between the instruction that begins it and the one that brings its state."""

    def __init__(self, finish: Callable[[Any], Any]) -> None:
        self.finish = finish
        self.value: Any = None


class _Memo(dict[int, Any]):
    """Values that a pickle may refer to again; what was begun is given as what it became."""

    def __getitem__(self, key: int) -> Any:
        kept = super().__getitem__(key)
        return kept.value if isinstance(kept, _Begun) else kept


# The library's reader in C copies bytes, and takes memory for them before it has met them.
_InPython: Any = pickle._Unpickler


class _PlainUnpickler(_InPython):  # type: ignore[misc]
    """The standard library's reader in Python, to which no name is known but those of arrays and numbers."""

    def __init__(self, path: Path, source: _Mapped) -> None:
        super().__init__(source)
        self.memo = _Memo()
        self.dispatch = {**_InPython.dispatch, pickle.BUILD[0]: _PlainUnpickler.load_build}
        self._path = path

    def find_class(self, module: str, name: str) -> Any:
        """Return what makes the description of an object; raise DataError for any that plain data do not need."""
        full = f"{module}.{name}".replace("numpy.core.", "numpy._core.")
        if full not in _MAKERS:
            raise DataError(
                f"{self._path}: its pickle names {printable(f'{module}.{name}')[:100]}, and only plain numbers, texts, "
                "lists, dicts and arrays are read; nothing of it was executed"
            )
        return _MAKERS[full]

    def load_build(self) -> None:
        """Finish the dtype or array that is last on the stack; nothing else has a state, so that nothing is set."""
        state, begun = self.stack.pop(), self.stack[-1]
        if not isinstance(begun, _Begun):
            raise ValueError("a value is given a state")
        self.stack[-1] = begun.value = begun.finish(state)


_OBJECTS = "objects"


def _dtype(text: Any, *_: Any) -> _Begun:
    """Begin the dtype of a text like f8, whose byte order comes with its state."""
    if text in ("O", "O8"):
        return _Begun(lambda _: _OBJECTS)
    dtype = np.dtype(str(text))
    if dtype.kind not in "fiub":
        raise ValueError(f"an array holds {dtype}, expected numbers")
    return _Begun(lambda state: dtype.newbyteorder(state[1]) if state[1] in "<>" else dtype)


def _array_of(state: Any) -> Plain:
    """Return an array of its state: a view of its bytes, or the list of its objects."""
    _, shape, dtype, fortran_order, data = state
    if dtype is _OBJECTS:
        if not isinstance(data, list) or len(data) != math.prod(shape):
            raise ValueError("an array of objects has another number of them")
        return data
    if len(data) != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"an array of {shape} {dtype} has {len(data)} bytes")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran_order else "C")


_MAKERS: dict[str, Any] = {
    "numpy._core.multiarray._reconstruct": lambda *_: _Begun(_array_of),
    "numpy._core.multiarray.scalar": lambda dtype, data: np.frombuffer(data, dtype)[0].item(),
    "numpy.ndarray": "an argument of _reconstruct, and nothing to call",
    "numpy.dtype": _dtype,
}
