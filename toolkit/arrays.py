"""Checks of arrays (shape, rigid transformation), look-up of values in them, and a digest of their content."""

import hashlib
from collections.abc import Iterable
from dataclasses import fields, is_dataclass
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


def content_digest(values: Iterable[object], digits: int | None = None) -> str:
    """Return the SHA-256, in hexadecimal digits, over arrays, numbers, texts and the fields of dataclasses.

    With ``digits``, floats are rounded first: a number to that many significant digits, an array to that many digits of
    its largest value. The shape of every array is part of the digest.
    """
    digest = hashlib.sha256()
    for value in values:
        _feed(digest, value, digits)
    return digest.hexdigest()


def _feed(digest: "hashlib._Hash", value: object, digits: int | None) -> None:
    if isinstance(value, np.ndarray):
        counted = value if digits is None or value.dtype.kind != "f" else _rounded(value, digits)
        digest.update(str(value.shape).encode())
        digest.update(np.ascontiguousarray(counted).data)
    elif is_dataclass(value):
        for field in fields(value):
            _feed(digest, getattr(value, field.name), digits)
    elif digits is not None and isinstance(value, float):
        digest.update(f"{value:.{digits}g}".encode())
    else:
        digest.update(repr(value).encode())


def _rounded(array: Array, digits: int) -> Array:
    """Return an array rounded to so many digits of its largest value, without -0.0, whose bits are not those of 0."""
    finite = np.abs(array[np.isfinite(array)])
    largest = float(finite.max()) if finite.size else 0.0
    if largest == 0.0:
        return array + 0.0
    return np.round(array, digits - 1 - int(np.floor(np.log10(largest)))) + 0.0
