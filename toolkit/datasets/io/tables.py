"""Tables: columns by name, of a CSV file, plain or gzipped, or of a program's own values; a complaint names the place.

Tables of one's own may be written in several ways, and are read value by value. Those of the ASL format have stamps in
whole nanoseconds and are read at once: Burri et al., "The EuRoC micro aerial vehicle datasets" (IJRR 2016), section 3.
"""

import codecs
import csv
import gzip
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from toolkit.datasets.io.fields import exact_ns, probable_unit, probable_unit_of_ns, stamps_ns
from toolkit.datasets.trajectories.headings import stamp_unit_ns
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
    """A table: what it is called in a complaint, its columns (N,) by name, and what rows are called.

    The columns of a file are tuples of texts, those of a program arrays.
    ``numbers_of_rows`` are those of a file's lines, as an editor counts them; None counts from 0.
    """

    what: Path
    values: Mapping[str, Sequence[Any] | npt.NDArray[Any]]
    row: str = "row"
    numbers_of_rows: tuple[int, ...] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all columns."""
        return tuple(self.values)

    def require(self, *alternatives: str) -> None:
        """Raise DataError for columns that are missing, with the like-named there are; ``"a|b"`` is either."""
        missing = [names for names in alternatives if not any(name in self.values for name in names.split("|"))]
        if not missing:
            return
        hints = (self._hint(names.split("|")) for names in missing)
        wanted = ", ".join(names.replace("|", " or ") + hint for names, hint in zip(missing, hints, strict=True))
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
        return np.stack([self._numbers(name) for name in names], axis=1)

    def numbers_or_none(self, *names: str) -> Array:
        """Return columns as :meth:`numbers` does, with NaN where a text is empty."""
        given = {name: self.values[name] for name in names}
        texts = {name: cells for name, cells in given.items() if all(isinstance(cell, str) for cell in cells)}
        filled = {name: tuple(cell.strip() or "nan" for cell in cells) for name, cells in texts.items()}
        return replace(self, values={**self.values, **filled}).numbers(*names)

    def whole(self, name: str) -> IntArray:
        """Return a column of whole numbers (N,); raises DataError naming the row of anything else."""
        values = self.values[name]
        if isinstance(values, np.ndarray) and values.dtype.kind in "iu":
            return values.astype(np.int64)
        return np.array([self._whole(name, i, value) for i, value in enumerate(values)], dtype=np.int64)

    def stamps(self) -> IntArray:
        """Return the stamps (N,) of a column t, in seconds, or t_ns, as int64 nanoseconds, rounded only there.

        Raises DataError where there are both or neither, one is no time, or they are not in seconds.
        """
        self.require(f"{SECONDS}|{NANOSECONDS}")
        if SECONDS in self.values and NANOSECONDS in self.values:
            raise DataError(f"{self.what}: has the columns {SECONDS} and {NANOSECONDS}; leave one out")
        if NANOSECONDS in self.values:
            t_ns = self.whole(NANOSECONDS)
            unit = probable_unit_of_ns(t_ns)
            if unit is not None:
                raise DataError(f"{self.what}: {NANOSECONDS} must be in nanoseconds, but the stamps look like {unit}")
            return t_ns
        values = self.values[SECONDS]
        if isinstance(values, np.ndarray) and values.dtype.kind in "fiu":
            return stamps_ns(self.what, SECONDS, values.astype(np.float64))
        seconds = self._numbers(SECONDS)
        unit = probable_unit(seconds[np.isfinite(seconds)])  # what is no number is named with its row below
        if unit is not None:
            raise DataError(f"{self.what}: {SECONDS} must be in seconds, but the stamps look like {unit}")
        return exact_ns(list(map(str, values)), NS_PER_S, lambda row: f"{self.what}: {self.at(row)}")

    def at(self, row: int) -> str:
        """Return how a row is called."""
        return f"{self.row} {row if self.numbers_of_rows is None else self.numbers_of_rows[row]}"

    def _numbers(self, name: str) -> Array:
        given = self.values[name]
        values: npt.NDArray[Any] = np.empty(0) if isinstance(given, tuple) else np.asarray(given)
        if values.ndim != 1:
            raise DataError(f"{self.what}: column {name} has shape {values.shape}, expected one number a row")
        if values.dtype.kind == "c":
            raise DataError(f"{self.what}: column {name} holds complex numbers; give their real parts")
        try:
            if isinstance(given, tuple) and "_" not in "".join(given):  # Python takes 1_0 for ten
                return np.fromiter(map(float, given), dtype=np.float64, count=len(given))
            if isinstance(given, tuple) or (values.dtype.kind == "U" and (np.strings.find(values, "_") >= 0).any()):
                raise ValueError
            return values.astype(np.float64)
        except (TypeError, ValueError):
            bad, value = next((i, value) for i, value in enumerate(given) if not is_number(value))
            shown = printable(str(value).strip())[:50] or "empty"
            point = " with a decimal point" if "," in shown else ""
            raise DataError(f"{self.what}: {self.at(bad)}: {name} is {shown}, expected a number{point}") from None

    def _whole(self, name: str, row: int, value: Any) -> int:
        try:
            exact = Decimal(value.replace("_", "?")) if isinstance(value, str) else value
            too_large = bool(abs(exact) > _LARGEST)
            number = None if too_large else int(exact)
        except (TypeError, ValueError, InvalidOperation):  # NaN is no number either
            exact, number, too_large = value, None, False
        if number is None or number != exact:
            shown = printable(str(value).strip())[:50] or "empty"
            most = f" of at most {_LARGEST}" if too_large else ""
            raise DataError(f"{self.what}: {self.at(row)}: {name} is {shown}, expected a whole number{most}")
        return number


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
    has no names or no rows, a column twice, or a row of another length.
    """
    text = read_unzipped(path).removeprefix(codecs.BOM_UTF8).decode(errors="replace")
    if "\0" in text:
        raise DataError(f"{path}: not a text file; write a CSV, one row a line, with names in the first")
    heading, lines = _heading(path, text)
    separator = max(_SEPARATORS, key=heading.count)
    if separator not in heading and len(heading.split()) > 1:
        raise DataError(f"{path}: its columns are separated by blanks; separate them by commas, semicolons or tabs")
    names = _canonical(_cells(heading, separator))
    kept = names[:-1] if names[-1] == "" else names  # some programs end each line with a separator
    if len(set(kept)) < len(kept):
        raise DataError(f"{path}: a column name is there twice in {printable(heading)[:200]}; rename or remove one")
    if not lines:
        raise DataError(f"{path}: holds no rows; its first line names the columns, the others hold them")
    values = dict(zip(kept, _split(path, lines, separator, len(names)), strict=False))
    return Columns(path, values, "line", tuple(number for number, _ in lines))


