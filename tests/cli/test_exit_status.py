"""Every kind of trouble has its exit status and one line on stderr, and leaves nothing half-written."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from toolkit import runner

Vislam = Callable[..., int]
OneLine = Callable[[], str]
QUICK = ("compare", "drive", "--estimators", "dead-reckoning", "--max-frames", "10", "--workers", "1")


@pytest.mark.parametrize(
    "words",
    [
        (),
        ("compair",),
        ("compare", "--max-frames", "1"),
        ("compare", "--max-frames", "many"),
        ("compare", "--seed", "-1"),
        ("compare", "--estimators", ","),
        ("compare", "drive", "flight", "--truth", "gt.tum"),
        ("compare", "drive", "--keep", "no-such-fault"),
        ("compare", "drive", "--no-repair", "--keep", "time-gap"),
        ("check-data",),
        ("simulate", "drive"),
        ("simulate", "drive", "--out", "d", "--duration", "0"),
    ],
)
def test_a_wrong_command_line_is_2(vislam: Vislam, one_line: OneLine, words: tuple[str, ...]) -> None:
    assert vislam(*words) == 2
    one_line()


def test_a_run_that_is_marked_overconfident_ends_with_0(vislam: Vislam, capsys: pytest.CaptureFixture[str]) -> None:
    assert vislam("compare", "drive", "--estimators", "ekf", "--max-frames", "60", "--workers", "1") == 0
    assert "ekf is overconfident" in capsys.readouterr().out


def test_a_recording_that_is_not_there_is_3(vislam: Vislam, one_line: OneLine) -> None:
    assert vislam("compare", "no/such/recording.npz", "--estimators", "dead-reckoning") == 3
    assert "no/such/recording.npz" in one_line()


def test_a_truth_that_is_not_there_is_3(vislam: Vislam, one_line: OneLine) -> None:
    assert vislam(*QUICK, "--truth", "missing.tum") == 3
    assert "missing.tum" in one_line()


@pytest.mark.parametrize("out", ["taken", "taken/run"])
def test_an_output_that_cannot_be_written_is_4_before_anything_runs(
    vislam: Vislam, one_line: OneLine, monkeypatch: pytest.MonkeyPatch, out: str
) -> None:
    Path("taken").write_text("a file")
    monkeypatch.setattr(runner, "run", _never)
    assert vislam(*QUICK, "--out", out) == 4
    assert out in one_line()


def test_an_unknown_estimator_is_5_before_anything_runs(
    vislam: Vislam, one_line: OneLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "run", _never)
    assert vislam("compare", "drive", "--estimators", "dead-reckoning,oracle") == 5
    assert "oracle" in one_line()


def test_a_diverged_estimator_is_1_and_its_results_are_written(
    vislam: Vislam, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = runner.run
    monkeypatch.setattr(runner, "run", lambda *given: replace(real(*given), status="diverged"))
    assert vislam(*QUICK, "--out", "run") == 1
    assert '"status": "diverged"' in Path("run/metrics.json").read_text()
    assert "dead-reckoning diverged" in capsys.readouterr().out


def test_an_interrupt_is_130_and_leaves_nothing(
    vislam: Vislam, one_line: OneLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "run", interrupted)
    assert vislam(*QUICK, "--out", "run") == 130
    assert "interrupted" in one_line()
    assert list(Path().iterdir()) == []


def test_a_reader_that_goes_away_is_no_trouble() -> None:
    """As in ``vislam list | head -0``, with the pipe already closed at the other end."""
    read_end, write_end = os.pipe()
    os.close(read_end)
    with os.fdopen(write_end, "w") as closed_pipe:
        told = subprocess.run(
            [sys.executable, "-m", "toolkit.cli", "list"],
            stdout=closed_pipe,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            timeout=60,
        )
    assert told.stderr == ""
    assert told.returncode == 141


def test_nothing_but_results_is_written_when_all_is_well(vislam: Vislam, capsys: pytest.CaptureFixture[str]) -> None:
    assert vislam(*QUICK, "--out", "run") == 0
    told = capsys.readouterr()
    assert told.err == ""
    assert "results: run\n" in told.out
    assert [path.name for path in Path().iterdir()] == ["run"]


def _never(*_: object) -> None:
    raise AssertionError("an estimator ran")
