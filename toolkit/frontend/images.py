"""Image files of a stereo pair, read as grey images of 8 bits, some pairs ahead of their use.

An unusable image is returned as such and raises no exception, because one of thousands should not stop a recording.
"""

import struct
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from toolkit.errors import DataError
from toolkit.files.reading import read_input
from toolkit.frontend.cameras import Image

_PNG = b"\x89PNG\r\n\x1a\n"
_LFS_POINTER = b"version https://git-lfs"
_AHEAD = 3
_Requested = TypeVar("_Requested")
_Given = TypeVar("_Given")


@dataclass(frozen=True)
class StampedPair:
    """The files of one instant: stamp (ns), left and right image."""

    t_ns: int
    left: Path
    right: Path


@dataclass(frozen=True)
class Unusable:
    """An image that cannot be used, why, and what to do where all are so."""

    path: Path
    reason: str
    remedy: str = "copy the images again"

    def __str__(self) -> str:
        return f"{'/'.join(self.path.parts[-3:])} ({self.reason})"


def read_image(path: Path, bits: int, size_px: tuple[int, int] | None = None) -> Image | Unusable:
    """Read an image as grey values (height, width) of 8 bits; of deeper ones the 8 that values of ``bits`` fill.

    ``size_px`` is the (width, height) it must have.
    """
    raw = _decoded(path)
    if isinstance(raw, Unusable):
        return raw
    height, width = raw.shape
    if size_px is not None and (width, height) != size_px:
        return Unusable(
            path,
            f"{width}x{height} px, expected {size_px[0]}x{size_px[1]}",
            "where images were scaled, cut or turned, do the same to the calibration",
        )
    if raw.dtype == np.uint16:
        return np.asarray(np.minimum(raw >> max(bits - 8, 0), 255), dtype=np.uint8)
    return np.asarray(raw, dtype=np.uint8)


def bit_depth(paths: Iterable[Path]) -> int:
    """Return how many bits hold all values of some images, of 8, 10, 12, 14 and 16: sensors seldom fill their files."""
    largest = 0
    for path in paths:
        raw = _decoded(path)
        if not isinstance(raw, Unusable):
            largest = max(largest, int(raw.max(initial=0)))
    return next(bits for bits in (8, 10, 12, 14, 16) if largest < 1 << bits)


def size_of(path: Path) -> tuple[int, int]:
    """Return width and height of an image; raises DataError where it cannot be used."""
    raw = _decoded(path)
    if isinstance(raw, Unusable):
        raise DataError(f"{path}: {raw.reason}; {raw.remedy}")
    return raw.shape[1], raw.shape[0]


def _decoded(path: Path) -> npt.NDArray[np.uint8 | np.uint16] | Unusable:
    """Return grey values (height, width) of 8 or 16 bits; of a colour image its brightness."""
    try:
        content = read_input(path)
    except DataError:
        return Unusable(path, "it is missing or cannot be read")
    fault = _fault_of(path, content)
    if fault is not None:
        return fault
    import cv2

    # A damaged image is named in the report; OpenCV would complain on the terminal as well.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        raw = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        raw = None
    if raw is None:
        return Unusable(path, "no image, damaged or truncated")
    if raw.dtype not in (np.uint8, np.uint16):
        return Unusable(path, f"pixels of {raw.dtype}, expected 8 or 16 bits", "convert the images to 8 or 16 bits")
    return np.asarray(raw)


def _fault_of(path: Path, content: bytes) -> Unusable | None:
    """Return what is wrong with the bytes of a file before they are decoded, None where nothing is seen."""
    if not content:
        return Unusable(path, "it is empty")
    if content.startswith(_LFS_POINTER):
        return Unusable(path, "a pointer of Git LFS and no image", "fetch the images with git lfs pull")
    if content.startswith(_PNG) and not _is_whole_png(content):
        return Unusable(path, "damaged or truncated")
    return None


def _is_whole_png(content: bytes) -> bool:
    """Say whether all chunks are there and unharmed; the decoder would complain of others on the terminal by itself."""
    at = len(_PNG)
    while at + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        end = at + 12 + length
        if end > len(content):
            return False
        (stated,) = struct.unpack_from(">I", content, end - 4)
        if zlib.crc32(memoryview(content)[at + 4 : end - 4]) != stated:
            return False
        if content[at + 4 : at + 8] == b"IEND":
            return True
        at = end
    return False


def read_ahead(requested: Iterable[_Requested], read: Callable[[_Requested], _Given]) -> Iterator[_Given]:
    """Yield the result for each request, in order; another thread reads at most a few of them ahead."""
    with ThreadPoolExecutor(1, thread_name_prefix="images") as reader:
        coming: deque[Future[_Given]] = deque()
        try:
            for one in requested:
                coming.append(reader.submit(read, one))
                if len(coming) > _AHEAD:
                    yield coming.popleft().result()
            while coming:
                yield coming.popleft().result()
        finally:
            for future in coming:
                future.cancel()
