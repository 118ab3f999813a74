"""Writing at once or not at all, and a file that grows by whole lines.

A directory or a file appears complete or not at all: it is written beside its place and then renamed into it.
"""

import errno
import fcntl
import os
import re
import shutil
import signal
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from toolkit.errors import OutputError

# Returns the entries of a directory that the toolkit wrote and may replace: relative paths, folders with a slash.
Owner = Callable[[Path], Collection[str]]
# Signals that ask a program to end; while a result is moved to its place they are held back.
ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# First characters of a table of numbers: a comment, a sign, a digit.
_OF_TABLES = tuple(c.encode() for c in "#+-.0123456789")


def check_replaceable(target: Path, owner: Owner) -> None:
    """Raise OutputError unless ``target`` can be created, or is a directory that holds nothing but files of ours."""
    try:
        if Path.cwd().is_relative_to(os.path.realpath(target)):
            raise OutputError(f"{target} is or holds the current directory and cannot be replaced; name one inside it")
        if target.is_symlink() or (target.exists() and not target.is_dir()):
            raise OutputError(f"{target} exists and is not a directory; choose another place for the results")
        if target.is_dir():
            _check_ours(target, owner, target)
        _probe(target)
    except OSError as error:
        raise _unwritable(target, error) from error


def with_folders(files: Iterable[str]) -> frozenset[str]:
    """Return relative paths of files with the folders they are in, which have a slash behind, as an owner does."""
    paths = list(files)
    folders = {f"{part.as_posix()}/" for path in paths for part in PurePosixPath(path).parents}
    return frozenset({*paths, *folders} - {"./"})


def check_parent(directory: Path) -> None:
    """Raise OutputError unless directories can be made in ``directory``, or it can itself be made first."""
    try:
        _probe(directory / "probe")
    except OSError as error:
        raise _unwritable(directory, error) from error


def _check_ours(directory: Path, owner: Owner, named: Path) -> None:
    """Raise OutputError, which calls the directory ``named``, for the first entry that the toolkit did not write."""
    ours = owner(directory)
    for entry in sorted(directory.rglob("*")):
        name = entry.relative_to(directory).as_posix()
        is_folder = entry.is_dir() and not entry.is_symlink()
        if entry.is_symlink() or (f"{name}/" if is_folder else name) not in ours:
            raise OutputError(
                f"{named} holds other files, as {name}, which no earlier run wrote and which would be lost; "
                "choose another directory with --out"
            )


def _probe(target: Path) -> None:
    """Test that a result can be written: create and remove entries as deep and with names as long as it needs."""
    with _parents_of(target) as clear_away:
        partial = _beside(target, "probe")
        partial.mkdir()
        partial.rmdir()
        if not target.exists():
            target.mkdir()
            target.rmdir()
        clear_away()


