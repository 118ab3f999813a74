"""The YAML of calibration files: the numbers, texts and lists of numbers in it, by dotted keys.

Files in OpenCV's dialect begin with ``%YAML:1.0``, which is not YAML, and tag their matrices ``!!opencv-matrix``;
Kalibr writes matrices as lists of rows, which OpenCV's own reader does not take.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from toolkit.datasets.io.fields import Fields
from toolkit.errors import DataError
from toolkit.files.reading import read_text_input

_DIALECT = "%YAML:"
# A calibration of a rig of many cameras takes some thousand characters.
_MOST_CHARACTERS = 1_000_000
# An alias may repeat all that stands before it: nine lists of ten, each of the one before, are a billion values.
_MOST_VALUES = 200_000


def read_fields(path: Path) -> Fields:
    """Return what a file holds as arrays with dotted keys: numbers (), lists of numbers (n,) or (n, m), and texts ().

    OpenCV's matrices, mappings of rows, cols and data, are given as arrays (rows, cols) too, under their own key.
    What is none of these, as a list of names, is left out. Raises DataError, naming the line where there is one, where
    the file cannot be read, is no YAML, or says a thing twice.
    """
    text = read_text_input(path, "copy it again")
    if len(text) > _MOST_CHARACTERS:
        raise DataError(f"{path}: {len(text)} characters are no calibration; name another file")
    # The line is kept, so that errors name the file's own lines.
    plain = "\n".join("" if line.startswith(_DIALECT) else line for line in text.split("\n"))
    try:
        document = yaml.load(plain, _Loader)
    except yaml.MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f"line {error.problem_mark.line + 1}: "
        raise DataError(f"{path}: {line}{error.problem or error}; it is no YAML, or truncated") from error
    except RecursionError as error:
        raise DataError(f"{path}: is nested too deeply for a calibration; name another file") from error
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        why = str(error).partition("\n")[0].partition(";")[0]
        raise DataError(f"{path}: is no YAML of a calibration ({why}); copy it again, or name another file") from error
    if not isinstance(document, dict):
        raise DataError(f"{path}: holds no 'key: value'; a calibration is made of them")
    return Fields(path, dict(_flattened(document, "")))


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """PyYAML's safe loader, which takes OpenCV's matrices as the mappings they are, and a key only once."""

    def get_single_node(self) -> Any:
        """Return the document's node; raises YAMLError where aliases make a small file into a huge document."""
        node = super().get_single_node()
        if node is not None and _values_in(node, {}) > _MOST_VALUES:
            raise yaml.YAMLError(f"its aliases (*name) repeat it to more than {_MOST_VALUES} values")
        return node


def _values_in(node: Any, known: dict[int, int]) -> int:
    """Return how many values a node stands for, each alias counted with all that it repeats.

    ``known`` has those of nodes by their ids; a node inside itself counts as none, and is refused elsewhere.
    """
    if id(node) not in known:
        known[id(node)] = 0
        inner = [] if isinstance(node, yaml.ScalarNode) else node.value
        parts = (part for one in inner for part in (one if isinstance(one, tuple) else (one,)))
        known[id(node)] = 1 + sum(_values_in(part, known) for part in parts)
    return known[id(node)]


def _mapping(loader: _Loader, node: Any) -> dict[Any, Any]:
    before: set[str] = set()
    for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
        if isinstance(key, yaml.ScalarNode):
            if key.value in before:
                raise yaml.MarkedYAMLError(problem=f"gives {key.value} a second time", problem_mark=key.start_mark)
            before.add(key.value)
    mapping: dict[Any, Any] = loader.construct_mapping(node, deep=True)
    return mapping


for _tag in ("tag:yaml.org,2002:map", "tag:yaml.org,2002:opencv-matrix"):
    _Loader.add_constructor(_tag, _mapping)


def _flattened(value: Any, key: str) -> Iterator[tuple[str, np.ndarray]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _flattened(inner, f"{key}.{name}" if key else str(name))
        matrix = _as_matrix(value)
        if matrix is not None:
            yield key, matrix
        return
    array = _as_array(value)
    if array is not None:
        yield key, array


def _as_matrix(mapping: dict[Any, Any]) -> np.ndarray | None:
    """Return the matrix (rows, cols) that a mapping is in OpenCV's dialect, None where it is another."""
    data, rows, cols = _as_array(mapping.get("data")), mapping.get("rows"), mapping.get("cols")
    if data is None or not isinstance(rows, int) or not isinstance(cols, int) or data.size != rows * cols:
        return None
    return data.reshape(rows, cols)


def _as_array(value: Any) -> np.ndarray | None:
    """Return a number, a list of numbers or of rows of them, or a text; None for anything else."""
    if isinstance(value, str):
        try:  # YAML takes 1e-3, without a point, for a text
            return np.array(float(value))
        except ValueError:
            return np.array(value)
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return _list_with_texts(value)
    return array if np.isfinite(array).all() or isinstance(value, list | float) else None


def _list_with_texts(value: Any) -> np.ndarray | None:
    """Return a list of which some numbers were read as texts, as 1e-3 is."""
    if not isinstance(value, list):
        return None
    try:
        return np.array([[float(x) for x in row] if isinstance(row, list) else float(row) for row in value])
    except (TypeError, ValueError, OverflowError):
        return None
