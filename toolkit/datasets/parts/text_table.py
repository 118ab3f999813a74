"""Tables of numbers in a text file: a row a line, columns between blanks, comments after ``#``."""

from pathlib import Path

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array


def read_rows(path: Path, columns: str, kind: str) -> tuple[list[int], Array]:
    """Return the line numbers and the rows (N, C) of a file whose columns are named between blanks; N > 0.

    ``kind`` says what such a file is. Raises DataError, naming the line, where it is missing, empty, or not a
    table of that many numbers a line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a text file; {kind}") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions") from error
    lines = [(n, line.partition("#")[0].split()) for n, line in enumerate(text.splitlines(), start=1)]
    rows = [(n, words) for n, words in lines if words]
    if not rows:
        raise DataError(f"{path}: the file holds no poses; {kind}")
    return [n for n, _ in rows], np.array([_numbers(path, n, words, columns) for n, words in rows])


def _numbers(path: Path, line_number: int, words: list[str], columns: str) -> list[float]:
    expected = len(columns.split())
    if len(words) != expected:
        hint = "; columns are separated by blanks, not commas" if any("," in word for word in words) else ""
        found = f"{path}: line {line_number} has {len(words)} columns"
        raise DataError(f"{found}, expected {expected} ({columns}){hint}")
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise DataError(f"{path}: line {line_number} is not numeric ({error}); expected {columns}") from error
