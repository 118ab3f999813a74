"""Kept outcomes: found again to the bit, for what they depend on and nothing else, whatever a kill leaves behind."""

import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from toolkit.errors import DataError, OutputError
from toolkit.experiment import outcome_store, pipeline
from toolkit.experiment.comparison import Comparison
from toolkit.experiment.outcome_store import OUTCOMES, Conditions, OutcomeStore, files_of_ours
from toolkit.experiment.pipeline import Plan, comparisons, prepared_cases, stores_of
from toolkit.experiment.recording import Recording
from toolkit.experiment.units import Outcome, Scored, Unit, run_unit
from toolkit.experiment.workers import Workers
from toolkit.metrics import Scores, describe
from toolkit.progress import Progress
from toolkit.report.scores import seeds_document
from toolkit.settings import Settings
from toolkit.settings.reading import settings_of

PROJECT = Path(__file__).parents[2]
TWO = ("dead-reckoning", "ekf")
TIMES = ("frame_", "total_s", "cpu_s", "peak_rss")
Sweep = Callable[..., Comparison]


class Ran(list[tuple[int, str]]):
    """The units that were run, as seed and estimator; after ``until`` of them the next is killed."""

    until: int | None = None

    def __call__(self, unit: Unit, progress: Progress) -> Outcome:
        if self.until == len(self):
            raise KeyboardInterrupt
        self.append((unit.seed, unit.estimator))
        return run_unit(unit, progress)


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> Ran:
    runs = Ran()
    monkeypatch.setattr(pipeline, "run_unit", runs)
    return runs


@pytest.fixture
def sweep(tmp_path: Path, ran: Ran, two_seconds: None, monkeypatch: pytest.MonkeyPatch) -> Sweep:
    """Return a function that compares over seeds, with what ended kept in a directory."""
    # It would draw two whole recordings.
    monkeypatch.setattr(pipeline, "is_drawn_from_a_seed", lambda *_: True)

    def compare(
        estimators: tuple[str, ...] = TWO, directory: str = "run", keep: bool = False, **settings: object
    ) -> Comparison:
        ran.clear()
        requested = settings_of({"seeds": 2, **settings}, "here")
        plan = Plan(("drive",), estimators, settings=requested, max_frames=10, workers=1, keep_trajectories=keep)
        with Workers(1) as workers:
            cases = prepared_cases(plan, workers)
            (store,) = stores_of(plan, cases, [tmp_path / directory])
            try:
                (found,) = comparisons(plan, cases, workers, stores=[store])
            finally:
                store.close()
        return found

    return compare


def answers(comparison: Comparison) -> list[object]:
    """Return all that a comparison found, the times left out."""
    document = msgspec.to_builtins(seeds_document(comparison))
    for run in document["runs"]:
        run["metrics"] = {key: value for key, value in run["metrics"].items() if not key.startswith(TIMES)}
    series = [
        (output, one.nees_pose.tobytes(), one.position_m.tobytes(), one.nis_dof)
        for outcome in comparison.outcomes
        for output, one in outcome.outputs.items()
    ]
    return [document, series]


@pytest.mark.parametrize(("ended", "torn"), [(0, b""), (1, b'{"schema":"vislam.outcome/2","unit":{"da'), (3, b"{")])
def test_interrupted_and_continued_equals_uninterrupted(sweep, ran, tmp_path, ended, torn):
    ran.until = ended
    with pytest.raises(KeyboardInterrupt):
        sweep()
    first = list(ran)
    if ended:
        with (tmp_path / "run" / OUTCOMES).open("ab") as file:
            file.write(torn)
    ran.until = None
    continued = sweep()
    assert sorted(first + ran) == [(seed, name) for seed in (0, 1) for name in TWO]  # nothing finished is done twice
    assert answers(continued) == answers(sweep(directory="other"))
    assert len((tmp_path / "run" / OUTCOMES).read_bytes().splitlines()) == 4


