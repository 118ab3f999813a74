"""What comes in is a regular file, or the error says what it is instead and what to do."""

import errno
import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit.datasets import load_references, load_sequence
from toolkit.datasets.io.numpy_files import opened
from toolkit.datasets.trajectories import read_poses
from toolkit.errors import DataError, VislamError
from toolkit.experiment.configuration import read_configuration
from toolkit.files.reading import read_input
from toolkit.gate.baseline import load_baseline


def _archive(path: Path) -> None:
    with opened(path) as archive:
        archive.fields()


READERS: dict[str, Callable[[Path], object]] = {
    "recording": lambda path: load_sequence(str(path)),
    "references": lambda path: load_references(str(path)),
    "trajectory": read_poses,
    "settings": read_configuration,
    "baseline": load_baseline,
    "archive": _archive,
}


@pytest.mark.parametrize("reader", READERS.values(), ids=READERS)
@pytest.mark.parametrize("kind", ["pipe", "socket", "device"])
def test_what_is_no_regular_file_is_named_and_never_waited_for(
    reader: Callable[[Path], object], kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the path of a socket must be short
    path = Path("/dev/zero") if kind == "device" else Path("in")
    if kind == "pipe":
        os.mkfifo(path)
    if kind == "socket":
        socket.socket(socket.AF_UNIX).bind(str(path))
    with pytest.raises(VislamError, match=f"it is a {kind}"):
        reader(path)


@pytest.mark.parametrize("name", ["recording.json", "imu.csv", "features.csv", "calib.json", "cam_timestamps_ns.txt"])
def test_a_pipe_inside_a_folder_is_never_waited_for(name: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(DataError):
        load_sequence(str(tmp_path))


@pytest.mark.parametrize(
    ("number", "remedy"),
    [(errno.EACCES, "change its permissions"), (errno.ENOENT, "check the path"), (errno.EIO, "copy it again")],
)
def test_the_remedy_is_that_of_the_reason(number: int, remedy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(DataError, match=f"{os.strerror(number)}.*{remedy}"):
        read_input(Path(__file__))


def test_a_header_that_asks_for_more_than_the_file_holds_takes_no_memory(tmp_path: Path) -> None:
    import zipfile

    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"
    header += b" " * (117 - len(header)) + b"\n"
    with zipfile.ZipFile(tmp_path / "huge.npz", "w") as archive:
        archive.writestr("K.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(DataError, match="K ends after 128 of 8000000000000 bytes"):
        _archive(tmp_path / "huge.npz")
