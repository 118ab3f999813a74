"""Tables: columns by name, of a CSV file, plain or gzipped, or of a program's own values; a complaint names the place.

Columns of numbers are read at once; where that fails the cell is found and named, and stamps keep all their digits.
Which columns are stamps, positions, quaternions or an IMU's, their names say, which programs give alike but for words
around the axis: ``qx``, ``q_RS_x``, ``quat_x``, ``field.pose.orientation.x``.
"""

import codecs
import csv
import gzip
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from toolkit.datasets.io.fields import exact_ns, probable_unit, probable_unit_of_ns, stamps_ns
from toolkit.errors import DataError, nearest, printable
from toolkit.files.reading import GZIP_MAGIC, is_regular, open_input, read_text_input, read_unzipped
from toolkit.geometry import Array, IntArray
from toolkit.measurements import NS_PER_S

_LONGEST_LINE = 1 << 16
SECONDS, NANOSECONDS = "t", "t_ns"
_SEPARATORS = (",", ";", "\t")
_LARGEST = 2**63 - 1


def find_table(folder: Path, name: str) -> Path | None:
    """Return the path of a table in a folder, ``name`` or ``name.gz``, or None where there is neither."""
    candidates = (folder / name, folder / f"{name}.gz")
    return next((path for path in candidates if is_regular(path)), None)


def headings_of(path: Path) -> set[str]:
    """Return the names in the first line of a table, without ``#`` and units; none where it cannot be read."""
    try:
        with open_input(path) as raw:
            zipped = raw.read(len(GZIP_MAGIC)) == GZIP_MAGIC
        with gzip.open(path) if zipped else path.open("rb") as stream:
            line = stream.readline(_LONGEST_LINE).decode(errors="replace")
    except (DataError, OSError, EOFError, zlib.error):
        return set()
    return set(map(_plain, line.split(",")))


