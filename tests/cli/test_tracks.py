"""``vislam tracks`` and folders of images on the command line: what is written, said and refused."""

import resource
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

Vislam = Callable[..., int]


@pytest.fixture
def folder(kitti_drive: Path, vislam: Vislam) -> Path:
    """Return a folder of images in this test's directory."""
    return Path(shutil.copytree(kitti_drive, "06"))


def test_stills_show_both_images_with_the_tracks(folder, vislam, capsys):
    assert vislam("tracks", "06", "--out", "stills", "--count", "3") == 0
    written = sorted(path.name for path in Path("stills").iterdir())
    assert len(written) == 3
    still = cv2.imread(str(Path("stills") / written[-1]))
    assert still.shape == (200, 640, 3)
    coloured = (still.max(axis=2).astype(int) - still.min(axis=2)) > 60
    assert coloured[:, :320].sum() > 200
    assert coloured[:, 320:].sum() > 200
    messages = capsys.readouterr().out
    assert "8 pairs" in messages
    assert "tracks a frame" in messages
    assert vislam("tracks", "06", "--out", "film", "--video") == 0
    assert cv2.VideoCapture("film/tracks.avi").get(cv2.CAP_PROP_FRAME_COUNT) == 8


def test_stills_replace_stills_and_nothing_else(folder, vislam, one_line, capsys):
    assert vislam("tracks", str(folder), "--out", "stills", "--count", "2") == 0
    (folder / "image_1/000004.png").write_bytes(b"")
    assert vislam("tracks", str(folder), "--out", "stills", "--count", "2") == 0
    assert "left out: 06/image_1/000004.png (it is empty)" in capsys.readouterr().out
    Path("stills/mine.txt").write_text("mine")
    assert vislam("tracks", str(folder), "--out", "stills", "--count", "2") == 4
    assert "mine.txt" in one_line()
    assert Path("stills/mine.txt").read_text() == "mine"


@pytest.mark.parametrize("words", [("--count", "2"), ("--video",)])
def test_pictures_on_a_full_disk_are_4_and_none_is_left(folder, vislam, capfd, words):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))
    try:
        assert vislam("tracks", str(folder), "--out", "stills", *words) == 4
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "stills cannot be written" in capfd.readouterr().err
    assert not Path("stills").exists()


@pytest.mark.usefixtures("one_process", "unrendered")
def test_images_alone_are_compared_and_labelled(folder, vislam, capsys):
    assert vislam("compare", str(folder), "--estimators", "ekf,batch", "--out", "run") == 0
    table = capsys.readouterr().out
    assert "no motion measured (smooth motion assumed)" in table
    assert "no motion input" in Path("run/report.md").read_text()
    assert vislam("compare", "--config", "run/manifest.json", "--out", "again") == 0
    assert vislam("compare", str(folder), "--tracks", "simulated") == 3
    assert "EuRoC folders only" in capsys.readouterr().err
