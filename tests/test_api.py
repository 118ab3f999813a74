"""Comparisons within a program say what the command line says, from a script or a notebook."""

import inspect
import os
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import toolkit
from toolkit.api import Result
from toolkit.audit import faults
from toolkit.datasets import load_sequence
from toolkit.datasets.io.truth import load_truth
from toolkit.errors import DataError, VislamError
from toolkit.estimator import Estimator, Setup
from toolkit.metrics import describe
from toolkit.registry import LADDER, defaults, find
from toolkit.report.comparison_table import comparison_table
from toolkit.sequence import Sequence
from toolkit.settings import SettingsError

FRAMES = 20
RECORDING = Path(__file__).parents[1] / "data" / "drive_small"

# A comparison in two processes, and what a reader would do with it; the same program in two surroundings.
PROGRAM = textwrap.dedent(f"""
    import toolkit
    from toolkit.registry import find

    def build(setup):
        return find("dead-reckoning").load()(setup)

    r = toolkit.compare({str(RECORDING)!r}, ["dead-reckoning"], own={{"mine": build}}, max_frames={FRAMES}, workers=2)
    mine, other = (r.metrics[name, "final"]["heldout_reproj_median_px"] for name in ("mine", "dead-reckoning"))
    print("metrics agree:", mine is not None and mine == other)
    print(r)
""")


@pytest.fixture(scope="module")
def result() -> Result:
    return toolkit.compare("drive", ["dead-reckoning", "ekf"], max_frames=FRAMES, workers=1)


@pytest.fixture(scope="module")
def over() -> Result:
    return toolkit.compare("drive", "dead-reckoning", max_frames=FRAMES, seed=1, seeds=2, workers=1)


def ate(result: Result) -> list[float | None]:
    return [row.value("ate_se3_m") for row in result.comparison.rows]


@pytest.mark.usefixtures("unrendered")
def test_a_result_is_saved_and_a_recording_and_its_truth_are_paths_or_strings(tmp_path: Path, result: Result) -> None:
    assert result.save(str(tmp_path / "run")) == tmp_path / "run"
    truth = tmp_path / "run/trajectories/truth.tum"
    for recording, file in ((RECORDING, truth), (str(RECORDING), str(truth))):
        compared = toolkit.compare(recording, "dead-reckoning", truth=file, max_frames=FRAMES, workers=1).comparison
        assert compared.sequence.truth.t_ns.tolist() == load_truth(truth).truth.t_ns.tolist()


def test_estimators_are_one_name_several_or_the_default_ones_and_a_source_a_name_or_a_sequence(result: Result) -> None:
    for source, names in (("drive", "ekf"), (load_sequence("drive"), iter(["ekf"]))):
        alone = toolkit.compare(source, names, max_frames=FRAMES, workers=1)
        assert alone.comparison.estimators == ("ekf",)
        assert ate(alone) == ate(result)[2:]
    assert toolkit.compare("drive", max_frames=3, workers=1).comparison.estimators == defaults() != ()
    assert not result.comparison.changes
    assert toolkit.compare("drive", LADDER, max_frames=2, workers=1).comparison.changes["ekf"]


def test_faults_that_are_kept_are_not_repaired() -> None:
    drive = load_sequence("drive").truncated(2 * FRAMES)
    uv_px = drive.observations.uv_px.copy()
    uv_px[::97, 1] = uv_px[::97, 0]  # no disparity
    faulty = replace(drive, observations=replace(drive.observations, uv_px=uv_px))
    found = [
        toolkit.compare(faulty, "dead-reckoning", keep=keep, max_frames=FRAMES, workers=1).comparison.findings
        for keep in ((), faults())
    ]
    assert [[finding.repaired for finding in findings] for findings in found] == [[True], [False]]


