"""Writing at once or not at all, and hashes of what is in memory.

A directory or a file appears complete or not at all: it is written beside its place and then renamed into it.
"""

import hashlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np

from toolkit.errors import OutputError
from toolkit.geometry import Array

# Says whether an existing directory was made by us, so that it may be replaced.
IsOurs = Callable[[Path], bool]


def check_replaceable(target: Path, is_ours: IsOurs) -> None:
    """Raise OutputError unless ``target`` can be created, or is a directory that is empty or ours."""
    if target.resolve() == Path.cwd():
        raise OutputError(f"{target} is the current directory and cannot be replaced; name a directory inside it")
    if target.is_symlink() or (target.exists() and not target.is_dir()):
        raise OutputError(f"{target} exists and is not a directory; choose another place for the results")
    try:
        if target.is_dir() and any(target.iterdir()) and not is_ours(target):
            raise OutputError(f"{target} holds other files, which would be lost; choose another directory")
        _probe(target.parent)
    except OSError as error:
        raise _unwritable(target, error) from error


def check_parent(directory: Path) -> None:
    """Raise OutputError unless directories can be made in ``directory``, or it can itself be made first."""
    try:
        _probe(directory)
    except OSError as error:
        raise _unwritable(directory, error) from error


def _probe(directory: Path) -> None:
    """Make a directory in the nearest one that exists, and take it away again."""
    probe = _nearest_existing(directory) / f".vislam-probe-{os.getpid()}"
    probe.mkdir()
    probe.rmdir()


@contextmanager
def replaced_directory(target: Path, is_ours: IsOurs) -> Iterator[Path]:
    """Give an empty directory to write to; on success it takes ``target``'s place, on any failure it is removed.

    Raises OutputError where the place is taken by something else or cannot be written.
    """
    check_replaceable(target, is_ours)
    partial = target.parent / f".{target.name}.partial-{os.getpid()}"
    try:
        partial.mkdir(parents=True)
        yield partial
        _swap(partial, target)
    except OSError as error:
        raise _unwritable(target, error) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def replaced_file(target: Path) -> Iterator[Path]:
    """Give a file to write to; on success it takes ``target``'s place, on any failure it is removed.

    Raises OutputError where the place is taken by a directory or cannot be written.
    """
    if target.is_dir():
        raise OutputError(f"{target} is a directory; name a file in it with --out")
    partial = target.parent / f".{target.name}.partial-{os.getpid()}"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(target)
    except OSError as error:
        raise OutputError(
            f"{target} cannot be written ({error.strerror or error}); choose another file with --out"
        ) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def _swap(new: Path, target: Path) -> None:
    """Rename ``new`` to ``target``; what was there comes back if that fails or is interrupted."""
    old = target.parent / f".{target.name}.replaced-{os.getpid()}"
    try:
        if target.exists():
            target.rename(old)
        new.rename(target)
    finally:
        if old.exists() and not target.exists():
            old.rename(target)
        shutil.rmtree(old, ignore_errors=True)


def _nearest_existing(path: Path) -> Path:
    absolute = path.absolute()
    return next(p for p in (absolute, *absolute.parents) if p.exists())


def _unwritable(target: Path, error: OSError) -> OutputError:
    return OutputError(f"{target} cannot be written ({error.strerror or error}); choose another directory with --out")


def content_digest(values: Iterable[object], digits: int | None = None) -> str:
    """Return the SHA-256, in hexadecimal digits, over arrays, numbers, texts and the fields of dataclasses.

    With ``digits``, what is a float is rounded before: a number to so many digits, an array to as many of its largest
    value. Every array counts with its shape.
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
