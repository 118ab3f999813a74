"""Columns of CSV tables by name, plain or gzipped, and tables of the ASL format with stamps in whole nanoseconds.

ASL: Burri et al., "The EuRoC micro aerial vehicle datasets" (IJRR 2016), section 3.
"""

import gzip
import io
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array, IntArray
from toolkit.inputs import is_regular, open_input, read_input, read_text_input

_LONGEST_LINE = 1 << 16
_GZIP_MAGIC = b"\x1f\x8b"


def find_table(folder: Path, name: str) -> Path | None:
    """Return the path of a table in a folder, ``name`` or ``name.gz``, or None where there is neither."""
    candidates = (folder / name, folder / f"{name}.gz")
    return next((path for path in candidates if is_regular(path)), None)


def first_line(path: Path) -> bytes:
    """Return the first line of a table, or nothing where it cannot be read."""
    try:
        with open_input(path) as raw:
            zipped = raw.read(len(_GZIP_MAGIC)) == _GZIP_MAGIC
        with gzip.open(path) if zipped else path.open("rb") as stream:
            return stream.readline(_LONGEST_LINE)
    except (DataError, OSError, EOFError, zlib.error):
        return b""


def read_columns(path: Path, names: tuple[str, ...]) -> Array:
    """Return the named columns (N, C) of a table, in that order; N may be 0.

    Raises DataError where the file is damaged, a column is missing (all are listed), or a row is not numeric.
    """
    header, _, body = read_whole(path).partition(b"\n")
    columns = [name.strip() for name in header.decode(errors="replace").split(",")]
    missing = [name for name in names if name not in columns]
    if missing:
        raise DataError(f"{path}: missing column {', '.join(missing)}; its first line is {', '.join(columns)[:200]}")
    if not body.strip():
        return np.empty((0, len(names)))
    try:
        wanted = [columns.index(name) for name in names]
        table: Array = np.loadtxt(io.BytesIO(body), delimiter=",", usecols=wanted, ndmin=2)
    except ValueError as error:
        raise DataError(f"{path}: after the header, {_first_sentence(error)}; the file may be truncated") from error
    return table


def read_whole(path: Path) -> bytes:
    """Return the content of a table, plain or gzipped; raises DataError where it cannot be read or is damaged."""
    content = read_input(path)
    try:
        return gzip.decompress(content) if content.startswith(_GZIP_MAGIC) else content
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"{path}: damaged or truncated gzip ({error}); copy it again") from error


def _first_sentence(error: ValueError) -> str:
    return str(error).partition("\n")[0].partition(";")[0].rstrip(".")


@dataclass(frozen=True, eq=False)
class AslTable:
    """Rows of one table: stamps (N,) ns in the file's order, and the requested columns (N, C)."""

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
    lines = read_text_input(path, "copy it again").splitlines()[header_lines:]
    entries = [line.partition(",")[0].strip() for line in lines if line.strip() and not line.startswith("#")]
    if not entries:
        raise DataError(f"{path}: holds no rows; copy the whole recording")
    try:
        return np.array([int(entry) for entry in entries], dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise DataError(f"{path}: a stamp is not in whole nanoseconds ({error}); write seconds times 1e9") from error
