"""Numbers, texts, lists, dicts and NumPy arrays out of the pickle of an object ``.npy``; anything else is refused.

A pickle is a program, and loading one runs it. This one is read instead: each opcode is looked at, none of the objects
it names is imported or called, and the few that stand for arrays become descriptions of where their bytes lie in the
file. Whatever the size of the arrays, hardly any memory is used until one of them is read.
Formats: numpy.lib.format; the opcodes are documented in the standard library's pickletools.
"""

import io
import math
import pickletools
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
import numpy.typing as npt

from toolkit.errors import DataError, printable
from toolkit.files.reading import open_input

MAGIC = b"\x93NUMPY"
# Shorter byte strings are kept in memory.
_STORED_BYTES = 1 << 16
# A recording of an hour at 30 Hz, both its images as arrays of their own, takes six million.
_MOST_OPCODES = 10_000_000
# Read at once; recordings have one larger array, which is streamed.
_MOST_BYTES = 1 << 28
_MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
_DAMAGE = (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, struct.error, MemoryError)


@dataclass(frozen=True)
class StoredBytes:
    """A stretch of a file that was not read."""

    offset: int
    count: int

    def __len__(self) -> int:
        return self.count


@dataclass(frozen=True)
class StoredArray:
    """An array of plain numbers in a file: its shape, memory order and dtype, and where its bytes are."""

    path: Path
    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[np.generic]
    data: bytes | StoredBytes

    def read(self) -> npt.NDArray[np.generic]:
        """Return the array; raises DataError where it is larger than anything that is read whole."""
        if len(self.data) > _MOST_BYTES:
            raise DataError(f"{self.path}: an array takes {len(self.data) / 1e9:.1f} GB, which is not read at once")
        with self.opened() as stream:
            values = np.frombuffer(stream.read(len(self.data)), self.dtype)
        return values.reshape(self.shape, order="F" if self.fortran_order else "C")

    def opened(self) -> IO[bytes]:
        """Return its bytes as a stream, which begins with the first and goes on behind the last."""
        if isinstance(self.data, bytes):
            return io.BytesIO(self.data)
        stream = open_input(self.path)
        stream.seek(self.data.offset)
        return stream


Plain = Any  # None, bool, int, float, str, bytes, StoredArray, and lists, tuples and dicts of these


@dataclass(frozen=True)
class _Named:
    """What a pickle refers to by its module and name; nothing is imported."""

    name: str


class _Begun:
    """A dtype or an array between the opcode that begins it and the one that brings its state."""

    def __init__(self, finish: Callable[[Any], Any]) -> None:
        self.finish = finish
        self.value: Any = None


_OBJECTS = _Named("object")


def read_dict(path: Path) -> dict[str, Plain]:
    """Return the dict that an object ``.npy`` holds, its arrays unread.

    Raises DataError where the file is none or damaged, holds anything else, or names an object that is not plain data.
    """
    with open_input(path) as file:
        _check_header(path, file)
        try:
            found = _Machine(path, file).run()
        except _DAMAGE as error:
            why = printable(str(error).partition("\n")[0][:200]) or type(error).__name__
            raise DataError(f"{path}: damaged or truncated npy ({why}); copy or save it again") from error
    inner = found[0] if isinstance(found, list) and len(found) == 1 else found
    if not (isinstance(inner, dict) and all(isinstance(key, str) for key in inner)):
        raise DataError(f"{path}: holds no dict of named values; save the recording as one with numpy.save")
    return cast(dict[str, Plain], inner)


def _check_header(path: Path, file: IO[bytes]) -> None:
    """Raise DataError unless the file is an npy of objects; it is left where the pickle begins."""
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
    except (*_DAMAGE, SyntaxError) as error:
        raise DataError(f"{path}: no valid .npy header; copy or save it again") from error
    if dtype.kind != "O":
        raise DataError(f"{path}: one array of shape {shape}, expected a dict of arrays by name, saved with numpy.save")


