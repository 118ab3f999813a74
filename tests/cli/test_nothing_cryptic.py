"""Names of others act on nothing, sizes are checked before a run, and a misspelt name gets the nearest one."""

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit import runner
from toolkit.report.prose import in_markdown

Vislam = Callable[..., int]
OneLine = Callable[[], str]
RECORDING = Path(__file__).parents[2] / "data" / "drive_small"
HOSTILE = "a\x1b[2J\u202eb|c <img src=x> [click](http://x) $\\frac$ \udcff"


@pytest.fixture
def hostile(vislam: Vislam) -> Path:
    """Return a recording whose name and facts hold what acts on a terminal, in Markdown and in a formula."""
    del vislam  # whose directory this one stands in
    folder = Path(shutil.copytree(RECORDING, "hostile"))
    text = json.loads((folder / "recording.json").read_text())
    text["name"], text["provenance"]["facts"] = HOSTILE, [f"# {HOSTILE}\n\n---"]
    (folder / "recording.json").write_text(json.dumps(text))
    return folder


def test_names_act_neither_on_the_terminal_nor_in_the_report(
    vislam: Vislam, hostile: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ("compare", str(hostile), "--estimators", "dead-reckoning", "--max-frames", "10", "--workers", "1")
    assert vislam(*words, "--out", "run") == 0
    messages = capfd.readouterr()
    assert messages.err == ""
    assert messages.out.replace("\n", "").isprintable()
    report = Path("run/report.md").read_text(encoding="utf-8")
    assert report.replace("\n", "").isprintable()
    assert not re.search(r"(?<!\\)(<img|\[click|\|c )|^---", report, re.MULTILINE)
    assert vislam("report", "run") == 0
    assert vislam("check-data", str(hostile)) == 0
    assert capfd.readouterr().out.replace("\n", "").isprintable()


@pytest.mark.parametrize("text", ["plain words, 3.5 m", "kitti_t_percent at -0.5", "a (b) c: d; 1e-05 = 2"])
def test_plain_text_is_the_same_in_markdown(text: str) -> None:
    assert in_markdown(text) == text


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("drive", "--estimators", "ekf", "batch", "iekf"), "give names with commas: --estimators ekf,batch,iekf (see"),
        (("drive", "--max-frames", "9", "batch"), "unexpected argument batch (see"),
        (("drive", "--estimtors=ekf"), "there is no option --estimtors; did you mean --estimators? (see"),
    ],
)
def test_an_argument_that_is_left_over_is_answered_by_its_command(
    vislam: Vislam, one_line: OneLine, words: tuple[str, ...], expected: str
) -> None:
    assert vislam("compare", *words) == 2
    assert f"{expected} vislam compare --help)" in one_line()


def test_a_run_directory_given_as_a_recording_is_distinguished_from_one(vislam: Vislam, one_line: OneLine) -> None:
    Path("run").mkdir()
    for name in ("manifest.json", "metrics.json"):
        (Path("run") / name).write_text("{}")
    assert vislam("compare", "run") == 3
    assert "is a run directory and no recording: vislam report shows it, and --config run/manifest.json" in one_line()


@pytest.mark.parametrize("seconds", ["1e9", "3601", "1e-9"])
def test_a_simulation_of_no_sensible_length_is_refused_before_memory_is_requested(
    vislam: Vislam, one_line: OneLine, seconds: str
) -> None:
    assert vislam("simulate", "drive", "--out", "recording", "--duration", seconds) == 2
    assert "its duration is from 0.1 to 3600 s" in one_line()
    assert list(Path().iterdir()) == []