def test_what_is_requested_in_addition_is_all_that_runs(sweep, ran):
    sweep(("ekf",))
    sweep(("ekf",), seeds=3)
    assert ran == [(2, "ekf")]
    sweep(TWO, seeds=3)
    assert sorted(ran) == [(seed, "dead-reckoning") for seed in (0, 1, 2)]
    sweep(TWO, seeds=1 + 1, first_seed=2)
    assert sorted(ran) == [(3, "dead-reckoning"), (3, "ekf")]
    whole = sweep(TWO, seeds=4)
    assert ran == []
    assert answers(whole) == answers(sweep(TWO, directory="other", seeds=4))


def test_the_options_of_another_estimator_change_no_run(drive_key):
    plain = drive_key("ekf")
    assert drive_key("ekf", estimators={"batch": {"rounds": 2}}) == plain
    assert drive_key("ekf", estimators={"ekf": {"rounds": 2}}) != plain
    assert drive_key("ekf", seeds=9, metrics={"bound": True}) == plain
    assert drive_key("ekf", start="truth") != plain


@pytest.fixture
def drive_key() -> Callable[..., bytes]:
    def key(estimator: str, **settings: object) -> bytes:
        return Conditions("data").key(Unit(Recording("drive"), 0, estimator, settings_of(settings, "here"))).text()

    return key


