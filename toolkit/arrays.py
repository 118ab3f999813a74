"""Checks of arrays (shape, rigid transformation), and look-up of values in them."""

from typing import Any

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array, BoolArray, IntArray, read_only


def check_shape(what: str, shape: tuple[int, ...], expected: tuple[int | None, ...]) -> None:
    """Raise DataError, which begins with ``what``, unless the shape is the expected one (None = any length)."""
    fits = len(shape) == len(expected) and all(w in (None, s) for s, w in zip(shape, expected, strict=True))
    if not fits:
        wanted = ", ".join("any" if w is None else str(w) for w in expected)
        raise DataError(f"{what} has shape {shape}, expected ({wanted})")


def rotation_defect(T: Array) -> float:
    """Return how far R R^T of a pose (4, 4) is from the identity, by its largest element."""
    rotation = T[:3, :3]
    return float(np.abs(rotation @ rotation.T - np.eye(3)).max())


def check_rigid(what: str, T: Array, tolerance: float) -> None:
    """Raise DataError, which begins with ``what``, unless T (4, 4) is a rotation, to a tolerance, and a translation."""
    defect = rotation_defect(T)
    if not defect < tolerance:
        raise DataError(f"{what} is not a rotation and a translation (R R^T is off by {defect:.2g})")
    if np.linalg.det(T[:3, :3]) < 0.0:
        raise DataError(f"{what} holds a reflection, not a rotation: the sign of an axis is wrong")
    if not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise DataError(f"{what}: the last row is {T[3].tolist()}, expected 0, 0, 0, 1; transpose it?")


def freeze_arrays(value: Any, **shapes: tuple[int | None, ...]) -> None:
    """Make the named array fields of a frozen dataclass read-only and check their shapes (None = any).

    Fields whose names end as stamps, identities and frames do become int64, all others float64.
    """
    for name, shape in shapes.items():
        given = getattr(value, name)
        if given is None:
            continue
        integer = name.endswith(("_ns", "_id", "_ids", "frame"))
        array = read_only(given, np.int64 if integer else np.float64)
        check_shape(f"{type(value).__name__}.{name}", array.shape, shape)
        object.__setattr__(value, name, array)


def rows_of(wanted: IntArray, ascending: IntArray) -> tuple[IntArray, BoolArray]:
    """Return the rows (M,) of wanted values (M,) among ascending values (N,), and whether each is there (M,)."""
    if not ascending.size:
        return np.zeros(wanted.shape, dtype=np.int64), np.zeros(wanted.shape, dtype=bool)
    rows = np.minimum(np.searchsorted(ascending, wanted), ascending.size - 1)
    return rows, np.asarray(ascending[rows] == wanted)


def is_among(ids: IntArray, others: IntArray) -> BoolArray:
    """Say which ids (N,) are among others (M,), which are unique; for some hundreds, where numpy.isin is slow."""
    return rows_of(ids, np.sort(others))[1]
