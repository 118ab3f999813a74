"""The YAML of calibration files, as far as they use it: nested mappings of numbers, text and lists of numbers.

Files in OpenCV's dialect begin with ``%YAML:1.0``, which is not YAML and which general readers refuse; a strict
reader of these few forms needs no further dependency.
"""

from pathlib import Path

import numpy as np

from toolkit.datasets.io.fields import Fields
from toolkit.errors import DataError
from toolkit.inputs import read_text_input


def read_fields(path: Path) -> Fields:
    """Return what a file holds as arrays with dotted keys: numbers, lists of numbers (n,), and text as it is.

    Raises DataError, naming the line, where the file cannot be read or holds any other form.
    """
    text = read_text_input(path, "copy it again")
    found: dict[str, np.ndarray] = {}
    parents: list[tuple[int, str]] = []
    for number, indent, statement in _statements(path, text):
        key, colon, value = statement.partition(":")
        if not colon or not key.strip():
            raise DataError(f"{path}: line {number} is no 'key: value'; calibration files hold nothing else")
        while parents and parents[-1][0] >= indent:
            parents.pop()
        name = ".".join([*(parent for _, parent in parents), key.strip()])
        value = value.strip()
        if not value or value.startswith("!!"):
            parents.append((indent, key.strip()))
        elif name in found:
            raise DataError(f"{path}: line {number} gives {name} a second time; remove one of the two")
        else:
            found[name] = _value(path, number, value)
    return Fields(path, found)


def _statements(path: Path, text: str) -> list[tuple[int, int, str]]:
    """Return line number, indentation and text of each statement; a list may go on over several lines."""
    statements: list[tuple[int, int, str]] = []
    open_list = False
    for number, line in enumerate(text.splitlines(), start=1):
        bare = line.partition("#")[0].rstrip()
        if not bare.strip() or (not open_list and bare.startswith(("%", "---", "..."))):
            continue
        if open_list:
            first, indent, begun = statements[-1]
            statements[-1] = (first, indent, f"{begun} {bare.strip()}")
        else:
            statements.append((number, len(bare) - len(bare.lstrip()), bare.strip()))
        so_far = statements[-1][2]
        open_list = so_far.count("[") > so_far.count("]")
    if open_list:
        raise DataError(f"{path}: the list begun in line {statements[-1][0]} has no end; the file may be truncated")
    return statements


def _value(path: Path, number: int, value: str) -> np.ndarray:
    """Return a list of numbers (n,), a number (), or text ()."""
    if value.startswith("["):
        try:
            return np.array([float(word) for word in value.strip("[] ").split(",") if word.strip()])
        except ValueError as error:
            raise DataError(f"{path}: line {number}: {error}; lists are of numbers") from error
    try:
        return np.array(float(value))
    except ValueError:
        return np.array(value.strip("'\""))