def test_names_too_long_are_refused_before_anything_runs(
    vislam: Vislam, one_line: OneLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "run", None)
    given = ("compare", "drive", "--estimators", "dead-reckoning", "--max-frames", "10")
    Path("est.tum").write_text("0 0 0 0 0 0 0 1\n")
    assert vislam(*given, "--trajectory", f"{'n' * 300}=est.tum") == 2
    assert "a name of 300 characters" in one_line()
    assert vislam(*given, "--out", "n" * 300) == 4
    assert "File name too long" in one_line()


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (("compare", "drive", "--estimators", "EKF"), "did you mean ekf?"),
        (("compare", "Drive"), "did you mean drive?"),
        (("compair",), "did you mean compare?"),
        (("compare", "drive", "--start", "Truth"), "did you mean truth?"),
        (("compare", "drive", "--keep", "time_gap"), "did you mean time-gap?"),
        (("compare", "drive", "--keep", "stale"), "did you mean stale-frames?"),
        (("compare", "drive", "--keep", "tim"), "did you mean time-order, time-gap or time-offset?"),
        (("compare", "drive", "--columns", "ATE SE3"), "did you mean ATE SE(3)?"),
        (("check-data", "flihgt"), "did you mean flight?"),
        (("simulate", "drive_imu", "--out", "d"), "did you mean drive-imu?"),
        (("compare", "drive", "--set", "window.lag=3"), "did you mean window.lag_s?"),
        (("compare", "drive", "--set", "estimators.ekff.gain=1"), "did you mean ekf?"),
        (("compare", "drive", "--max", "10"), "did you mean --max-frames?"),
    ],
)
def test_a_misspelt_name_gets_the_nearest_one(
    vislam: Vislam, one_line: OneLine, words: tuple[str, ...], hint: str
) -> None:
    assert vislam(*words) in (2, 3, 5)
    assert hint in one_line()


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("", "a SEQUENCE has no name: give a path, or one of"),
        ("https://example.org/03.npz", "it is an address: download it and name the file"),
    ],
)
def test_what_names_no_file_is_distinguished_from_one_that_is_missing(
    vislam: Vislam, one_line: OneLine, source: str, expected: str
) -> None:
    assert vislam("compare", source, "--estimators", "dead-reckoning") == 3
    assert expected in one_line()


@pytest.mark.parametrize("words", [("diff", "n" * 5000, "run"), ("compare", "drive", "--workers", "n" * 5000)])
def test_of_an_argument_of_thousands_of_letters_both_ends_are_reported(
    vislam: Vislam, one_line: OneLine, words: tuple[str, ...]
) -> None:
    assert vislam(*words) in (2, 3)
    assert "nnn...nnn" in (messages := one_line())
    assert len(messages) < 300


def test_a_path_in_bytes_that_are_no_text_is_read_and_reported(
    vislam: Vislam, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(RECORDING, os.fsdecode(b"caf\xe9"))
    words = ("compare", folder, "--estimators", "dead-reckoning", "--max-frames", "10", "--workers", "1")
    assert vislam(*words, "--out", os.fsdecode(b"r\xe9sultats")) == 0
    assert "results: r\\udce9sultats" in capfd.readouterr().out
    assert vislam("report", os.fsdecode(b"r\xe9sultats")) == 0


def test_a_recording_without_noise_is_named(vislam: Vislam, one_line: OneLine) -> None:
    folder = Path(shutil.copytree(RECORDING, "exact"))
    text = json.loads((folder / "recording.json").read_text())
    text["noise"]["gyro_noise_density"] = [0.0, 0.0, 0.0]
    (folder / "recording.json").write_text(json.dumps(text))
    assert vislam("compare", "exact", "--estimators", "dead-reckoning", "--out", "run") == 3
    assert "noise.gyro_noise_density is 0, expected a positive number" in one_line()
    assert not Path("run").exists()


@pytest.mark.parametrize(
    ("words", "status"),
    [(("report",), 3), (("diff", "run"), 3), (("export", "--format", "tum", "--out", "e.tum"), 3), (("cite",), 5)],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_a_name_too_long_for_the_system_is_no_run_directory(
    vislam: Vislam, one_line: OneLine, words: tuple[str, ...], status: int
) -> None:
    Path("run").mkdir()
    (Path("run") / "metrics.json").write_text("{}")
    assert vislam(words[0], "n" * 300, *words[1:]) == status
    assert (
        "is not a directory; give a run directory" in (messages := one_line()) or "or name a run directory" in messages
    )


@pytest.mark.parametrize("source", ["drive", str(RECORDING)])
def test_topics_of_what_is_no_bag_are_not_passed_over(vislam: Vislam, one_line: OneLine, source: str) -> None:
    words = ("compare", source, "--topics", "left=/cam0", "--estimators", "dead-reckoning", "--out", "run")
    assert vislam(*words) == 3
    assert "it has no topics, a bag has; leave --topics out" in one_line()
    assert not Path("run").exists()


@pytest.mark.parametrize("source", ["drive", "kitti00", str(RECORDING)])
def test_images_of_what_has_none_are_not_passed_over(vislam: Vislam, one_line: OneLine, source: str) -> None:
    words = ("compare", source, "--tracks", "images", "--estimators", "dead-reckoning", "--out", "run")
    assert vislam(*words) == 3
    assert "has tracks and no images; leave --tracks images out" in one_line()
