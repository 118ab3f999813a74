"""``vislam check --speed-against``: old and new code in turn, and what of their times is told."""

import subprocess
import zipfile
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from toolkit.cli import main
from toolkit.gate import interleaved
from toolkit.gate.baseline import Baseline, BaselineError, Case, Measured, SeriesRecord, installed_releases, to_text
from toolkit.gate.interleaved import (
    FEWEST_PAIRS,
    MARGIN,
    MOST_PAIRS,
    TimedPairs,
    check_speeds,
    compare_speed,
    pairs_needed,
    timers,
    unpacked,
)
from toolkit.gate.measuring import recordings_of
from toolkit.gate.timing_child import Timer
from toolkit.progress import silent
from toolkit.settings import changes_of
from toolkit.settings.reading import settings_of

PROJECT = Path(__file__).parents[2]
# Times of single runs on a machine that others use, too: a few percent, and now and then much more.
SPREAD, INTERRUPTED, SLOWED = 0.04, 0.1, 0.5


def timed(ratio: float, rng: np.random.Generator, count: int = 0) -> TimedPairs:
    """Return pairs of an estimator that takes ``ratio`` times as long as it did; so many, or as many as are needed."""
    noise = np.exp(SPREAD * rng.standard_normal((MOST_PAIRS, 2)))
    noise *= np.where(rng.random(noise.shape) < INTERRUPTED, 1.0 + SLOWED * rng.random(noise.shape), 1.0)
    every = TimedPairs("drive", "ekf", 0.1 * noise * np.array([1.0, ratio]))
    count = count or pairs_needed(every.differences[:FEWEST_PAIRS])
    return TimedPairs("drive", "ekf", every.cpu_s[:count])


def findings(ratio: float, checks: int, seed: int) -> list[list[str]]:
    """Return what is found of eight estimators in each of some checks, the first of them slower."""
    rng = np.random.default_rng(seed)
    return [
        [v.finding for v in check_speeds([timed(ratio if i == 0 else 1.0, rng) for i in range(8)], "v1", 0.05)]
        for _ in range(checks)
    ]


@pytest.mark.parametrize(("ratio", "least", "most"), [(1.0, 0.0, 0.05), (1.0 + MARGIN, 0.0, 0.05), (1.2, 0.95, 1.0)])
def test_what_is_slower_by_a_fifth_is_seen_and_by_a_twentieth_is_not(ratio, least, most):
    checks = 40
    failed = sum(one[0] == "regressed" for one in findings(ratio, checks, 1))
    assert least * checks <= failed <= most * checks


def test_the_more_the_times_scatter_the_more_pairs_are_run():
    rng = np.random.default_rng(6)
    counts = [pairs_needed(spread * rng.standard_normal(40)) for spread in (0.001, 0.05, 0.1, 1.0)]
    assert counts[0] == FEWEST_PAIRS
    assert counts[-1] == MOST_PAIRS
    assert counts == sorted(counts)


def wheel_of_this_code(path: Path, *, runner: str = "") -> None:
    """Write a wheel of the code under test, with some lines more at the end of its runner."""
    with zipfile.ZipFile(path, "w") as wheel:
        for file in sorted((*(PROJECT / "toolkit").rglob("*.py"), *(PROJECT / "filters").rglob("*.py"))):
            name = file.relative_to(PROJECT).as_posix()
            wheel.writestr(name, file.read_text() + (runner if name == "toolkit/runner.py" else ""))


# Three quarters of the processor time go nowhere.
SLOWLY = """
_fast = _run
def _run(*given):
    done = _fast(*given)
    _until = time.process_time() + 3.0 * done.timings.cpu_s
    while time.process_time() < _until:
        pass
    return replace(done, timings=replace(done.timings, cpu_s=4.0 * done.timings.cpu_s))
"""


def baseline_of_a_drive(estimator: str = "dead-reckoning") -> Baseline:
    """Return a baseline that was not measured: what is timed needs to know the cases alone."""
    case = Case("drive", True, (0,), (estimator,), 1.0)
    series = SeriesRecord(status=("ok",), speed=(1.0,), causal={})
    return Baseline(installed_releases(), ((case, Measured(("hash",), ("print",), {estimator: series})),))


def test_old_and_new_code_take_turns_and_each_runs_its_own(tmp_path, monkeypatch):
    monkeypatch.setattr(interleaved, "FEWEST_PAIRS", 6)  # all of one sign are one in 64 by chance
    monkeypatch.setattr(interleaved, "MOST_PAIRS", 8)
    wheel = tmp_path / "slow-1.0-py3-none-any.whl"
    wheel_of_this_code(wheel, runner=SLOWLY)
    (speed,), notes = compare_speed(baseline_of_a_drive(), str(wheel), 0.05, silent)
    assert (speed.estimator, speed.metric, speed.finding) == ("dead-reckoning", "speed", "better")
    assert -85.0 < speed.change_percent < -60.0
    assert "processor time of" in speed.words
    assert notes == []


