"""A comparison over seeds that was stopped: the same command goes on, and nobody's file is lost on the way."""

import json
import os
import signal
import textwrap
import time
from pathlib import Path

import pytest

from toolkit.report.records import read_manifest

# To read what is compiled takes a process longer than these runs.
QUICK = ("--max-frames", "10", "--figures", "none")
SWEEP = ("compare", "drive", "--estimators", "dead-reckoning,ekf", "--seeds", "3", *QUICK)
PROJECT = str(Path(__file__).parents[2])

pytestmark = pytest.mark.usefixtures("unrendered")


def scores(run: str) -> object:
    """Return seeds.json without the times."""
    document = json.loads(Path(run, "seeds.json").read_text())
    for one in document["runs"]:
        for key in [key for key in one["metrics"] if key.startswith(("frame_", "total_s", "cpu_s", "peak_rss"))]:
            del one["metrics"][key]
    return document


def lines(run: str) -> list[bytes]:
    file = Path(run, "outcomes.jsonl")
    return file.read_bytes().split(b"\n")[:-1] if file.exists() else []


def test_killed_in_the_middle_and_repeated_equals_uninterrupted(vislam, starts_group, tmp_path, capsys):
    words = (*SWEEP, "--workers", "1")
    # The third run lasts until it is killed, however slow the machine.
    program = textwrap.dedent(f"""
        import sys, time
        from toolkit.cli import main
        from toolkit.experiment import pipeline
        run_unit = pipeline.run_unit
        pipeline.run_unit = lambda unit, progress: run_unit(unit, progress) if unit.seed == 0 else time.sleep(600)
        sys.exit(main({[*words, "--out", "run"]!r}))
    """)
    process = starts_group(("-c", program), tmp_path, {"PYTHONPATH": PROJECT})
    while len(lines("run")) < 2 and process.poll() is None:
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    ended = lines("run")
    assert len(ended) == 2
    assert [path.name for path in Path("run").iterdir()] == ["outcomes.jsonl"]
    assert vislam("report", "run") == 3
    assert "run is of a comparison that has not ended; repeat its command" in capsys.readouterr().err
    assert vislam(*words, "--out", "run") == 0
    assert f"results: run ({len(ended)} of 6 runs were there)" in capsys.readouterr().out
    assert lines("run")[: len(ended)] == ended
    assert len(lines("run")) == 6
    assert vislam(*words, "--out", "other") == 0
    assert scores("run") == scores("other")
    assert "outcomes.jsonl" in read_manifest(Path("run/manifest.json")).files


def test_outcomes_stay_whatever_replaces_the_run_and_files_of_others_are_refused(vislam, one_line):
    assert vislam(*SWEEP, "--seeds", "2", "--workers", "1", "--out", "run", "--keep-trajectories") == 0
    kept = lines("run")
    trajectories = sorted(path.as_posix() for path in Path("run/trajectories").rglob("*.tum"))
    assert len(trajectories) == 1 + 2 * 2 * 2
    assert vislam(*SWEEP, "--seeds", "1", "--workers", "1", "--out", "run") == 0  # one seed in the place of two
    assert not Path("run/seeds.json").exists()
    assert not Path("run/trajectories/seed-0").exists()
    assert lines("run") == kept
    for path in Path("run").iterdir():  # what a kill leaves of a first run
        if path.is_file() and path.name != "outcomes.jsonl":
            path.unlink()
    Path("run/trajectories/seed-1").mkdir(parents=True)
    Path("run/trajectories/seed-1/mine.tum").write_text("years of work")
    assert vislam(*SWEEP, "--workers", "1", "--out", "run") == 4
    assert "holds other files" in one_line()
    assert Path("run/trajectories/seed-1/mine.tum").read_text() == "years of work"
