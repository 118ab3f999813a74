"""``vislam compare --seeds`` and the ladder: their results, and one line for what cannot be repeated."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit import registry
from toolkit.cli import progress_display
from toolkit.report.records import read_seeds

Vislam = Callable[..., int]
OneLine = Callable[[], str]
QUICK = ("--estimators", "dead-reckoning", "--max-frames", "10")


def test_a_run_directory_over_seeds(
    vislam: Vislam, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress_display, "LOG_EVERY_S", float("inf"))  # work that is soon done leaves no line
    assert vislam("compare", "drive", *QUICK, "--seeds", "3", "--seed", "1", "--workers", "1", "--out", "run") == 0
    messages = capsys.readouterr()
    assert messages.err == ""
    assert "results: run;" in messages.out
    document = read_seeds(Path("run/seeds.json"))
    assert document.seeds == (1, 2, 3)
    assert len(set(document.hashes)) == 3
    manifest = json.loads(Path("run/manifest.json").read_text())
    assert manifest["seeds"] == {"sequence": 1, "count": 3}
    assert manifest["sequence"]["hash"] == document.hashes[0]
    figures = sorted(path.name for path in Path("run/figures").iterdir())
    assert figures == ["errors_over_seeds.png", "nees_over_seeds.png"]
    assert all(name in Path("run/report.md").read_text() for name in figures)


@pytest.mark.usefixtures("unrendered")
def test_several_sequences_get_a_directory_each_and_replace_what_was_there(vislam: Vislam) -> None:
    for _ in range(2):
        assert vislam("compare", "drive", "drive-imu", *QUICK, "--seeds", "2", "--workers", "1", "--out", "all") == 0
    assert sorted(path.name for path in Path("all").iterdir()) == ["drive", "drive-imu"]


RECORDING = str(Path(__file__).parents[2] / "data" / "drive_small")


@pytest.mark.parametrize(
    ("words", "status", "why"),
    [
        (("kitti00", "--seeds", "2"), 3, "kitti00 is the same under every seed"),
        ((RECORDING, "--seeds", "2"), 3, "drive_small is the same under every seed"),
        (("drive", "--seeds", "0"), 2, "at least 1"),
        (("drive", "--seeds", "2", "--truth", "gt.tum"), 2, "exclude each other"),
        (("drive", "--workers", "0"), 2, "at least 1"),
        (("drive", "--workers", "2", "--scheduler", "tcp://host:8786"), 2, "exclude each other"),
    ],
)
def test_what_cannot_be_repeated_is_reported_before_anything_runs(
    vislam: Vislam, one_line: OneLine, words: tuple[str, ...], status: int, why: str
) -> None:
    if words[0] == "drive" and "--truth" in words:
        Path("gt.tum").write_text("")
    assert vislam("compare", *words, *QUICK) == status
    assert why in one_line()
    assert not Path("runs").exists()


def test_a_cluster_needs_a_package_that_is_named(
    vislam: Vislam, one_line: OneLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert vislam("compare", "drive", *QUICK, "--scheduler", "tcp://host:8786") == 71
    assert "a cluster needs the package distributed: pip install 'vislam-toolkit[cluster]'" in one_line()


@pytest.mark.usefixtures("unrendered")
def test_the_table_has_the_change_of_each_rung_once(
    vislam: Vislam, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lowest = registry.ladder()[:2]
    monkeypatch.setattr(registry, "ladder", lambda: lowest)
    words = ("--estimators", "ladder", "--max-frames", "10", "--workers", "1", "--out", "run")
    assert vislam("compare", "drive", *words) == 0
    table = capsys.readouterr().out.partition("notes:")[0]
    for entry in lowest:
        assert table.count(entry.change()) == 1
    report = Path("run/report.md").read_text()
    for entry in lowest:
        assert re.search(rf"^- {entry.name} +{re.escape(entry.change())}$", report, flags=re.MULTILINE)