def read_stamps(path: Path, header_lines: int = 0) -> IntArray:
    """Read the first column of a table, or a list of stamps alone, as int64 nanoseconds (N,); N > 0.

    Whole numbers all the way: today's nanoseconds as doubles are off by up to 128.
    """
    lines = read_text_input(path, "copy it again").splitlines()[header_lines:]
    entries = [line.partition(",")[0].strip() for line in lines if line.strip() and not line.startswith("#")]
    if not entries:
        raise DataError(f"{path}: holds no rows; copy the whole recording")
    try:
        return np.array([int(entry) for entry in entries], dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise DataError(f"{path}: a stamp is not in whole nanoseconds ({error}); write seconds times 1e9") from error


@dataclass(frozen=True, eq=False)
class Columns:
    """A table: what it is called in a complaint, the names of its columns, and what is in them and in its rows.

    ``given`` are the columns (N,) of a program, ``lines`` the rows of a file, with ``numbers_of_rows`` as an editor
    counts them.
    """

    what: Path
    names: tuple[str, ...]
    given: Mapping[str, npt.NDArray[Any]] | None = None
    lines: Sequence[str] = ()
    separator: str = ","
    numbers_of_rows: Sequence[int] | None = None

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def require(self, *alternatives: str) -> None:
        """Raise DataError for columns that are there twice or missing, with what is like-named; ``"a|b"`` is either."""
        for name in (name for names in alternatives for name in names.split("|")):
            if self.names.count(name) > 1:
                raise DataError(f"{self.what}: the column {name} is there twice; rename or remove one")
        missing = [names for names in alternatives if not any(name in self for name in names.split("|"))]
        if missing:
            wanted = ", ".join(names.replace("|", " or ") + self._hint(names.split("|")) for names in missing)
            there = printable(", ".join(self.names))[:200] or "nothing"
            raise DataError(f"{self.what}: missing column {wanted}; it has {there}")

    def _hint(self, wanted: Sequence[str]) -> str:
        free = [name for name in self.names if name not in wanted]
        close = next((near for name in wanted if (near := nearest(name, free))), "")
        return f" (rename {printable(close)}?)" if close else ""

    def numbers(self, *names: str) -> Array:
        """Return columns side by side (N, C) as float64, NaN included.

        Raises DataError naming the columns that are missing, or the row of a text.
        """
        self.require(*names)
        if self.given is None:
            at = list(map(self.names.index, names))
            with suppress(ValueError):  # the cell is named below
                return np.loadtxt(
                    self.lines, delimiter=self.separator, quotechar='"', usecols=at, comments=None, ndmin=2
                )
        return self.numbers_or_none(*names, empty="")

    def numbers_or_none(self, *names: str, empty: str = "nan") -> Array:
        """Return columns as :meth:`numbers` does, with NaN where a text is empty."""
        return np.stack([self._numbers(name, empty) for name in names], axis=1)

    def whole(self, name: str) -> IntArray:
        """Return a column of whole numbers (N,); raises DataError naming the row of anything else."""
        self.require(name)
        cells = self._cells(name)
        if self.given is not None and self.given[name].dtype.kind == "i":
            return self.given[name].astype(np.int64)
        return np.array([self._whole(name, i, cell) for i, cell in enumerate(cells)], dtype=np.int64)

    def stamps(self) -> IntArray:
        """Return the stamps (N,) of a column t, in seconds, or t_ns, as int64 nanoseconds, rounded only there.

        Raises DataError where there are both or neither, one is no time, or they are not in seconds.
        """
        self.require(f"{SECONDS}|{NANOSECONDS}")
        if SECONDS in self and NANOSECONDS in self:
            raise DataError(f"{self.what}: has the columns {SECONDS} and {NANOSECONDS}; leave one out")
        if NANOSECONDS in self:
            t_ns = self.whole(NANOSECONDS)
            unit = probable_unit_of_ns(t_ns)
            if unit is not None:
                raise DataError(f"{self.what}: {NANOSECONDS} must be in nanoseconds, but the stamps look like {unit}")
            return t_ns
        seconds = self.numbers(SECONDS)[:, 0]
        if self.given is not None and self.given[SECONDS].dtype.kind in "fiu":
            return stamps_ns(self.what, SECONDS, seconds)
        unit = probable_unit(seconds[np.isfinite(seconds)])  # what is no number is named with its row below
        if unit is not None:
            raise DataError(f"{self.what}: {SECONDS} must be in seconds, but the stamps look like {unit}")
        return exact_ns(list(map(str, self._cells(SECONDS))), NS_PER_S, lambda row: f"{self.what}: {self.at(row)}")

    @cached_property
    def rows(self) -> list[list[str]]:
        """The cells of a file's lines."""
        return [_cells(line, self.separator) for line in self.lines]

    def at(self, row: int) -> str:
        return f"row {row}" if self.numbers_of_rows is None else f"line {self.numbers_of_rows[row]}"

    def _cells(self, name: str) -> Sequence[Any]:
        """Return the texts, or a program's values, in a column."""
        if self.given is None:
            at = self.names.index(name)
            return [row[at] for row in self.rows]
        values = self.given[name]
        if values.ndim != 1:
            raise DataError(f"{self.what}: column {name} has shape {values.shape}, expected one number a row")
        if values.dtype.kind == "c":
            raise DataError(f"{self.what}: column {name} holds complex numbers; give their real parts")
        # NumPy gives dates of nanoseconds as whole numbers, which are no column's.
        cells: list[Any] = list(map(str, values)) if values.dtype.kind in "mM" else values.tolist()
        return cells

    def _numbers(self, name: str, empty: str) -> Array:
        cells = self._cells(name)
        if self.given is not None and self.given[name].dtype.kind in "fiu":
            return self.given[name].astype(np.float64)
        cells = [np.nan if cell is None else cell.strip() or empty if isinstance(cell, str) else cell for cell in cells]
        bad = next((row for row, cell in enumerate(cells) if not is_number(cell)), None)
        if bad is not None:
            shown = printable(str(cells[bad]))[:50] or "empty"
            point = " with a decimal point" if "," in shown else ""
            raise DataError(f"{self.what}: {self.at(bad)}: {name} is {shown}, expected a number{point}")
        return np.fromiter(map(float, cells), dtype=np.float64, count=len(cells))

    def _whole(self, name: str, row: int, cell: Any) -> int:
        with suppress(TypeError, ValueError, InvalidOperation):
            exact = Decimal(cell.replace("_", "?") if isinstance(cell, str) else cell)
            if abs(exact) <= _LARGEST and exact == int(exact):
                return int(exact)
        shown = printable(str(cell).strip())[:50] or "empty"
        raise DataError(f"{self.what}: {self.at(row)}: {name} is {shown}, expected a whole number of 64 bits")


def is_number(value: Any) -> bool:
    """Say whether a value is a number, or a text of one; Python takes 1_0 for ten, and no other program does."""
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return "_" not in str(value)


def columns_of_file(path: Path) -> Columns:
    """Read a CSV, plain or gzipped, whose first line names its columns; comments and units after names are left out.

    Cells stand between commas, semicolons or tabs, in quotes or not. Raises DataError where the file cannot be read,
    has no names or no rows, or a row of another length.
    """
    text = read_unzipped(path).removeprefix(codecs.BOM_UTF8).decode(errors="replace")
    if "\0" in text:
        raise DataError(f"{path}: not a text file; write a CSV, one row a line, with names in the first")
    heading, numbers, lines = _heading(path, text)
    separator = max(_SEPARATORS, key=heading.count)
    if separator not in heading and len(heading.split()) > 1:
        raise DataError(f"{path}: its columns are separated by blanks; separate them by commas, semicolons or tabs")
    names = tuple(_canonical(_cells(heading, separator)))
    table = Columns(path, names, None, lines, separator, numbers)
    if '"' in text or {line.count(separator) for line in lines} != {len(names) - 1}:
        for number, row in zip(numbers, table.rows, strict=True):
            width = len(row) - (len(row) == len(names) + 1 and not row[-1].strip())  # some end lines with a separator
            if width != len(names):
                raise DataError(f"{path}: line {number} has {len(row)} columns, expected {len(names)}")
    return table


def _canonical(heading: Sequence[str]) -> list[str]:
    """Return the names of columns without comments and units; that of stamps is t or t_ns where it says the unit."""
    names = list(map(_plain, heading))
    if SECONDS in names or NANOSECONDS in names:
        return names
    units = {NS_PER_S: SECONDS, 1: NANOSECONDS}
    at = next((at for at, name in enumerate(heading) if stamp_unit_ns(name) in units), None)
    if at is not None:
        names[at] = units[stamp_unit_ns(heading[at]) or 1]
    return names


def _plain(heading: str) -> str:
    return heading.strip().lstrip("#").partition("[")[0].strip()


def _heading(path: Path, text: str) -> tuple[str, list[int], list[str]]:
    """Return the line that names the columns, and the numbers and texts of the rows: no comments and empty ones.

    The names may be a comment; of several it is the last that has as many as there are cells in the first row.
    """
    lines = text.splitlines()
    numbers = [number for number, line in enumerate(lines, 1) if (begin := line.lstrip()) and begin[0] != "#"]
    rows = [lines[number - 1] for number in numbers]
    before = [line for line in lines[: numbers[0] - 1] if line.strip()] if rows else []
    how = "its first line names the columns, the others hold them"
    if rows and not any(is_number(_cells(rows[0], separator)[0]) for separator in _SEPARATORS):
        heading, *rows = rows
    elif before:
        alike = (one for one in reversed(before) if all(one.count(s) == rows[0].count(s) for s in _SEPARATORS))
        heading = next(alike, before[-1])
    elif rows:
        raise DataError(f"{path}: holds numbers and no names; {how}")
    if not rows:
        raise DataError(f"{path}: holds no rows; {how}")
    return heading, numbers[-len(rows) :], rows


def _cells(line: str, separator: str) -> list[str]:
    if '"' in line:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    return line.split(separator)


def _unmasked(column: Any) -> npt.NDArray[Any]:
    """Return a column as an array, with NaN where it is masked."""
    if isinstance(column, np.ma.MaskedArray) and column.mask.any():
        return np.asarray(np.ma.filled(np.ma.asarray(column, dtype=np.float64), np.nan))
    return np.asarray(column)


def columns_given(what: str, given: Any) -> Columns:
    """Return what a program gives as columns: a mapping of names to values (N,), or anything like a data frame.

    Raises DataError where it is none, or its columns differ in length.
    """
    try:
        values = {str(name): _unmasked(given[name]) for name in given}
        lengths = {name: len(column) for name, column in values.items()}
    except (TypeError, KeyError, IndexError, ValueError) as error:
        raise DataError(f"{what}: is no mapping of column names to values ({error}); give a dict of arrays") from error
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise DataError(f"{what}: its columns differ in length: {counts}")
    return Columns(Path(what), tuple(values), values)


# Names of columns -----------------------------------------------------------------------------------------------------

_UNITS_NS = {
    "ns": 1, "nsec": 1, "nsecs": 1, "nanosec": 1, "nanoseconds": 1, "us": 1_000, "usec": 1_000, "microseconds": 1_000,
    "ms": 1_000_000, "msec": 1_000_000, "milliseconds": 1_000_000, "s": 10**9, "sec": 10**9, "secs": 10**9,
    "seconds": 10**9,
}  # fmt: skip
# The last word of a name but for its unit.
_SECONDS, _NANOSECONDS = ("sec", "secs", "seconds"), ("nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds")
_STAMPS = ("t", "time", "timestamp", "stamp", "ts", "ns", *_SECONDS, *_NANOSECONDS)
_POSITIONS = ("", "p", "pos", "position", "t", "trans", "translation", "location", "xyz")
_QUATERNIONS = ("q", "quat", "quaternion", "orientation", "rot", "rotation")
_ACCELERATIONS = ("arss", "alpha", "a", "acc", "accel", "acceleration", "accelerometer", "linearacceleration")
_RATES = ("wrss", "omega", "w", "g", "gyr", "gyro", "gyroscope", "angularvelocity")
_IN_BRACKETS, _BETWEEN_WORDS = re.compile(r"[\[(](.*?)[\])]"), re.compile(r"[^a-z0-9]+")


class Named(NamedTuple):
    """The columns of a table from 0, quaternions x y z w; ``unit_ns`` is that of the stamps where their name says it.

    A table of positions alone has no quaternions. Whole seconds may have their nanoseconds in a column of their own.
    """

    stamp: int
    unit_ns: int | None
    position: tuple[int, ...]
    quaternion: tuple[int, ...]
    nanoseconds: int | None = None


def named_columns(names: Sequence[str]) -> Named | None:
    """Return the columns that names say; None where they name no stamp, or not each axis of a position once."""
    words = [_words(name) for name in names]
    stamps = [
        at for at, of_name in enumerate(words) if of_name and _stem(of_name)[-1:] and _stem(of_name)[-1] in _STAMPS
    ]
    position = _axes(words, "xyz", _POSITIONS)
    if not stamps or len(position) != 3:
        return None
    seconds, parts = ([at for at in stamps if words[at][-1] in of_unit] for of_unit in (_SECONDS, _NANOSECONDS))
    at, rest = (seconds[0], parts[0]) if seconds and parts else (stamps[0], None)
    return Named(at, _unit_ns(names[at]), position, _axes(words, "xyzw", _QUATERNIONS), rest)


def is_of_the_globe(names: Iterable[str]) -> bool:
    words = {word for name in names for word in _words(name)}
    return bool(words & {"lat", "latitude"} and words & {"lon", "long", "lng", "longitude"})


def stamp_unit_ns(name: str) -> int | None:
    """Return the unit of the stamps in a column of this name, ns; None where it names no stamp, or not their unit."""
    words = _words(name)
    return _unit_ns(name) if words and _stem(words)[-1] in _STAMPS else None


def _unit_ns(name: str) -> int | None:
    in_brackets = _IN_BRACKETS.search(name)
    return _UNITS_NS.get((in_brackets[1].strip().lower() if in_brackets else "") or _words(name)[-1])


def imu_columns(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of accelerations and of rates of rotation, x y z each, whatever a program calls them, or none.

    ``a_RS_S_x``, ``alpha_x`` (Kalibr), ``ax``, ``acc_x`` and ``linear_acceleration.x`` are one and the same, as are
    ``w_RS_S_x``, ``omega_x``, ``wx``, ``gx``, ``gyro_x`` and ``angular_velocity.x``. Names with more words are those of
    other quantities: ``b_w_RS_S_x`` is a bias, ``angular_acceleration.x`` no force.
    """
    plain = {"".join(_words(name)).removeprefix("field"): name for name in names}
    found: list[str] = []
    for kinds in (_ACCELERATIONS, _RATES):
        sets = ([plain.get(f"{kind}{axis}", "") for axis in "xyz"] for kind in kinds)
        found += next((one for one in sets if all(one)), [])
    return tuple(found) if len(found) == 6 else ()


def _words(name: str) -> list[str]:
    """Return the words of a name, without units in brackets, in small letters; the axis is a word of its own."""
    plain = _IN_BRACKETS.sub("", name).strip().strip("#%").lower()
    return [word for word in _BETWEEN_WORDS.split(plain) if word]


def _stem(words: list[str]) -> list[str]:
    """Return the words but for a unit behind the name of a stamp."""
    return words[:-1] if len(words) > 1 and words[-1] in _UNITS_NS else words


def _axes(words: list[list[str]], axes: str, kinds: tuple[str, ...]) -> tuple[int, ...]:
    """Return the columns of the axes of a quantity called one of several names; nothing where one is missing."""
    for kind in kinds:
        found = [[at for at, of_name in enumerate(words) if _is_axis(of_name, axis, kind)] for axis in axes]
        if all(found):
            return tuple(columns[0] for columns in found)
    return ()


def _is_axis(words: list[str], axis: str, kind: str) -> bool:
    """Say whether a name is that of an axis: ``x``, ``px``, ``p_x``, ``p_RS_R_x``, ``pose.position.x``, ``x_m``."""
    if words[-1:] == ["m"] and len(words) > 1:
        words = words[:-1]
    if not words or not words[-1].endswith(axis):
        return False
    if len(words) == 1 or words[-1] != axis:
        return words[-1] == f"{kind}{axis}"
    return bool(kind) and (kind in words[:-1])