def test_all_parts_above_the_experiment_and_no_others_change_no_result():
    contracts = tomllib.loads((PROJECT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(one["layers"] for one in contracts if one["type"] == "layers")
    above = [part for layer in layers[: layers.index("experiment")] for part in layer.split(" | ")]
    there = {part if (PROJECT / "toolkit" / part).is_dir() else f"{part}.py" for part in above}
    assert set(outcome_store._ABOVE) == there


@pytest.mark.parametrize("changed", ["code_digest", "numeric_versions"])
def test_another_version_is_another_run(sweep, ran, monkeypatch, changed):
    sweep()
    monkeypatch.setattr(outcome_store, changed, lambda: "0" if changed == "code_digest" else {"numpy": "0"})
    sweep()
    assert len(ran) == 4


def test_other_data_under_the_same_name_are_other_runs(store, tmp_path):
    store.keep(UNIT, OUTCOME)
    store.close()
    for conditions in (Conditions("another hash"), Conditions("hash", frozenset({"stale_frames"}))):
        other = OutcomeStore(tmp_path, conditions)
        assert (other.find(UNIT), other.unusable) == (None, 1)
        other.close()


def test_a_metric_on_request_is_had_where_it_is_missing_and_left_out_where_nobody_asks(sweep, ran):
    plain = answers(sweep(seeds=2))
    with_bound = {"metrics": {"bound": True}}
    assert sweep(seeds=2, **with_bound).rows[0].value("bound_position_m") is not None
    assert len(ran) == 4
    sweep(seeds=2, **with_bound)
    assert ran == []
    assert answers(sweep(seeds=2)) == plain
    assert ran == []


def test_kept_trajectories_are_made_where_they_are_missing_or_changed(sweep, ran, tmp_path):
    sweep()
    kept = sweep(keep=True)
    assert len(ran) == 4
    files = sorted(name for outcome in kept.outcomes for name in outcome.files)
    assert len(files) == 8
    assert files[0] == "trajectories/seed-0/dead-reckoning_causal.tum"
    assert all(len((tmp_path / "run" / name).read_text().splitlines()) == 11 for name in files)
    assert {OUTCOMES, *files} == files_of_ours(tmp_path / "run")
    (tmp_path / "run" / files[0]).write_text("of somebody else's run")
    again = sweep(keep=True)
    assert ran == [(0, "dead-reckoning")]
    assert [outcome.files for outcome in again.outcomes] == [outcome.files for outcome in kept.outcomes]


UNIT = Unit(Recording("drive"), 0, "ekf")
OUTCOME = Outcome(0, "ekf", "ok", sequence_hash="hash")


@pytest.fixture
def store(tmp_path: Path) -> OutcomeStore:
    return OutcomeStore(tmp_path, Conditions("hash"))


@pytest.mark.parametrize("seed", range(8))  # each of the special numbers once as the degrees of freedom
def test_every_number_is_found_again_to_the_bit(store, tmp_path, seed):
    bits = np.random.default_rng(seed).integers(0, 2**64, 200, dtype=np.uint64).view(np.float64)
    numbers = np.concatenate([[0.0, -0.0, 5e-324, np.inf, -np.inf, np.nan, 1e22, 3.0], bits])
    finite = numbers[np.isfinite(numbers)][: len(describe())].tolist()
    values = dict(zip(describe(), [7, np.float64(0.1), *finite], strict=False))
    scored = Scored(Scores({**dict.fromkeys(describe()), **values}), numbers, numbers[::-1], numbers[seed])
    store.keep(UNIT, replace(OUTCOME, outputs={"final": scored}))
    store.close()
    requested = replace(UNIT, settings=Settings())
    found = OutcomeStore(tmp_path, Conditions("hash")).find(requested)
    one = found.outputs["final"]
    np.testing.assert_array_equal(one.nees_pose, numbers)
    np.testing.assert_array_equal(one.position_m, numbers[::-1])
    assert np.signbit(one.nees_pose[1])
    if np.isnan(numbers[seed]):
        assert one.nis_dof is None
    else:
        assert one.nis_dof == numbers[seed]
    kept = {key: value for key, value in one.scores.values.items() if not key.startswith(BOUND)}
    given = {key: scored.scores.values[key] for key in kept}
    assert kept == given
    assert [type(value) for value in kept.values()][:3] == [int, float, float]


BOUND = ("bound_", "efficiency", "excess_", "claimed_", "error_over_bound")


def test_two_processes_do_not_write_into_one_another(store, tmp_path):
    store.keep(UNIT, OUTCOME)
    with pytest.raises(OutputError, match="being written by another run"):
        OutcomeStore(tmp_path, Conditions("hash"))
    store.close()
    OutcomeStore(tmp_path, Conditions("hash")).close()


@pytest.mark.parametrize(
    ("was", "becomes", "told"),
    [
        (b'"ate_se3_m":0.5', b'"ate_se3_m":0.1', "was changed since it was written"),
        (b'"seed":3', b'"seed":4', "was changed since it was written"),
        (b'"sha256":"', b'"sha256":"0', "was changed since it was written"),
        (b'"ok"', b'"fine"', "is no outcome .*fine"),
    ],
)
def test_a_line_that_was_edited_or_is_damaged_is_refused_with_its_number(store, tmp_path, was, becomes, told):
    scored = Scored(Scores({**dict.fromkeys(describe()), "ate_se3_m": 0.5}), np.zeros(2), np.zeros(2), 3.0)
    store.keep(UNIT, OUTCOME)
    store.keep(replace(UNIT, seed=3), replace(OUTCOME, seed=3, outputs={"final": scored}))
    store.close()
    path = tmp_path / OUTCOMES
    first, second = path.read_bytes().splitlines(keepends=True)
    assert second.count(was) == 1
    path.write_bytes(first + second.replace(was, becomes, 1))
    with pytest.raises(DataError, match=rf"line 2: {told}.*delete the line"):
        OutcomeStore(tmp_path, Conditions("hash"))


def test_a_line_of_an_earlier_version_is_counted_and_never_found(store, tmp_path):
    """It has no checksum, and is of other code in any case."""
    store.keep(UNIT, OUTCOME)
    store.close()
    path = tmp_path / OUTCOMES
    path.write_bytes(path.read_bytes().replace(b"vislam.outcome/2", b"vislam.outcome/1"))
    again = OutcomeStore(tmp_path, Conditions("hash"))
    assert again.unusable == 1
    assert again.find(UNIT) is None
    again.close()


@pytest.mark.parametrize("name", ["../notes.txt", "notes.txt", "/etc/hosts", "trajectories/../notes.txt"])
def test_a_line_makes_no_file_elsewhere_ours(tmp_path, name):
    (tmp_path / OUTCOMES).write_text(f'{{"schema":"vislam.outcome-files/1","files":["{name}"]}}\n')
    assert files_of_ours(tmp_path) == {OUTCOMES}


@pytest.mark.parametrize(("content", "ours"), [(b"", True), (b'{"sche', True), (b"{}\n", False), (b"notes", False)])
def test_a_file_of_that_name_is_ours_by_its_beginning(tmp_path, content, ours):
    (tmp_path / OUTCOMES).write_bytes(content)
    assert files_of_ours(tmp_path) == ({OUTCOMES} if ours else set())
