"""``vislam sweep``: what it writes, that it goes on where it was stopped, and its section of the page. 3 s."""

import json
from pathlib import Path
from typing import Any

import pytest

from toolkit.experiment import pipeline
from toolkit.experiment.units import Outcome, Unit, run_unit
from toolkit.progress import Progress
from toolkit.report.records import read_sweep

pytestmark = pytest.mark.usefixtures("unrendered")

LOST, SCALE = "fault:dropped_frames=0.4", "noise.motion_scale=2"
OTHERS = ("--estimators", "dead-reckoning", "--seeds", "2", "--max-frames", "10", "--workers", "1")
WORDS = ("sweep", "drive", "--over", LOST, "--over", SCALE, *OTHERS)


def found(run: str) -> dict[str, Any]:
    """Return sweep.json without times and the command."""
    document: dict[str, Any] = json.loads(Path(run, "sweep.json").read_text())
    for effect in document["effects"]:
        del effect["cpu_ms"]
    return {key: value for key, value in document.items() if key != "made"}


def test_a_sweep_that_was_stopped_goes_on_and_its_page_shows_it(vislam, one_line, monkeypatch, capsys):
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
    assert vislam(*WORDS, "--max-frames", "9", "--quiet", "--out", "run") == 0  # in the place of all of it
    assert "8 outcomes of other data, noise or repairs" in capsys.readouterr().err


def test_a_file_says_what_is_swept(vislam, capsys):
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
