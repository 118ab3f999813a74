"""A digest tells values apart by shape, place and content; what is written replaces regular files only, and whole."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import OutputError
from toolkit.files.writing import check_writable, replaced_file, uninterrupted
from toolkit.sequence import content_digest


@pytest.mark.parametrize("digits", [None, 6])
def test_the_shape_of_an_array_counts(digits: int | None) -> None:
    """As every part of a recording does: tests/test_sequence.py."""
    assert content_digest([np.ones((1, 3))], digits) != content_digest([np.ones(3)], digits)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (0.125, 0.125 * (1.0 + 1e-15)),
        (np.array([0.0, 1.0]), np.array([-0.0, 1.0])),
        (np.array([0.0]), np.array([-0.0])),
        (np.array([np.nan, np.inf, 1.0]), np.array([np.nan, np.inf, 1.0 + 1e-12])),
    ],
    ids=["last bits", "sign of a zero", "sign of zero alone", "what is finite"],
)
def test_what_is_rounded_away_does_not_count(one: object, other: object) -> None:
    assert content_digest([one], 6) == content_digest([other], 6)
    assert content_digest([one]) != content_digest([other])


def test_of_a_link_the_file_behind_it_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "file")
    with replaced_file(tmp_path / "link") as partial:
        partial.write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file").read_text() == "new"


def test_a_place_where_no_file_can_be_is_reported_before_there_is_anything_to_write(tmp_path: Path) -> None:
    pipe, file = tmp_path / "pipe", tmp_path / "file"
    os.mkfifo(pipe)
    file.write_text("kept")
    for place, why in ((tmp_path, "is a directory"), (pipe, "a device or a pipe"), (file / "below", "is a file")):
        with pytest.raises(OutputError, match=why):
            check_writable(place, "new")
    check_writable(file, "new")
    with pytest.raises(OutputError, match="is a file of another kind, which would be lost"):
        check_writable(file, "{")
    assert file.read_text() == "kept"
    check_writable(tmp_path / "new" / "file", "new")
    assert not (tmp_path / "new").exists()


def test_a_signal_waits_until_something_is_in_its_place() -> None:
    done = False
    with pytest.raises(KeyboardInterrupt), uninterrupted():
        signal.raise_signal(signal.SIGINT)
        done = True
    assert done


@pytest.mark.parametrize(
    ("theirs", "ours", "expected"),
    [
        ("what I must not forget", "<!doctype html>", True),
        ("what I must not forget", "0.0 1 2 3", True),
        ('{"focal": 500}', "<!doctype html>", True),
        ("0.1 1 2 3", "# t x y z\n0.0 1 2 3", False),
        ("<!doctype html><p>earlier", "<!doctype html>", False),
        ("", "<!doctype html>", False),
    ],
)
def test_a_file_is_replaced_by_a_later_version_of_itself_alone(
    tmp_path: Path, theirs: str, ours: str, expected: bool
) -> None:
    target = tmp_path / "file"
    target.write_text(theirs)

    def write() -> None:
        with replaced_file(target) as partial:
            partial.write_text(ours)

    if expected:
        with pytest.raises(OutputError, match="a file of another kind, which would be lost"):
            write()
    else:
        write()
    assert target.read_text() == (theirs if expected else ours)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
