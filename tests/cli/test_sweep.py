"""``vislam sweep``: what it writes, that it goes on where it was stopped, and its section of the page. 3 s."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from toolkit.experiment import pipeline
from toolkit.experiment.units import Outcome, Unit, run_unit
from toolkit.progress import Progress
from toolkit.report.records import read_sweep

pytestmark = pytest.mark.usefixtures("unrendered")

Vislam = Callable[..., int]
OneLine = Callable[[], str]
LOST, SCALE = "fault:dropped_frames=0.4", "noise.motion_scale=2"
OTHERS = ("--estimators", "dead-reckoning", "--seeds", "2", "--max-frames", "10", "--workers", "1")
WORDS = ("sweep", "drive", "--over", LOST, "--over", SCALE, *OTHERS)


def found(run: str) -> dict[str, Any]:
    """Return sweep.json without times and the command."""
    document: dict[str, Any] = json.loads(Path(run, "sweep.json").read_text())
    for effect in document["effects"]:
        del effect["cpu_ms"]
    return {key: value for key, value in document.items() if key != "made"}


def test_a_sweep_that_was_stopped_goes_on_and_its_page_shows_it(
    vislam: Vislam, one_line: OneLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[object] = []

    def stopped(unit: Unit, progress: Progress) -> Outcome:
        if len(ran) == 5:
            raise KeyboardInterrupt
        ran.append((unit.seed, unit.requested.faults, unit.settings.noise.motion_scale))
        return run_unit(unit, progress)

    monkeypatch.setattr(pipeline, "run_unit", stopped)
    assert vislam(*WORDS, "--out", "run") == 130
    assert "what has ended is kept in run, and the same command with this --out goes on" in one_line()
    ran.append("the kill")
    assert vislam(*WORDS, "--quiet", "--out", "run") == 0
    assert len(ran) == len(set(ran)) == 1 + 2 * 2 * 2  # crossed: seeds, doses and scales with the clean ones
    assert vislam(*WORDS, "--quiet", "--out", "other") == 0
    assert found("run") == found("other")
    assert {"sweep.md", "figures/pareto_noise.motion_scale.pdf"} <= set(found("run")["files"])
    assert all(Path("run", name).is_file() for name in found("run")["files"])
    assert vislam("report", "run") == 0
    page = Path("run/report.html").read_text()
    assert page.count("data:image/png;base64,") == len(found("run")["figures"]) == 3
    assert "<td>fault:dropped_frames" in page
    assert vislam("diff", "run", "other") == 3
    assert "run is of a sweep or an explanation" in one_line()
    assert vislam(*WORDS, "--quiet", "--out", "run") == 0  # in the place of all of it


def test_a_file_says_what_is_swept(vislam: Vislam, capsys: pytest.CaptureFixture[str]) -> None:
    Path("sweep.toml").write_text(
        'seeds = 2\n[compare]\nsequences = ["drive"]\nestimators = ["dead-reckoning"]\nmax_frames = 10\n'
        '[sweep]\neach = true\nover = { "fault:dropped_frames" = [0.4], "noise.motion_scale" = [2] }\n'
    )
    assert vislam("sweep", "--config", "sweep.toml", "--workers", "1", "--json", "--out", "by-file") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads(Path("by-file/sweep.json").read_text())
    assert vislam(*WORDS, "--each", "--quiet", "--out", "by-words") == 0
    assert found("by-file") == found("by-words")
    assert read_sweep(Path("by-file/sweep.json")).seeds.count == 2


@pytest.mark.parametrize(
    ("words", "what"),
    [
        ((), "there is nothing to sweep over"),
        (("--over", "fault:blackout"), "expected KEY=V1,V2,... or fault:NAME=D1,D2,..., not 'fault:blackout'"),
        (("--over", "fault:blackot=1"), "blackot (did you mean blackout?)"),
        (("--over", "fault:blackout=1", "--over", "fault:blackout=2"), "give all its values at once"),
        (("--over", "window.lag_s=-1"), "window.lag_s"),
    ],
)
def test_what_cannot_be_swept_is_told_in_one_line_and_nothing_is_written(
    vislam: Vislam, one_line: OneLine, words: tuple[str, ...], what: str
) -> None:
    assert vislam("sweep", "drive", *words, *OTHERS, "--out", "run") == 2
    assert what in one_line()
    assert not Path("run").exists()


def test_no_file_of_anybody_is_lost(vislam: Vislam, one_line: OneLine) -> None:
    Path("mine").mkdir()
    Path("mine/thesis.txt").write_text("years of work")
    assert vislam(*WORDS, "--out", "mine") == 4
    assert "thesis.txt" in one_line()
    assert [path.name for path in Path("mine").iterdir()] == ["thesis.txt"]
