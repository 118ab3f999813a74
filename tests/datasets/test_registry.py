"""Finding the reader of a recording by its content, and saying what there is where none is found."""

import errno
import io
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from toolkit.datasets import formats, load_sequence
from toolkit.errors import DataError


def test_every_format_has_a_summary() -> None:
    assert {"course-npz", "utias-mat", "openvins-sim"} <= formats().keys()
    assert all(summary.endswith(".") or len(summary) > 20 for summary in formats().values())


def test_listing_imports_neither_gtsam_nor_scipy_io() -> None:
    code = (
        "import sys; from toolkit.datasets import formats, built_in_names; formats(); built_in_names(); "
        "print([name for name in ('gtsam', 'scipy.io', 'cv2') if name in sys.modules])"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed.strip() == "[]"


def test_a_file_that_opens_and_cannot_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a failing disk; an OSError that goes on would be taken for one of the output."""

    class Failing(io.BytesIO):
        def read(self, *_: Any) -> bytes:
            raise OSError(errno.EIO, "Input/output error")

    (tmp_path / "drive").write_bytes(b"x")
    monkeypatch.setattr(Path, "open", lambda *_args, **_options: Failing())
    with pytest.raises(DataError, match=r"drive: cannot be read \(Input/output error\); copy it again"):
        load_sequence(str(tmp_path / "drive"))


def test_a_path_that_is_not_there_is_answered_with_what_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(_folder: Path) -> None:
        raise PermissionError(13, "Permission denied")

    for name in ("drive_10.npz", "drive_12.npz"):
        (tmp_path / name).touch()
    for name, answer in (
        ("drive12.npz", r"no such file or directory; did you mean drive_12\.npz\?"),
        ("utias", r"directory; .* has drive_10\.npz, drive_12\.npz"),
        ("recordings/drive.npz", r"there is no folder .*recordings"),
    ):
        with pytest.raises(DataError, match=answer):
            load_sequence(tmp_path / name)
    monkeypatch.setattr(Path, "iterdir", refused)  # of a folder that may be entered and not listed
    with pytest.raises(DataError, match=r"no such file or directory; check the path$"):
        load_sequence(tmp_path / "drive.npz")


def test_a_recording_here_is_read_in_the_place_of_a_built_in_one_and_anything_else_is_told(
    openvins: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive").mkdir()
    built_in = load_sequence("drive")
    assert (
        built_in.provenance.facts[-1] == "the built-in sequence drive is read: what is called so here is no recording"
    )
    (tmp_path / "drive").rmdir()
    shutil.copytree(openvins, tmp_path / "drive")
    here = load_sequence("drive")
    assert here.content_hash() == load_sequence(str(openvins)).content_hash()
    assert here.provenance.facts[-1].startswith("the recording here is read, and not the built-in sequence drive")