def test_a_table_has_the_columns_requested_in_their_order_by_key_or_name(result: Result) -> None:
    whole, chosen = comparison_table(result.comparison), result.table("nis_mean", "ATE SE(3)").table
    assert [heading[:2] for heading in chosen.headings[whole.labels :]] == [("NIS", "mean"), ("ATE", "SE(3)")]
    at = [heading[:2] for heading in whole.headings].index(("ATE", "SE(3)"))
    assert [row[-1] for row in chosen.rows] == [row[at] for row in whole.rows]
    assert len(result.table("all").table.headings) > len(whole.headings)
    for shown in (result.table, result.to_latex):
        with pytest.raises(SettingsError, match="a column is an int; give names"):
            shown(3)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("requested", "why"), [({"figures": "some"}, "few, all, none"), ({"figure_format": "jpg"}, "png, pdf")]
)
def test_figures_that_there_are_not_are_refused_before_anything_is_written(
    result: Result, tmp_path: Path, requested: dict[str, Any], why: str
) -> None:
    with pytest.raises(SettingsError, match=rf"{next(iter(requested))} is '.*'; there are {why}"):
        result.save(tmp_path / "run", **requested)
    assert not list(tmp_path.iterdir())


def test_a_sequence_is_loaded_by_a_name_and_a_whole_number() -> None:
    for source, seed, why in ((3, 0, "not 3"), ("drive", "a", "seed is 'a'"), ("drive", -1, "seed is -1")):
        with pytest.raises(DataError, match=why):
            toolkit.load_sequence(source, seed=seed)  # type: ignore[arg-type]


def test_a_result_shows_its_table(result: Result, over: Result) -> None:
    for one, title in ((result, "drive"), (over, "drive, 2 seeds")):
        assert repr(one) == f"{title}\n{one.table()}"
        assert one._repr_markdown_() == one.table()._repr_markdown_()
        assert max(map(len, repr(one).splitlines())) <= 100


def test_figures_come_by_name(result: Result, over: Result) -> None:
    assert {"top_all", "top_ekf", "errors_over_time"} <= result.figures.keys()
    assert set(over.figures) == {"errors_over_seeds", "nees_over_seeds"}
    assert all(isinstance(figure, Figure) for figure in over.figures.values())
    assert result.figures["top_all"] is result.figures["top_all"]
    with pytest.raises(VislamError, match=r"no entry is called top_batch .*; there are top_all, .*top_ekf"):
        result.figures["top_batch"]


def test_metrics_are_those_of_the_rows_and_of_the_mean_over_seeds(result: Result, over: Result) -> None:
    assert list(result.metrics) == [(row.estimator, row.output) for row in result.comparison.rows]
    assert set(result.metrics["ekf", "causal"]) == set(describe())
    assert [result.metrics[row.estimator, row.output]["ate_se3_m"] for row in result.comparison.rows] == ate(result)
    values = [record.value for record in over.records() if record[3:5] == ("both", "ate_se3_m")]
    assert over.metrics["dead-reckoning", "final"]["ate_se3_m"] == pytest.approx(np.mean(values))  # type: ignore[arg-type]
    with pytest.raises(
        VislamError, match=r"no entry is called \('batch', 'final'\).*there are \('dead-reckoning', 'causal'\)"
    ):
        result.metrics["batch", "final"]
    with pytest.raises(KeyError, match=r"no entry is called ate_se3 \(did you mean ate_se3_m\?\)"):
        result.metrics["ekf", "final"]["ate_se3"]


def test_records_are_a_row_of_every_value_and_those_of_a_filter_are_there_once(result: Result, over: Result) -> None:
    rows = list(over.records())
    assert {(row.sequence, row.seed, row.estimator, row.output) for row in rows} == {
        ("drive", seed, "dead-reckoning", "both") for seed in (1, 2)
    }
    assert len(rows) == 2 * len(describe())
    by_key = {row[1:5]: row.value for row in result.records()}
    for line in result.comparison.lines:
        for key in describe():
            assert by_key[0, line.estimator, line.label, key] == line.value(key)