@contextmanager
def _parents_of(target: Path) -> Iterator[Callable[[], None]]:
    """Make the directories above a place; yield what removes those of them that hold nothing, as a failure does."""
    missing = [parent for parent in target.absolute().parents if not parent.exists()]

    def clear_away() -> None:
        with suppress(OSError):
            for directory in missing:
                directory.rmdir()

    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield clear_away
    except BaseException:
        clear_away()
        raise


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold back signals that end the program until the block is left, so that no rename is interrupted."""
    requested: list[int] = []
    try:
        before = {number: signal.getsignal(number) for number in ENDING}
        for number in before:
            signal.signal(number, lambda got, _frame: requested.append(got))
    except ValueError:  # only the main thread may set signal handlers
        yield
        return
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        if requested:
            signal.raise_signal(requested[0])


@contextmanager
def replaced_directory(target: Path, owner: Owner) -> Iterator[Path]:
    """Give an empty directory to write to; on success it takes ``target``'s place, on any failure it is removed.

    Raises OutputError where the place is taken by something else or cannot be written.
    """
    check_replaceable(target, owner)
    partial = _beside(target, "partial")
    try:
        with _parents_of(target):
            try:
                partial.mkdir()
                yield partial
                with uninterrupted():
                    _swap(partial, target, owner)
            finally:
                with uninterrupted():
                    shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise _unwritable(target, error) from error


@contextmanager
def replaced_file(target: Path) -> Iterator[Path]:
    """Give a file to write to; on success it takes ``target``'s place, on any failure it is removed.

    Of a link the file it points to is replaced. Raises OutputError where the place is taken by a directory, a device,
    a pipe or a file of another kind than is written, or cannot be written.
    """
    place = Path(os.path.realpath(target))
    partial = _beside(place, "partial")
    try:
        check_file(target)
        with _parents_of(place):
            try:
                yield partial
                _check_kind(target, place, _beginning(partial))
                partial.replace(place)
            finally:
                with suppress(OSError):
                    partial.unlink(missing_ok=True)
    except OSError as error:
        raise _unwritable(target, error, "file") from error


def write_text(target: Path, text: str) -> None:
    """Write a file in UTF-8 at once or not at all, in the place of an earlier one; raises as :func:`replaced_file`."""
    with replaced_file(target) as partial:
        partial.write_text(text, encoding="utf-8")


def check_writable(target: Path, beginning: str) -> None:
    """Raise OutputError unless a file that begins with a text can be written at a place; what is there stays.

    It is asked before the work whose result is to be written there, so that nothing is refused after it.
    """
    check_file(target)
    try:
        _probe(target.parent / "probe")
        _check_kind(target, Path(os.path.realpath(target)), beginning.encode())
    except OSError as error:
        raise _unwritable(target, error, "file") from error


def check_file(target: Path) -> None:
    """Raise OutputError where something that is no regular file stands at a place."""
    if target.is_dir():
        raise OutputError(f"{target} is a directory; name a file in it")
    if target.exists() and not target.is_file():
        raise OutputError(f"{target} is a device or a pipe, and files are written whole; name a regular file")


def _check_kind(target: Path, place: Path, beginning: bytes) -> None:
    """Raise OutputError where a file stands at a place that what begins so is no later version of."""
    there = _kind(_beginning(place)) if place.exists() else ""
    if there and there != _kind(beginning):
        raise OutputError(f"{target} is a file of another kind, which would be lost; name another file")


def _beginning(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(64)


def _kind(beginning: bytes) -> str:
    """Tell pages, JSON, archives, tables of numbers and other files apart by how they begin; empty ones are none."""
    text = beginning.lstrip()
    kinds = {b"<": "page", b"{": "JSON", b"PK": "archive", **dict.fromkeys(_OF_TABLES, "table")}
    known = (kind for begins, kind in kinds.items() if text.startswith(begins))
    return next(known, "other" if text else "")


class LineFile:
    """A text file that grows by whole lines; one process at a time adds to it.

    A process that is killed while it writes leaves at most one line without its end, which is cut off when the file is
    opened again. Raises OutputError where it cannot be written, or another process has it open.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        except OSError as error:
            raise _unwritable(path, error, "place") from error
        try:
            self._lock()
            self._cut_off(path.read_bytes().rfind(b"\n") + 1)
        except BaseException:
            self.close()
            raise

    def append(self, line: bytes) -> None:
        """Write a line, which holds no end of line itself, and hand it to the system; a line in part is cut off."""
        length = os.fstat(self._fd).st_size
        rest = memoryview(line + b"\n")
        try:
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError as error:
            self._cut_off(length)
            raise _unwritable(self._path, error, "place") from error

    def close(self) -> None:
        os.close(self._fd)

    def _lock(self) -> None:
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                return  # a file system without locks
            raise OutputError(
                f"{self._path} is being written by another run; wait for its end, or choose another place with --out"
            ) from error

    def _cut_off(self, length: int) -> None:
        if os.fstat(self._fd).st_size > length:
            os.ftruncate(self._fd, length)


def whole_lines(content: bytes) -> list[bytes]:
    return content.split(b"\n")[:-1]


def _swap(new: Path, target: Path, owner: Owner) -> None:
    """Rename ``new`` to ``target``; the old content is restored if that fails, or if others have added files to it."""
    old = _beside(target, "replaced")
    try:
        if target.exists():
            target.rename(old)
            _check_ours(old, owner, target)
        new.rename(target)
    finally:
        if old.exists() and not target.exists():
            old.rename(target)
        shutil.rmtree(old, ignore_errors=True)


def _beside(target: Path, kind: str) -> Path:
    """Return a temporary path beside ``target``, whose name may have the greatest length already."""
    return target.parent / f".vislam.{kind}-{os.getpid()}"


def _unwritable(target: Path, error: OSError, kind: str = "directory") -> OutputError:
    in_the_way = next((parent for parent in target.parents if os.path.isfile(parent)), None)  # noqa: PTH113
    why = f"{in_the_way} is a file" if in_the_way else error.strerror or error
    return OutputError(f"{target} cannot be written ({why}); choose another {kind} with --out")


def plain_name(name: str) -> str:
    """Return a name that is fit for a file, without blanks, brackets and the like; it may be empty."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._")