class _Source:
    """A file for pickletools: long byte strings are passed over and not read."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._size = file.seek(0, io.SEEK_END) if file.seekable() else 0

    def at(self, offset: int) -> "_Source":
        self._file.seek(offset)
        return self

    def read(self, count: int) -> bytes | StoredBytes:
        if count < _STORED_BYTES:
            return self._file.read(count)
        offset = self._file.tell()
        if offset + count > self._size:
            raise ValueError(f"{count} bytes are announced and {self._size - offset} are left")
        self._file.seek(count, io.SEEK_CUR)
        return StoredBytes(offset, count)

    def readline(self) -> bytes:
        return self._file.readline(_STORED_BYTES)


class _Machine:
    """The stack, the marks and the memo of a pickle that is read."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        self._path = path
        start = file.tell()
        self._source = _Source(file).at(start)
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}

    def run(self) -> Plain:
        """Return what the pickle stands for; raises DataError for an opcode or a name that plain data do not need."""
        for count, (opcode, argument, _) in enumerate(self._opcodes()):
            if count > _MOST_OPCODES:
                raise DataError(f"{self._path}: more than {_MOST_OPCODES} pickled values; it is no recording")
            name = opcode.name
            if name == "STOP":
                return self._stack.pop()
            if name in _ARGUMENTS:
                self._stack.append(argument)
            elif name in _ACTIONS:
                _ACTIONS[name](self, argument)
            else:
                raise DataError(
                    f"{self._path}: its pickle uses {name}, which plain data do not need; it is not executed"
                )
        raise ValueError("the pickle does not end")

    def _opcodes(self) -> Iterator[tuple[pickletools.OpcodeInfo, Any, int | None]]:
        return pickletools.genops(cast(IO[bytes], self._source))

    def mark(self) -> None:
        """Begin a group of values."""
        self._marks.append(len(self._stack))

    def group(self) -> list[Any]:
        """Return the values since the last mark, and forget them."""
        at = self._marks.pop()
        values, self._stack[at:] = self._stack[at:], []
        return values

    def push(self, value: Any) -> None:
        """Put a value on the stack."""
        self._stack.append(value)

    def pushed(self, count: int) -> list[Any]:
        """Return the last values of the stack, and forget them."""
        if count > len(self._stack):
            raise ValueError("a value is missing")
        values, self._stack[len(self._stack) - count :] = self._stack[len(self._stack) - count :], []
        return values

    def remember(self, key: int | None) -> None:
        """Keep the last value for later, under a key or the next free one."""
        self._memo[len(self._memo) if key is None else key] = self._stack[-1]

    def recall(self, key: int) -> None:
        """Put a value that was kept on the stack."""
        kept = self._memo[key]
        self._stack.append(kept.value if isinstance(kept, _Begun) else kept)

    def extend(self, values: list[Any]) -> None:
        """Add values to the list that is last on the stack."""
        if not isinstance(self._stack[-1], list):
            raise ValueError("values are added to what is no list")
        self._stack[-1].extend(values)

    def update(self, values: list[Any]) -> None:
        """Add keys and values, in turn, to the dict that is last on the stack."""
        if not isinstance(self._stack[-1], dict):
            raise ValueError("entries are added to what is no dict")
        self._stack[-1].update(zip(values[::2], values[1::2], strict=True))

    def refer(self, module: str, name: str) -> None:
        """Put the name of an object on the stack, if it is one of those that arrays need."""
        full = f"{module}.{name}"
        if full not in _KNOWN:
            raise DataError(
                f"{self._path}: its pickle names {printable(full)[:100]}, and only plain numbers, texts, lists, dicts "
                "and arrays are read; nothing of it was executed"
            )
        self._stack.append(_Named(name))

    def call(self) -> None:
        """Put what a known object begins of its arguments on the stack."""
        what, given = self.pushed(2)
        if what == _Named("_reconstruct"):
            self._stack.append(_Begun(self._array))
        elif what == _Named("dtype"):
            self._stack.append(_Begun(partial(_dtype, given[0])))
        elif what == _Named("scalar"):
            self._stack.append(np.frombuffer(given[1], given[0])[0].item())
        else:
            raise ValueError("a value is called")

    def build(self) -> None:
        """Finish the dtype or array that is last on the stack, with its state."""
        begun, state = self.pushed(2)
        begun.value = begun.finish(state)
        self._stack.append(begun.value)

    def _array(self, state: Any) -> Plain:
        _, shape, dtype, fortran_order, data = state
        if dtype == _OBJECTS:
            if not isinstance(data, list) or len(data) != math.prod(shape):
                raise ValueError("an array of objects has another number of them")
            return data
        if len(data) != math.prod(shape) * dtype.itemsize:
            raise ValueError(f"an array of {shape} {dtype} has {len(data)} bytes")
        return StoredArray(self._path, tuple(shape), bool(fortran_order), dtype, data)


