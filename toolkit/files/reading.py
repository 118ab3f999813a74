"""Input files are opened in one way: regular files only, with an error that says what is wrong.

Reading a pipe may wait forever, and a device may never end.
"""

import errno
import gzip
import stat
import zlib
from pathlib import Path
from typing import BinaryIO

from toolkit.errors import DataError, printable

GZIP_MAGIC = b"\x1f\x8b"
_KINDS = (
    (stat.S_ISDIR, "it is a directory; name a file"),
    (stat.S_ISFIFO, "it is a pipe; write it to a regular file first"),
    (stat.S_ISSOCK, "it is a socket; name a regular file"),
    (lambda mode: stat.S_ISCHR(mode) or stat.S_ISBLK(mode), "it is a device; name a regular file"),
)
_REMEDIES = {
    **dict.fromkeys((errno.ENOENT, errno.ENOTDIR, errno.ELOOP, errno.ENAMETOOLONG), "check the path"),
    **dict.fromkeys((errno.EACCES, errno.EPERM), "change its permissions"),
}


def open_input(path: Path) -> BinaryIO:
    """Open a regular file to read its bytes.

    Raises DataError, with the path, the reason and the remedy, where it is none or cannot be read.
    """
    try:
        mode = path.stat().st_mode
        what = next((kind_text for is_of_kind, kind_text in _KINDS if is_of_kind(mode)), None)
        if what is not None:
            raise DataError(f"{path}: cannot be read: {what}")
        return path.open("rb")
    except OSError as error:
        raise DataError(unreadable(path, error)) from error
    except ValueError as error:  # of a path with a null character
        raise DataError(f"{printable(str(path))}: is no path ({error}); name a file") from error


def read_input(path: Path) -> bytes:
    with open_input(path) as file:
        try:
            return file.read()
        except OSError as error:
            raise DataError(unreadable(path, error)) from error


def read_unzipped(path: Path) -> bytes:
    """Return the content of a regular file, plain or gzipped; raises DataError as :func:`open_input`, or of damage."""
    content = read_input(path)
    if not content.startswith(GZIP_MAGIC):
        return content
    try:
        return gzip.decompress(content)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"{path}: damaged or truncated gzip ({error}); copy it again") from error


def read_text_input(path: Path, kind: str) -> str:
    """Return the text of a regular file in UTF-8, plain or gzipped; ``kind`` describes it in the error.

    Raises DataError as :func:`open_input` does, or where the bytes are no such text.
    """
    try:
        return read_unzipped(path).decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a text file; {kind}") from error


def is_regular(path: Path) -> bool:
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except (OSError, ValueError):
        return False


def unreadable(path: Path, error: OSError) -> str:
    """Return the message for a file that cannot be read: the reason, and the remedy that goes with it."""
    remedy = _REMEDIES.get(error.errno or 0, "copy it again")
    return f"{path}: cannot be read ({error.strerror or error}); {remedy}"
