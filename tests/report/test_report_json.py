"""report.json holds what a report draws: the same series the metrics were computed from, at every frame."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import to_builtins

from toolkit.answers import Run
from toolkit.datasets import load_sequence
from toolkit.experiment.comparison import Comparison
from toolkit.metrics import Evaluation
from toolkit.metrics.parts.against_truth import rmse
from toolkit.metrics.parts.consistency import body_errors
from toolkit.report.curves import components, error_curves
from toolkit.report.report_json import report_document

Document = dict[str, Any]


def build(comparison: Comparison) -> Document:
    document: Document = to_builtins(report_document(comparison))
    return document


@pytest.fixture(scope="module")
def scored(run_estimator: Callable[..., Run], comparison_of: Callable[..., Comparison]) -> Comparison:
    """A filter that states covariances and innovations, and one that does not, on a short simulated drive."""
    sequence = load_sequence("drive").truncated(40)
    runs = tuple(run_estimator(name, sequence) for name in ("ekf", "dead-reckoning"))
    return comparison_of(sequence, runs)


def of(document: Document, estimator: str, output: str = "causal") -> Document:
    runs = document["runs"]
    return next(run for run in runs if (run["estimator"], run["output"]) == (estimator, output))


def test_nees_and_nis_series_average_to_their_metrics(scored: Comparison) -> None:
    run, scores = of(build(scored), "ekf"), scored.rows[0].scores.values
    # Six digits of each value are kept.
    for part, key in (("pose", "nees_pose_mean"), ("orientation", "nees_ori_mean"), ("position", "nees_pos_mean")):
        assert np.mean(run["nees"][part]) == pytest.approx(scores[key], rel=1e-5)
    info = scored.runs[0].info
    dof = info["nis_dof"][np.isfinite(info["nis"]) & (info["nis_dof"] > 0)]
    assert np.average(run["nis"]["per_dof"], weights=dof) == pytest.approx(scores["nis_mean"], rel=1e-5)


def test_a_series_that_is_not_there_says_why(scored: Comparison) -> None:
    assert of(build(scored), "dead-reckoning")["nis"] == "the estimator reports no innovations"


def test_errors_after_a_fit_are_those_of_the_metric(comparison: Comparison) -> None:
    curves = error_curves(comparison, fitted=True)
    assert curves is not None
    for row, errors in curves.of_rows:
        assert rmse(errors.position_m) == pytest.approx(row.scores.values["ate_se3_m"], rel=1e-9)


def test_errors_are_those_from_the_start_that_the_nees_takes(comparison: Comparison) -> None:
    run, row = of(build(comparison), "late", "final"), comparison.rows[-2]
    assert row.estimator == "late"
    expected_m = body_errors(Evaluation(row.run, "final", comparison.sequence)).distance_m
    np.testing.assert_allclose(run["errors"]["position_m"], expected_m, rtol=1e-5, atol=1e-9)
    path_m = run["errors"]["path_m"]
    assert np.all(np.diff(path_m) >= 0.0)
    assert path_m[0] == 0.0


def test_components_and_their_deviations_are_those_of_the_figure(scored: Comparison) -> None:
    run, row = of(build(scored), "ekf"), scored.rows[0]
    found = components(scored, row)
    assert found is not None
    assert found.sigma is not None
    assert run["components"]["z_m"] == pytest.approx(found.error[:, 5], rel=1e-5, abs=1e-12)  # six digits are kept
    assert run["components"]["sigma_about_x_deg"] == pytest.approx(found.sigma[:, 0], rel=1e-5)
    assert "components" not in of(build(scored), "ekf", "final")


def test_errors_of_outputs_that_agree_stand_once(comparison: Comparison) -> None:
    document = build(comparison)
    assert of(document, "steady")["errors"] is not None
    assert of(document, "steady", "final")["errors"] is None
    assert of(document, "steady", "final")["repeats_causal"]


def test_without_truth_the_difference_is_named(without_truth: Comparison) -> None:
    document = build(without_truth)
    assert document["truth"] is None
    assert document["error"]["what"] == "difference from late final"
    assert np.allclose(of(document, "steady")["rotation"], np.eye(3))


def test_truth_and_trajectories_are_where_the_document_says(run_directory: Path) -> None:
    document = json.loads((run_directory / "report.json").read_text())
    files = [document["truth"], *(run["trajectory"] for run in document["runs"] if run["trajectory"])]
    files += [one["landmarks"] for one in document["maps"]]
    assert len(files) == len(set(files)) > 5
    assert all((run_directory / name).is_file() for name in files)