def _dtype(text: Any, state: Any) -> Any:
    """Return the dtype of a text like f8, in the byte order of its state; objects have none that could be read."""
    if text in ("O", "O8"):
        return _OBJECTS
    dtype = np.dtype(str(text))
    if dtype.kind not in "fiub":
        raise ValueError(f"an array holds {dtype}, expected numbers")
    return dtype.newbyteorder(state[1]) if state[1] in "<>" else dtype


def _global(machine: _Machine, names: str) -> None:
    machine.refer(*names.split(" ", 1))


_KNOWN = {f"{module}.{name}" for module in _MULTIARRAY for name in ("_reconstruct", "scalar")}
_KNOWN |= {"numpy.ndarray", "numpy.dtype"}
# Opcodes whose argument is the value itself.
_INTEGERS = ("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4")
_TEXTS = ("SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "SHORT_BINBYTES", "BINBYTES", "BINBYTES8")
_ARGUMENTS = {*_INTEGERS, *_TEXTS, "FLOAT", "BINFLOAT"}
_ACTIONS: dict[str, Callable[[_Machine, Any], None]] = {
    "PROTO": lambda machine, _: None,
    "FRAME": lambda machine, _: None,
    "NONE": lambda machine, _: machine.push(None),
    "NEWTRUE": lambda machine, _: machine.push(True),
    "NEWFALSE": lambda machine, _: machine.push(False),
    "MARK": lambda machine, _: machine.mark(),
    "EMPTY_LIST": lambda machine, _: machine.push([]),
    "EMPTY_DICT": lambda machine, _: machine.push({}),
    "EMPTY_TUPLE": lambda machine, _: machine.push(()),
    "TUPLE": lambda machine, _: machine.push(tuple(machine.group())),
    "TUPLE1": lambda machine, _: machine.push(tuple(machine.pushed(1))),
    "TUPLE2": lambda machine, _: machine.push(tuple(machine.pushed(2))),
    "TUPLE3": lambda machine, _: machine.push(tuple(machine.pushed(3))),
    "LIST": lambda machine, _: machine.push(machine.group()),
    "APPEND": lambda machine, _: machine.extend(machine.pushed(1)),
    "APPENDS": lambda machine, _: machine.extend(machine.group()),
    "SETITEM": lambda machine, _: machine.update(machine.pushed(2)),
    "SETITEMS": lambda machine, _: machine.update(machine.group()),
    "MEMOIZE": lambda machine, _: machine.remember(None),
    "PUT": lambda machine, key: machine.remember(key),
    "BINPUT": lambda machine, key: machine.remember(key),
    "LONG_BINPUT": lambda machine, key: machine.remember(key),
    "GET": lambda machine, key: machine.recall(key),
    "BINGET": lambda machine, key: machine.recall(key),
    "LONG_BINGET": lambda machine, key: machine.recall(key),
    "GLOBAL": _global,
    "STACK_GLOBAL": lambda machine, _: machine.refer(*machine.pushed(2)),
    "REDUCE": lambda machine, _: machine.call(),
    "BUILD": lambda machine, _: machine.build(),
}
