"""Columns of a CSV file with a header line, plain or gzipped, by name."""

import gzip
import io
import zlib
from pathlib import Path

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array

_GZIP_MAGIC = b"\x1f\x8b"


def find_table(folder: Path, name: str) -> Path | None:
    """Return the path of a table in a folder, ``name`` or ``name.gz``, or None where there is neither."""
    candidates = (folder / name, folder / f"{name}.gz")
    return next((path for path in candidates if path.is_file()), None)


def first_line(path: Path) -> bytes:
    """Return the first line of a table, or nothing where it cannot be read."""
    try:
        with path.open("rb") as raw:
            zipped = raw.read(len(_GZIP_MAGIC)) == _GZIP_MAGIC
        with gzip.open(path) if zipped else path.open("rb") as stream:
            return stream.readline()
    except (OSError, EOFError, zlib.error):
        return b""


def read_columns(path: Path, names: tuple[str, ...]) -> Array:
    """Return the named columns (N, C) of a table, in that order; N may be 0.

    Raises DataError where the file is damaged, a column is missing (all are listed), or a row is not numeric.
    """
    header, _, body = _content(path).partition(b"\n")
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


def _content(path: Path) -> bytes:
    try:
        content = path.read_bytes()
        return gzip.decompress(content) if content.startswith(_GZIP_MAGIC) else content
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"{path}: damaged or truncated gzip ({error}); copy it again") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions") from error


def _first_sentence(error: ValueError) -> str:
    return str(error).partition("\n")[0].partition(";")[0].rstrip(".")