class Side:
    """A version of the code that has some estimators, of which some end well."""

    def __init__(self, version, there, ok):
        self.version, self.there, self.ok = version, there, ok

    def request(self, do, **requested):
        if do == "where":
            there = {name: "file" if name in self.there else None for name in requested["estimators"]}
            return {"toolkit": self.version, "files": there}
        if do == "run":
            return {"status": "ok" if requested["estimator"] in self.ok else "failed", "cpu_s": 0.1}
        return {}


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ((["ekf"], ["ekf"]), (["ekf"], ["ekf"]), "same"),
        ((["ekf"], ["ekf"]), (["ekf"], []), "missing"),
        ((["ekf"], ["ekf"]), ([], []), "missing"),
        ((["ekf"], []), (["ekf"], []), "noted"),
        (([], []), (["ekf"], ["ekf"]), "noted"),
    ],
)
def test_what_the_other_code_can_be_timed_on_and_this_one_cannot_is_missing(monkeypatch, old, new, found):
    monkeypatch.setattr(interleaved, "unpacked", lambda _: nullcontext(()))
    monkeypatch.setattr(interleaved, "timers", lambda *_: nullcontext((Side("old", *old), Side("new", *new))))
    verdicts, notes = compare_speed(baseline_of_a_drive("ekf"), "v1", 0.05, silent)
    assert [verdict.finding for verdict in verdicts] == ([] if found == "noted" else [found])
    assert bool(notes) is (found == "noted")


def test_what_is_timed_is_read_as_what_is_measured(monkeypatch):
    read = []
    monkeypatch.setattr("toolkit.experiment.recording.prepare", read.append)
    changed = {
        "noise": {"motion_scale": 2.0},
        "frontend": {"max_tracks": 50},
        "tracks": {"budget": 20},
        "start": "truth",
    }
    settings = settings_of(changed, "here")
    (measured,) = recordings_of(Case("drive", True, (3,), ("ekf",), 1.0), settings)
    requested = {"source": "drive", "seed": 3, "truth": None, "duration_s": 1.0, "settings": changes_of(settings)}
    Timer().prepare(requested)
    assert read == [measured]


def test_a_revision_is_unpacked_as_it_was(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    git = ("git", "-c", "user.name=nobody", "-c", "user.email=nobody@nowhere.invalid")
    Path("estimator.py").write_text("old")
    for words in (("init", "-q"), ("add", "-A"), ("commit", "-q", "-m", "old")):
        subprocess.run([*git, *words], check=True)
    Path("estimator.py").write_text("new")
    Path("deeper").mkdir()
    monkeypatch.chdir("deeper")
    with unpacked("HEAD") as (folder,):
        assert (folder / "estimator.py").read_text() == "old"
    assert not folder.exists()


@pytest.mark.parametrize(
    ("version", "expected"),
    [
        ("v9", "--speed-against 'v9' is no revision of this checkout; name one that git log shows, or name a wheel"),
        ("--help", "'--help' is no revision of this checkout"),
        ("", "'' is no revision of this checkout"),
        ("no.whl", "no.whl: it is no wheel that can be read (No such file or directory); build one"),
        ("empty.whl", "empty.whl does not contain the code that runs here"),
    ],
)
def test_a_version_that_cannot_be_had_is_reported(tmp_path, monkeypatch, capsys, version, expected):
    monkeypatch.chdir(tmp_path)
    subprocess.run(["git", "init", "-q"], check=True)
    zipfile.ZipFile("empty.whl", "w").close()
    Path("base.json").write_text(to_text(baseline_of_a_drive()))
    assert main(["check", "--baseline", "base.json", f"--speed-against={version}"]) == 3
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert expected in printed


def test_outside_of_a_checkout_and_without_git_a_wheel_is_requested(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    with pytest.raises(
        BaselineError,
        match=r"HEAD: the current directory is not in a checkout; change to one, or name a wheel \(fatal: not a git",
    ):
        unpacked("HEAD").__enter__()
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BaselineError, match=r"git cannot be run \(No such file or directory\); name a wheel"):
        unpacked("HEAD").__enter__()


def test_a_version_that_cannot_run_is_reported(tmp_path):
    (tmp_path / "toolkit").mkdir()
    (tmp_path / "toolkit" / "__init__.py").write_text("raise ValueError('of another time')")
    with timers((tmp_path,), ()) as (old, _), pytest.raises(BaselineError, match=r"timed: ValueError: of another time"):
        old.request("where", estimators=[])
