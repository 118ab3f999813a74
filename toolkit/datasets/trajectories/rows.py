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
from toolkit.files.reading import read_text_input
from toolkit.geometry import Array, IntArray
from toolkit.measurements import NS_PER_S

_LARGEST_NS = 2**63 - 1
# Digits before the point that fit with nanoseconds into 64 bits, unless the first is 9.
_MOST_DIGITS, _DECIMALS = 10, 9
# The usual form of seconds; reading digits is several times as fast as decimal numbers.
_USUAL_STAMP = re.compile(r"([0-9]{1,10})\.([0-9]{1,9})")


@dataclass(frozen=True)
class Rows:
    """What a table in a text file holds: the number and the cells of each line that is not empty or a comment.

    There is at least one line; ``commas`` is True where commas separate the cells, and not blanks; ``underscored``
    where a cell has an underscore, for Python takes 1_0 for ten and no other program does.
    """

    path: Path
    line_numbers: list[int]
    cells: list[list[str]]
    commas: bool
    underscored: bool = False

    @property
    def width(self) -> int:
        """The number of cells of the first line."""
        return len(self.cells[0])

    def numbers(self, width: int, columns: str) -> Array:
        """Return all cells as numbers (N, width); ``columns`` names the first of them.

        Raises DataError naming the line that has another number of cells or one that is no number.
        """
        if not self.underscored and set(map(len, self.cells)) == {width}:
            with suppress(ValueError):  # told below, with the line
                return np.fromiter(map(float, chain.from_iterable(self.cells)), dtype=float).reshape(-1, width)
        return np.array([self._numbers(n, cells, width, columns) for n, cells in self], dtype=float)

    def stamps(self, per_unit_ns: int) -> IntArray:
        """Return the first cells, in units of ``per_unit_ns``, as int64 nanoseconds (N,), rounded only there.

        A double holds today's seconds to 0.2 us only. Raises DataError naming the line where one is not finite
        or beyond what 64 bits hold.
        """
        first = [cells[0] for cells in self.cells]
        alike = _printed_alike(first) if per_unit_ns == NS_PER_S else None
        if alike is not None:
            return alike
        return np.array([self._stamp(n, cells[0], per_unit_ns) for n, cells in self], dtype=np.int64)

    def __iter__(self) -> Iterator[tuple[int, list[str]]]:
        return zip(self.line_numbers, self.cells, strict=True)

    def _numbers(self, line_number: int, cells: list[str], width: int, columns: str) -> list[float]:
        if len(cells) != width:
            found = f"{self.path}: line {line_number} has {len(cells)} columns"
            raise DataError(f"{found}, expected {width} ({columns})")
        try:
            return [_number(cell) for cell in cells]
        except ValueError as error:
            raise DataError(f"{self.path}: line {line_number} is not numeric ({error}); expected {columns}") from error

    def _stamp(self, line_number: int, cell: str, per_unit_ns: int) -> int:
        if per_unit_ns == NS_PER_S and (usual := _USUAL_STAMP.fullmatch(cell)):
            t_ns = int(usual[1] + usual[2].ljust(9, "0"))
        else:
            try:
                t_ns = int((Decimal(cell) * per_unit_ns).to_integral_value())
            except (InvalidOperation, OverflowError, ValueError):
                raise DataError(
                    f"{self.path}: line {line_number} has no finite time ({cell}); remove the line"
                ) from None
        if abs(t_ns) > _LARGEST_NS:
            raise DataError(f"{self.path}: line {line_number} has the time {cell}, beyond any clock; check its unit")
        return t_ns


def read_rows(path: Path, kind: str) -> Rows:
    """Return the rows of a file; comments start with ``#``, and a heading without it may precede commas.

    ``kind`` describes such a file in an error. Raises DataError where it is missing, empty or not text.
    """
    text = read_text_input(path, kind)
    lines = text.splitlines()
    if "#" in text:
        lines = [line.partition("#")[0] for line in lines]
    last = next((line for line in reversed(lines) if line and not line.isspace()), "")
    commas = "," in last
    cells = [_between_commas(line) for line in lines] if commas else [line.split() for line in lines]
    line_numbers = [n for n, of_line in enumerate(cells, start=1) if of_line]
    cells = [of_line for of_line in cells if of_line]
    if commas and not _is_number(cells[0][0]):
        line_numbers, cells = line_numbers[1:], cells[1:]
    if not cells:
        raise DataError(f"{path}: the file holds no poses; {kind}")
    underscored = "_" in text and any("_" in line for line in lines)
    return Rows(path, line_numbers, cells, commas, underscored)


def _printed_alike(cells: list[str]) -> IntArray | None:
    """Return seconds as nanoseconds (N,) where all have as many digits before and after the point; None elsewhere."""
    width, point = len(cells[0]), cells[0].find(".")
    after = width - point - 1
    if not (0 < point <= _MOST_DIGITS and 0 < after <= _DECIMALS) or set(map(len, cells)) != {width}:
        return None
    characters = np.frombuffer("".join(cells).encode(), dtype=np.uint8)
    if characters.size != width * len(cells):  # some characters are not ASCII
        return None
    digits = characters.reshape(-1, width) - np.int64(ord("0"))
    is_digit = (digits >= 0) & (digits <= 9)
    is_digit[:, point] = digits[:, point] == ord(".") - ord("0")
    if not is_digit.all() or (point == _MOST_DIGITS and digits[:, 0].max() == 9):
        return None
    weights = np.zeros(width, dtype=np.int64)
    weights[:point] = 10 ** np.arange(point + _DECIMALS - 1, _DECIMALS - 1, -1)
    weights[point + 1 :] = 10 ** np.arange(_DECIMALS - 1, _DECIMALS - 1 - after, -1)
    return np.asarray(digits @ weights)


def stamp_text(t_ns: int) -> str:
    """Write nanoseconds as seconds with nine decimals; goes through integers, for a double holds only 16 digits."""
    sign, (seconds, rest_ns) = "-" if t_ns < 0 else "", divmod(abs(t_ns), NS_PER_S)
    return f"{sign}{seconds}.{rest_ns:09d}"


def _between_commas(line: str) -> list[str]:
    """Split a line, which has no cells where it is empty; some programs end theirs with a comma."""
    stripped = line.strip()
    return [cell.strip() for cell in stripped.removesuffix(",").split(",")] if stripped else []


def _number(cell: str) -> float:
    if "_" in cell:
        raise ValueError(f"could not convert string to float: {cell!r}")
    return float(cell)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
