"""A check that has less to look at than its baseline fails: whatever is removed, emptied, cut short or renamed."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import UNSET, structs

from tests.gate.conftest import as_another_trajectory, as_measured, checked, edited
from toolkit.cli import main
from toolkit.datasets import load_sequence
from toolkit.datasets.trajectories import tum
from toolkit.estimate import Trajectory
from toolkit.experiment.units import Outcome
from toolkit.gate.baseline import Measured, SeriesRecord
from toolkit.gate.checking import CheckTerms, check_case
from toolkit.gate.measuring import TimedOutcome, gathered
from toolkit.geometry import se3_exp

PROJECT = Path(__file__).parents[2]
# Ways to damage a file: what is left of its lines, None where nothing is left of the file itself.
DAMAGES = {
    "removed": lambda _lines: None,
    "emptied": lambda _lines: [],
    "cut in half": lambda lines: lines[: len(lines) // 2],
    "cut in a row": lambda lines: [*lines[: 2 * len(lines) // 3], lines[-1][: len(lines[-1]) // 2]],
}


def damaged(folders: tuple[str, ...]) -> Iterator[str]:
    """Damage each file below some folders in each way, one at a time; yield which it is, then restore it."""
    for path in sorted(path for folder in folders for path in Path(folder).rglob("*") if path.is_file()):
        content = path.read_bytes()
        for how, damage in DAMAGES.items():
            lines = damage(content.splitlines(keepends=True))
            path.unlink() if lines is None else path.write_bytes(b"".join(lines))
            yield f"{path} {how}"
            path.write_bytes(content)
        other = path.rename(path.with_name(f"other{path.suffix}"))
        yield f"{path} renamed"
        other.rename(path)


@pytest.fixture
def trajectories(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run of one sequence and three of another, with their truths, and the baseline of all."""
    monkeypatch.chdir(tmp_path)
    truth, rng = load_sequence("drive").truth, np.random.default_rng(0)
    for name in ("truth/lap", "truth/maze", "results/lap", *(f"results/maze/{run}" for run in range(3))):
        errors = rng.normal(0.0, [0.001] * 3 + [0.05] * 3, (len(truth.t_ns), 6)) * name.startswith("results")
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(f"{name}.tum").write_text(tum.text(Trajectory(truth.t_ns, truth.T_world_imu @ se3_exp(errors))))


@pytest.mark.usefixtures("trajectories")
def test_no_trajectory_and_no_truth_can_be_missing_or_spoilt(capsys):
    check = ["check", "--trajectories", "results", "--baseline", "base.json"]
    assert main(["baseline", "--trajectories", "results", "--truth", "truth", "--out", "base.json"]) == 0
    assert main(check) == 0
    statuses = {what: main(check) for what in damaged(("results", "truth"))}
    assert len(statuses) == 6 * (len(DAMAGES) + 1)
    assert [what for what, status in statuses.items() if status not in (1, 3)] == []
    assert "Traceback" not in capsys.readouterr().err
    Path("results/maze/1.tum").unlink()
    assert main(check) == 1
    printed = " ".join(capsys.readouterr().out.split())
    assert "maze: run is missing: 1.tum" in printed
    assert "2 of the baseline's 3 runs are left, too few to test" in printed


@pytest.mark.usefixtures("trajectories")
def test_no_run_and_no_score_of_an_evaluation_can_be_missing():
    assert main(["evaluate", "truth", "mine=results", "--out", "scored", "--quiet"]) == 0
    text = Path("scored/evaluation.json").read_text()
    assert main(["baseline", "--trajectories", "scored/evaluation.json", "--out", "base.json"]) == 0
    scored = json.loads(Path("base.json").read_text())["sequences"][0]["scores"]
    keys = [key for key, values in scored.items() if None not in values]
    assert "time_coverage_percent" in keys
    changes = {
        f"{key} null": lambda run, k=key: (run["metrics"].update({k: None}), run["notes"].update({k: "lost"}))
        for key in keys
    }
    changes |= {f"{key} removed": lambda run, k=key: (run["metrics"].pop(k), run["notes"].pop(k, "")) for key in keys}
    changes["run renamed"] = lambda run: run.update(file="results/other.tum")
    changes["system renamed"] = lambda run: run.update(estimator="other")
    changes["run failed"] = lambda run: run.update(status="failed", log=["crashed"])
    passed = []
    for what, change in changes.items():
        for run in range(len(json.loads(text)["runs"])):
            document = json.loads(text)
            change(document["runs"][run])
            Path("changed.json").write_text(json.dumps(document))
            if main(["check", "--trajectories", "changed.json", "--baseline", "base.json"]) not in (1, 3):
                passed.append((run, what))
    assert passed == []


