"""The lines of a text file as cells with their line numbers, and printed stamps as exact nanoseconds."""

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import chain
from pathlib import Path

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array, IntArray
from toolkit.inputs import read_text_input
from toolkit.resampling import NS_PER_S

_LARGEST_NS = 2**63 - 1
# How seconds are usually printed; as digits they are read several times as fast as through decimals.
_USUAL_STAMP = re.compile(r"([0-9]{1,10})\.([0-9]{1,9})")


@dataclass(frozen=True)
class Rows:
    """What a table in a text file holds: the number and the cells of each line that is not empty or a comment.

    There is at least one line; ``commas`` is True where commas separate the cells, and not blanks.
    """

    path: Path
    line_numbers: list[int]
    cells: list[list[str]]
    commas: bool

    @property
    def width(self) -> int:
        """The number of cells of the first line."""
        return len(self.cells[0])

    def numbers(self, width: int, columns: str) -> Array:
        """Return all cells as numbers (N, width); ``columns`` names the first of them.

        Raises DataError naming the line that has another number of cells or one that is no number.
        """
        if all(len(cells) == width for cells in self.cells):
            with suppress(ValueError):  # told below, with the line
                return np.array(list(map(float, chain.from_iterable(self.cells)))).reshape(-1, width)
        return np.array([self._numbers(n, cells, width, columns) for n, cells in self], dtype=float)

    def stamps(self, per_unit_ns: int) -> IntArray:
        """Return the first cells, in units of so many nanoseconds, as int64 nanoseconds (N,), rounded only there.

        A double holds today's seconds to 0.2 us only. Raises DataError naming the line where one is not finite
        or beyond what 64 bits hold.
        """
        return np.array([self._stamp(n, cells[0], per_unit_ns) for n, cells in self], dtype=np.int64)

    def __iter__(self) -> Iterator[tuple[int, list[str]]]:
        return zip(self.line_numbers, self.cells, strict=True)

    def _numbers(self, line_number: int, cells: list[str], width: int, columns: str) -> list[float]:
        if len(cells) != width:
            found = f"{self.path}: line {line_number} has {len(cells)} columns"
            raise DataError(f"{found}, expected {width} ({columns})")
        try:
            return [float(cell) for cell in cells]
        except ValueError as error:
            raise DataError(f"{self.path}: line {line_number} is not numeric ({error}); expected {columns}") from error

    def _stamp(self, line_number: int, cell: str, per_unit_ns: int) -> int:
        if per_unit_ns == NS_PER_S and (usual := _USUAL_STAMP.fullmatch(cell)):
            return int(usual[1] + usual[2].ljust(9, "0"))
        try:
            t_ns = int((Decimal(cell) * per_unit_ns).to_integral_value())
        except (InvalidOperation, OverflowError, ValueError):
            raise DataError(f"{self.path}: line {line_number} has no finite time ({cell}); remove the line") from None
        if abs(t_ns) > _LARGEST_NS:
            raise DataError(f"{self.path}: line {line_number} has the time {cell}, beyond any clock; check its unit")
        return t_ns


def read_rows(path: Path, kind: str) -> Rows:
    """Return the rows of a file; comments start with ``#``, and a heading without it may precede commas.

    ``kind`` describes such a file in an error. Raises DataError where it is missing, empty or not text.
    """
    text = read_text_input(path, kind)
    stripped = (line.partition("#")[0].strip() for line in text.splitlines())
    lines = [(n, line) for n, line in enumerate(stripped, start=1) if line]
    commas = bool(lines) and "," in lines[-1][1]
    rows = [(n, _cells(line, commas=commas)) for n, line in lines]
    if commas and not _is_number(rows[0][1][0]):
        rows = rows[1:]
    if not rows:
        raise DataError(f"{path}: the file holds no poses; {kind}")
    return Rows(path, [n for n, _ in rows], [cells for _, cells in rows], commas)


def stamp_text(t_ns: int) -> str:
    """Write nanoseconds as seconds with nine decimals; goes through integers, for a double holds only 16 digits."""
    sign, (seconds, rest_ns) = "-" if t_ns < 0 else "", divmod(abs(t_ns), NS_PER_S)
    return f"{sign}{seconds}.{rest_ns:09d}"


def _cells(line: str, *, commas: bool) -> list[str]:
    """Split a line; some programs end theirs with a comma."""
    return [cell.strip() for cell in line.removesuffix(",").split(",")] if commas else line.split()


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