def test_a_frame_of_pandas_has_the_records(result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = result.to_pandas()
    assert list(frame.columns) == ["sequence", "seed", "estimator", "output", "metric", "value"]
    ate_m = frame[(frame.metric == "ate_se3_m") & (frame.estimator == "ekf")].value
    assert list(ate_m) == [result.metrics["ekf", "causal"]["ate_se3_m"]]
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(VislamError, match=r'pandas; pip install "vislam-toolkit\[pandas\]"$'):
        result.to_pandas()


def test_what_is_kept_is_found_and_a_function_is_run_again(tmp_path: Path) -> None:
    built: list[int] = []

    def mine(setup: Setup) -> Estimator:
        built.append(1)
        return find("dead-reckoning").load()(setup)

    def compared(seeds: int) -> Result:
        run = tmp_path / "run"
        own = {"mine": mine}
        return toolkit.compare(
            "drive", "dead-reckoning", own=own, max_frames=FRAMES, seeds=seeds, workers=1, resume=run
        )

    compared(2)
    kept = (tmp_path / "run" / "outcomes.jsonl").read_text().splitlines()
    assert len(kept) == 2
    first = compared(3)
    assert (tmp_path / "run" / "outcomes.jsonl").read_text().splitlines()[:2] == kept
    assert len(built) == 2 + 3
    assert first.metrics["mine", "final"]["ate_se3_m"] == first.metrics["dead-reckoning", "final"]["ate_se3_m"]


def test_settings_are_a_record_or_nested_values(result: Result) -> None:
    given = {"noise": {"pixel_sigma_px": np.float64(0.5)}, "first_seed": np.int64(1)}
    by_values = toolkit.compare("drive", "ekf", settings=given, max_frames=FRAMES, workers=1)
    by_record = toolkit.compare("drive", "ekf", settings=by_values.comparison.settings, max_frames=FRAMES, workers=1)
    assert ate(by_values) == ate(by_record) != ate(result)[2:]
    with pytest.raises(
        VislamError, match=r"there is no setting noise.pixel_sigma; did you mean noise.pixel_sigma_px\?"
    ):
        toolkit.compare("drive", settings={"noise": {"pixel_sigma": 1.0}})


@pytest.mark.parametrize(
    ("requested", "why"),
    [
        ({"max_frames": 1}, "max_frames: expected integer >= 2"),
        ({"max_frames": 2.5}, "max_frames: expected integer or null, got number"),
        ({"max_frames": True}, "max_frames: expected integer"),
        ({"every": np.array([2])}, "every: expected integer, got"),
        ({"workers": 0}, "workers: expected integer >= 1"),
        ({"workers": 2, "scheduler": "tcp://host:1"}, "scheduler and workers exclude each other"),
        ({"from_s": -1.0}, "from_s: expected number >= 0"),
        ({"from_s": 5.0, "to_s": 2.0}, "from 5 s to 2 s: a part begins and ends"),
        ({"to_s": 10**400}, "to_s: number out of range"),
        ({"seed": 1.0}, "seed: expected integer"),
        ({"truth": 3}, "truth: expected string or null, got integer"),
        ({"truth": "gt.tum", "seeds": 2}, "truth and seeds exclude each other"),
        ({"trajectories": "est.tum"}, "trajectories: expected object, got string"),
        ({"own": {"ekf": print}}, "own has a function called ekf, and so has estimators"),
        ({"estimators": [3]}, r"estimators\[0\]: expected string, got integer"),
        ({"settings": {"window.lag_s": 3.0}}, r"write \{'window': \{'lag_s': ...\}\}, or in TOML window.lag_s without"),
        ({"settings": {"window": {"lag_s": np.array([1.0, 2.0])}}}, "window.lag_s is a ndarray; give a number"),
    ],
)
def test_what_cannot_be_compared_is_refused_before_anything_runs(
    requested: dict[str, object], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(toolkit.api, "run_plan", None)
    with pytest.raises(SettingsError, match=why):
        toolkit.compare(**{"source": "drive", "estimators": "ekf", **requested})


def _with(**columns: np.ndarray) -> Sequence:
    drive = load_sequence(str(RECORDING)).truncated(FRAMES)
    return replace(drive, observations=replace(drive.observations, **columns))


def test_a_sequence_whose_observations_are_not_of_its_frames_is_refused() -> None:
    seen = _with().observations
    for columns, why in (
        ({"uv_px": seen.uv_px[:-1]}, "the observations' columns differ in length"),
        ({"frame": seen.frame[::-1]}, "the observations are not sorted by frame"),
        ({"frame": seen.frame + FRAMES}, f"observation 0 is of frame {FRAMES}, there are {FRAMES}"),
    ):
        with pytest.raises(DataError, match=f"drive_small: {why}"):
            toolkit.compare(_with(**columns), "dead-reckoning", workers=1)
    with pytest.raises(DataError, match="it has no -3 frames"):
        _with().truncated(-3)


def surrounded(words: list[str], program: str | None, folder: Path) -> str:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    messages = subprocess.run(
        [sys.executable, *words],
        input=program,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert (messages.returncode, messages.stderr) == (0, "")
    return messages.stdout


# A kernel executes each statement in the namespace of a main module without a file.
KERNEL = """
import ast, sys
main = sys.modules["__main__"].__dict__
for cell in ast.parse(sys.stdin.read()).body:
    exec(compile(ast.Module([cell], []), "<cell>", "exec"), main)
"""


@pytest.mark.parametrize("words", [["unguarded.py"], ["-c", KERNEL]], ids=["script", "notebook"])
def test_it_runs_in_processes_from_anywhere_and_once(tmp_path: Path, words: list[str]) -> None:
    """No guard around the main program, no file to import again: and what the program prints, it prints once."""
    (tmp_path / "unguarded.py").write_text(PROGRAM)
    reported = surrounded(words, PROGRAM, tmp_path)
    assert reported.count("metrics agree: True\n") == 1
    assert reported.splitlines()[1] == "drive_small"
    assert "mine" in reported


def test_nothing_slow_is_imported_before_it_is_used() -> None:
    slow = ("numpy", "gtsam", "matplotlib", "loky", "toolkit.api")
    program = f"import sys, toolkit; print([name for name in {slow!r} if name in sys.modules], dir(toolkit))"
    messages = surrounded(["-c", program], None, Path())
    assert messages.startswith("[] ")
    assert all(repr(name) in messages for name in toolkit.__all__)


def test_all_of_the_api_and_its_methods_are_explained() -> None:
    for name in toolkit.__all__:
        found = getattr(toolkit, name)
        parts = vars(found).items() if isinstance(found, type) else ()
        told = [found, *(getattr(found, part) for part, value in parts if callable(value) and part[0] != "_")]
        assert all(inspect.getdoc(part) for part in told), name


def test_a_sweep_is_the_rows_of_a_long_table_and_shows_itself() -> None:
    swept = toolkit.sweep(
        "drive", {"fault:dropped_frames": [0.2, 0.4]}, ["dead-reckoning"], max_frames=FRAMES, seeds=2, workers=1
    )
    rows = [row for row in swept if row["metric"] == "ate_none_m" and row["output"] == "final"]
    assert [(row["fault:dropped_frames"], row["seed"]) for row in rows] == [
        (dose, seed) for dose in (0.0, 0.2, 0.4) for seed in (0, 1)
    ]
    assert {row["status"] for row in rows} == {"ok"}
    assert "breaks at" in str(swept.table()) and "breaks at" in repr(swept)
    assert isinstance(swept.figures["sweep_fault_dropped_frames"], Figure)
    with pytest.raises(SettingsError, match="no argument is called max_frame"):
        toolkit.sweep("drive", {"fault:dropped_frames": [0.2]}, max_frame=3)  # type: ignore[call-arg]
    with pytest.raises(SettingsError, match="no argument is called trajectories"):
        toolkit.explain("drive", trajectories={"theirs": "est.tum"})  # type: ignore[call-arg]