def test_no_file_of_a_recording_can_be_missing_or_spoilt(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(PROJECT / "data/drive_small", "recording")
    words = ["--estimators", "dead-reckoning", "--workers", "1", "--duration", "3"]
    assert main(["baseline", "recording", *words, "--out", "base.json"]) == 0
    check = ["check", "--baseline", "base.json", "--workers", "1"]
    assert main(check) == 0
    statuses = {what: main(check) for what in damaged(("recording",))}
    assert len(statuses) == 2 * (len(DAMAGES) + 1)
    assert [what for what, status in statuses.items() if status != 1] == []
    assert "Traceback" not in capsys.readouterr().err


def losses(measured: Measured) -> Iterator[tuple[str, Measured]]:
    """Yield what is measured without one thing: an estimator, a seed, a run, an output, a metric, a value or a time."""
    yield "sequence", replace(measured, unreadable="no such file")
    for name, one in measured.runs.items():
        others = {other: series for other, series in measured.runs.items() if other != name}
        yield f"{name} removed", replace(measured, runs=others)
        yield f"{name} renamed", replace(measured, runs=others | {"other": one})
        for what, series in losses_of_a_series(one):
            yield f"{name} {what}", replace(measured, runs=others | {name: series})
    fingerprints = measured.fingerprints
    for seed in range(len(fingerprints)):
        yield f"seed {seed} removed", replace(measured, fingerprints=fingerprints[:seed] + fingerprints[seed + 1 :])
        other = (*fingerprints[:seed], "other", *fingerprints[seed + 1 :])
        yield f"seed {seed} of other data", replace(measured, fingerprints=other, hashes=other)


def losses_of_a_series(one: SeriesRecord) -> Iterator[tuple[str, SeriesRecord]]:
    last = len(one.status) - 1
    yield "without its last seed", structs.replace(one, status=one.status[:last], speed=one.speed[:last])
    for i in range(last + 1):
        yield f"failed under {i}", structs.replace(one, status=(*one.status[:i], "failed", *one.status[i + 1 :]))
        if last:
            yield f"without time under {i}", structs.replace(one, speed=(*one.speed[:i], None, *one.speed[i + 1 :]))
    for output, metrics in one.outputs.items():
        yield f"{output} renamed", structs.replace(one, causal=UNSET, final=metrics)
        yield f"{output} empty", structs.replace(one, **{output: {}})
        for key, values in metrics.items():
            left = {other: of_it for other, of_it in metrics.items() if other != key}
            yield f"{key} removed", structs.replace(one, **{output: left})
            yield f"{key} short", structs.replace(one, **{output: left | {key: values[:last]}})
            for i in range(last + 1):
                lacking = left | {key: (*values[:i], None, *values[i + 1 :])}
                yield f"{key} without {i}", structs.replace(one, **{output: lacking})


def test_nothing_that_was_measured_can_be_missing(baseline):
    passed, count = [], 0
    for i, (case, before) in enumerate(baseline.cases):
        for what, now in losses(before):
            measured = as_measured(baseline)
            measured[i] = now
            count += 1
            passed += [f"{case.source}: {what}"] if checked(baseline, measured).passed else []
    assert count > 500
    assert passed == []


def test_a_unit_that_gives_no_result_is_a_run_that_failed(baseline):
    case, _ = baseline.cases[0]
    found = [TimedOutcome(Outcome(seed, name, "ok")) for seed in case.seeds for name in case.estimators]
    before = gathered(case, found, (), {})
    for place in range(len(found)):
        now = gathered(case, [*found[:place], *found[place + 1 :]], (), {})
        (verdict,) = check_case(case, before, now, baseline.bounds, CheckTerms(speed=False)).verdicts
        assert (verdict.finding, verdict.metric) == ("regressed", "status")


def test_a_single_seed_is_held_to_the_margins_because_no_test_can_fail(baseline):
    case, before = baseline.cases[0]

    def first(one: SeriesRecord) -> SeriesRecord:
        outputs = {o: {k: values[:1] for k, values in metrics.items()} for o, metrics in one.outputs.items()}
        return structs.replace(one, status=one.status[:1], speed=one.speed[:1], **outputs)

    runs = {name: first(one) for name, one in before.runs.items()}
    one_seed = replace(before, hashes=before.hashes[:1], fingerprints=before.fingerprints[:1], runs=runs)
    single = replace(baseline, cases=((replace(case, seeds=(0,)), one_seed), baseline.cases[1]))
    for percent, fails in ((0.4, False), (0.6, True)):
        now = edited(one_seed, lambda _n, k, v, f=1.0 + percent / 100.0: v * f if k == "ate_se3_m" else v)
        check = checked(single, [as_another_trajectory(now), as_measured(baseline)[1]], accept_better=True)
        assert any("one seed" in note for note in check.notes)
        assert bool([v for v in check.failing if v.metric == "ate_se3_m"]) is fails
