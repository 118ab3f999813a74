"""Columns by name, of a CSV file or of a program's own values, with every complaint naming table, column and row."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from toolkit.datasets.io.fields import probable_unit, stamps_ns
from toolkit.datasets.io.tables import read_whole
from toolkit.errors import DataError, nearest, printable
from toolkit.geometry import Array, IntArray
from toolkit.resampling import NS_PER_S

SECONDS, NANOSECONDS = "t", "t_ns"
# A row of a file is counted as an editor does: the heading is line 1.
_FIRST_LINE = 2
_LARGEST = 2**63 - 1


@dataclass(frozen=True, eq=False)
class Columns:
    """A table: what it is called in a complaint, its columns (N,), texts or numbers, by name, and where row 0 is."""

    what: Path
    values: Mapping[str, Sequence[Any] | npt.NDArray[Any]]
    row: str = "row"
    first: int = 0

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
        """Return columns side by side (N, C) as float64, NaN included; raises DataError naming the row of a text."""
        return np.stack([self._numbers(name) for name in names], axis=1)

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
            return self.whole(NANOSECONDS)
        values = self.values[SECONDS]
        if isinstance(values, np.ndarray) and values.dtype.kind in "fiu":
            return stamps_ns(self.what, SECONDS, values.astype(np.float64))
        exact = [self._decimal(i, str(value)) for i, value in enumerate(values)]
        unit = probable_unit(np.array(exact, dtype=np.float64))
        if unit is not None:
            raise DataError(f"{self.what}: {SECONDS} must be in seconds, but the stamps look like {unit}")
        return np.array([self._ns(i, seconds) for i, seconds in enumerate(exact)], dtype=np.int64)

    def at(self, row: int) -> str:
        """Return how a row is called."""
        return f"{self.row} {row + self.first}"

    def unused(self, used: Iterable[str]) -> tuple[str, ...]:
        """Return the names of the columns that are none of those used."""
        known = set(used)
        return tuple(name for name in self.names if name not in known)

    def _numbers(self, name: str) -> Array:
        values = np.asarray(self.values[name])
        if values.ndim != 1:
            raise DataError(f"{self.what}: column {name} has shape {values.shape}, expected one number a row")
        try:
            if values.dtype.kind == "U" and (np.strings.find(values, "_") >= 0).any():
                raise ValueError  # Python takes 1_0 for ten
            return values.astype(np.float64)
        except (TypeError, ValueError):
            bad = next(i for i, value in enumerate(values.tolist()) if not _is_number(value))
            shown = printable(str(values[bad]))[:50] or "empty"
            raise DataError(f"{self.what}: {self.at(bad)}: {name} is {shown}, expected a number") from None

    def _whole(self, name: str, row: int, value: Any) -> int:
        try:
            exact = Decimal(value.replace("_", "?")) if isinstance(value, str) else value
            number = int(exact) if abs(exact) <= _LARGEST else None
        except (TypeError, ValueError, InvalidOperation):  # NaN is no number either
            exact, number = value, None
        if number is None or number != exact:
            shown = printable(str(value))[:50] or "empty"
            raise DataError(f"{self.what}: {self.at(row)}: {name} is {shown}, expected a whole number")
        return number

    def _decimal(self, row: int, text: str) -> Decimal:
        try:
            seconds = Decimal(text.replace("_", "?"))
        except InvalidOperation:
            seconds = Decimal("nan")
        if not seconds.is_finite():
            shown = printable(text)[:50] or "empty"
            raise DataError(f"{self.what}: {self.at(row)}: {SECONDS} is {shown}, expected seconds")
        return seconds

    def _ns(self, row: int, seconds: Decimal) -> int:
        t_ns = int((seconds * NS_PER_S).to_integral_value())
        if abs(t_ns) > _LARGEST:
            shown = f"{seconds:.6g}"
            raise DataError(f"{self.what}: {self.at(row)}: {SECONDS} is {shown}, beyond any clock; check its unit")
        return t_ns


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return "_" not in str(value)


def columns_of_file(path: Path) -> Columns:
    """Read a CSV, plain or gzipped, whose first line names its columns; comments and units after names are left out.

    Raises DataError where it cannot be read, has no rows, a column twice, or a row of another length.
    """
    try:
        text = read_whole(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a text file; write a CSV, one row a line, with names in the first") from error
    heading, *lines = text.splitlines() or [""]
    names = [name.strip().lstrip("#").partition("[")[0].strip() for name in heading.split(",")]
    if len(set(names)) < len(names):
        raise DataError(f"{path}: a column name is there twice in {printable(heading)[:200]}; rename or remove one")
    rows = [line.split(",") for line in lines]
    while rows and rows[-1] == [""]:
        rows.pop()
    wrong = next((i for i, row in enumerate(rows) if len(row) != len(names)), None)
    if wrong is not None:
        raise DataError(f"{path}: line {wrong + _FIRST_LINE} has {len(rows[wrong])} columns, expected {len(names)}")
    if not rows:
        raise DataError(f"{path}: holds no rows; its first line names the columns, the others hold them")
    values = {
        name: [cell.strip() for cell in cells] for name, cells in zip(names, zip(*rows, strict=True), strict=True)
    }
    return Columns(path, values, "line", _FIRST_LINE)


def columns_given(what: str, given: Any) -> Columns:
    """Return what a program gives as columns: a mapping of names to values (N,), or anything like a data frame.

    Raises DataError where it is none, or its columns differ in length.
    """
    try:
        values = {str(name): np.asarray(given[name]) for name in given}
        lengths = {name: len(column) for name, column in values.items()}
    except (TypeError, KeyError, IndexError, ValueError) as error:
        raise DataError(f"{what}: is no mapping of column names to values ({error}); give a dict of arrays") from error
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise DataError(f"{what}: its columns differ in length: {told}")
    return Columns(Path(what), values)
