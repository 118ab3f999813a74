"""Tables of the ASL data format: CSV with stamps in whole nanoseconds and a header of names with units in brackets.

Burri et al., "The EuRoC micro aerial vehicle datasets" (IJRR 2016), section 3.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolkit.datasets.io.csv_table import first_line, read_columns
from toolkit.errors import DataError
from toolkit.geometry import Array, IntArray


@dataclass(frozen=True, eq=False)
class AslTable:
    """Rows of one table: stamps (N,) ns in the file's order, and the columns asked for (N, C)."""

    t_ns: IntArray
    values: Array


def columns_of(path: Path) -> dict[str, str]:
    """Return the headings of a table by their names without ``#`` and units; none where it cannot be read."""
    headings = [heading.strip() for heading in first_line(path).decode(errors="replace").split(",")]
    return {heading.lstrip("#").partition("[")[0].strip(): heading for heading in headings}


def read_table(path: Path, names: tuple[str, ...]) -> AslTable:
    """Read the stamps, the first column, and the named columns of a table; N > 0.

    Raises DataError where the file cannot be read, a column is missing, there are no rows, a stamp is no whole
    number or a value no number.
    """
    headings = columns_of(path)
    values = read_columns(path, tuple(headings.get(name, name) for name in names))
    t_ns = read_stamps(path, header_lines=1)
    return AslTable(t_ns, values)


def read_stamps(path: Path, header_lines: int = 0) -> IntArray:
    """Read the first column of a table, or a list of stamps alone, as int64 nanoseconds (N,); N > 0.

    Whole numbers all the way: today's nanoseconds as doubles are off by up to 128.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()[header_lines:]
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a text file; copy it again") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions") from error
    words = [line.partition(",")[0].strip() for line in lines if line.strip() and not line.startswith("#")]
    if not words:
        raise DataError(f"{path}: holds no rows; copy the whole recording")
    try:
        return np.array([int(word) for word in words], dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise DataError(f"{path}: a stamp is not in whole nanoseconds ({error}); export it again") from error