def _split(path: Path, lines: Sequence[tuple[int, str]], separator: str, width: int) -> Iterator[tuple[str, ...]]:
    """Return the columns of lines; raises DataError, naming the line, where one has another number of cells."""
    whole = separator.join(line for _, line in lines)
    if '"' not in whole and {line.count(separator) for _, line in lines} == {width - 1}:
        cells = whole.split(separator)
        return (tuple(cells[column::width]) for column in range(width))
    rows = [_cells(line, separator) for _, line in lines]
    rows = [row[:-1] if len(row) == width + 1 and not row[-1].strip() else row for row in rows]
    for (number, _), row in zip(lines, rows, strict=True):
        if len(row) != width:
            raise DataError(f"{path}: line {number} has {len(row)} columns, expected {width}")
    return zip(*rows, strict=True)


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


def _heading(path: Path, text: str) -> tuple[str, list[tuple[int, str]]]:
    """Return the line that names the columns, and the others with their numbers, without comments and empty ones."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    rows = [(number, line) for number, line in lines if not line.lstrip().startswith("#")]
    before = [line for number, line in lines if not rows or number < rows[0][0]]
    if rows and not any(is_number(_cells(rows[0][1], separator)[0]) for separator in _SEPARATORS):
        return rows[0][1], rows[1:]
    if not before:
        what = "holds numbers and no names" if rows else "holds no rows"
        raise DataError(f"{path}: {what}; its first line names the columns, the others hold them")
    return before[-1], rows


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
    return Columns(Path(what), values)
