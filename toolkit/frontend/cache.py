"""The front end's files on disk: tracks under the hash of their inputs, and images unpacked from other files.

Tracks depend on images, calibration, settings and this front end. Images inside another file are written one by one,
because the front end reads image files. They are removed when their spool is closed, is no longer used or the program
ends. ``VISLAM_CACHE`` names the folder, by default ``vislam`` in the user's cache folder; all of it may be deleted.
"""

import hashlib
import os
import shutil
import tempfile
import weakref
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from toolkit.errors import DataError, OutputError
from toolkit.files.reading import read_input
from toolkit.files.writing import replaced_file
from toolkit.frontend.cameras import RectifiedPair
from toolkit.frontend.images import StampedPair
from toolkit.sequence import content_digest
from toolkit.settings import Frontend

# Raised with every change of the front end that changes its tracks.
_FRONT_END = 6
# Settings that select the images and do not affect the tracks.
_OF_THE_SOURCE = ("tracks", "topics")
_ARRAYS = ("t_ns", "frame", "track_id", "corners_px")
_HASHERS = 2


def key_of(pairs: Sequence[StampedPair], rig: RectifiedPair, settings: Frontend) -> str:
    """Return the hash of the content of all images, in their order, and of all else that the tracks depend on."""
    paths = [path for pair in pairs for path in (pair.left, pair.right)]
    with ThreadPoolExecutor(_HASHERS) as hashers:
        images = list(hashers.map(_digest, paths))
    requested = {name: getattr(settings, name) for name in settings.__struct_fields__ if name not in _OF_THE_SOURCE}
    stamps = np.array([pair.t_ns for pair in pairs], dtype=np.int64)
    made_by = f"{_FRONT_END} {version('opencv-python-headless')} {version('numpy')}"
    return content_digest((made_by, repr(requested), rig, stamps, *images))


def load(key: str) -> dict[str, Any] | None:
    """Return the tracks kept under a key, or None where there are none or they are damaged."""
    path = _path(key)
    try:
        with np.load(path, allow_pickle=False) as archive:
            kept: dict[str, Any] = {name: archive[name] for name in _ARRAYS}
            kept["skipped"] = tuple(archive["skipped"].tolist())
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile):
        return None
    return kept


def save(key: str, tracks: Mapping[str, Any]) -> None:
    """Keep tracks under a key; if they cannot be written, they are made again next time."""
    path = _path(key)
    arrays = {name: tracks[name] for name in _ARRAYS}
    with suppress(OSError, OutputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replaced_file(path) as partial, partial.open("wb") as stream:
            np.savez(stream, skipped=np.array(tracks["skipped"], dtype=np.str_), **arrays)


def folder() -> Path:
    given = os.environ.get("VISLAM_CACHE")
    if given:
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "vislam"


def _path(key: str) -> Path:
    return folder() / "tracks" / f"{key}.npz"


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(read_input(path)).hexdigest()
    except DataError:
        return "missing"


class ImageSpool:
    """A folder of unpacked images that is there as long as the spool is.

    ``source`` is the file they were unpacked from; messages name it instead of the folder.
    """

    def __init__(self, source: str) -> None:
        self._names = {"": source}
        try:
            folder().mkdir(parents=True, exist_ok=True)
            self.folder = Path(tempfile.mkdtemp(prefix="images-", dir=folder()))
        except OSError as error:
            raise _unwritable(error) from error
        self.close = weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)

    def call(self, name: str, source: str) -> None:
        """Have messages call a folder of the spool by what its images were unpacked of."""
        self._names[name] = source

    @contextmanager
    def errors_named(self) -> Iterator[None]:
        """Have the messages of a DataError name what the images were unpacked of."""
        try:
            yield
        except DataError as error:
            message = str(error)
            for name in sorted(self._names, reverse=True):
                message = message.replace(str(self.folder / name), self._names[name])
            raise DataError(message) from error

    def add_grey(self, name: str, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> Path:
        """Write grey values (height, width) of 8 or 16 bits as PGM and return the path; raises OutputError."""
        height, width = image.shape
        most = np.iinfo(image.dtype).max
        header = f"P5\n{width} {height}\n{most}\n".encode()
        # PGM has the high byte first.
        return self.add(f"{name}.pgm", header + image.astype(image.dtype.newbyteorder(">")).tobytes())

    def add(self, name: str, content: bytes) -> Path:
        """Write the content of an image file and return its path; raises OutputError where that cannot be."""
        path = self.folder / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        except OSError as error:
            raise _unwritable(error) from error
        return path


def _unwritable(error: OSError) -> OutputError:
    why = error.strerror or error
    return OutputError(f"{folder()}: images cannot be kept there ({why}); name another folder with VISLAM_CACHE")
