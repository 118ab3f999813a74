"""metrics.json holds every score there is, and says why one is missing."""

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from toolkit.experiment.comparison import Comparison, Row, consistency_of
from toolkit.files.documents import parse, to_text
from toolkit.metrics import Scores, describe
from toolkit.report.messages import note_lines
from toolkit.report.scores import MetricsDocument, metrics_document

Rescored = Callable[[Comparison, Callable[[Row], Scores]], Comparison]


@pytest.fixture(scope="module")
def document(comparison: Comparison) -> dict[str, Any]:
    return json.loads(to_text(metrics_document(comparison)))


def test_what_is_written_is_read_back(comparison: Comparison) -> None:
    built = metrics_document(comparison)
    assert parse(to_text(built), MetricsDocument) == built


def test_key_order_is_stable(document: dict[str, Any]) -> None:
    assert list(document) == ["schema", "sequence", "audit", "undecided", "runs"]
    expected = ["name", "hash", "frames", "tracks", "observations", "duration_s", "path_m", "motion"]
    assert list(document["sequence"]) == expected
    for run in document["runs"]:
        assert list(run["metrics"]) == list(describe())


def test_the_verdict_on_the_stated_uncertainty_is_reported_with_its_figures(
    comparison: Comparison, rescored: Rescored
) -> None:
    timid = rescored(comparison, lambda row: Scores(row.scores.values | {"nees_pose_mean": 0.1}, {}))
    built = json.loads(to_text(metrics_document(timid)))
    assert parse(to_text(metrics_document(timid)), MetricsDocument) == metrics_document(timid)
    low, high = built["runs"][0]["consistency"].pop("band")
    assert (low, high) == (pytest.approx(1.2373 / 6, rel=1e-4), pytest.approx(14.4494 / 6, rel=1e-4))
    assert built["runs"][0]["consistency"] == {"verdict": "timid", "metric": "nees_pose_mean", "mean": 0.1}
    assert "consistency" not in built["runs"][-1]  # it failed without an answer
    words = [line for line in note_lines(timid) if "timid" in line]
    assert all(part in words[0] for part in ("steady", "NEES", "0.100", "2.41"))


def test_small_innovations_behind_a_gate_that_refused_many_are_no_timid_estimator(comparison: Comparison) -> None:
    def mark(accepted: float) -> str:
        one = replace(comparison.lines[0].outcomes[0].outputs["causal"], nis_dof=900.0)
        values = {"nis_mean": 0.4, "gate_accepted_percent": accepted}
        checked = consistency_of([replace(one, scores=Scores(values, {}))])
        assert checked is not None
        return checked.verdict

    assert mark(95.0) == "timid"
    assert mark(88.0) == "heavy-tailed"


def test_a_run_whose_tracks_turn_its_state_one_way_is_reported_with_trend_and_limit(
    comparison: Comparison, rescored: Rescored
) -> None:
    trend = {"correction_trend": 5.25, "correction_trend_limit": 4.0, "nees_pose_mean": 1.0}
    leaning = rescored(comparison, lambda row: Scores(row.scores.values | trend, {}))
    built = json.loads(to_text(metrics_document(leaning)))
    assert parse(to_text(metrics_document(leaning)), MetricsDocument) == metrics_document(leaning)
    assert built["runs"][0]["consistency"] == {
        "verdict": "contradicted",
        "metric": "correction_trend",
        "mean": 5.25,
        "band": [0.0, 4.0],
    }
    words = [line for line in note_lines(leaning) if "contradicted" in line]
    assert all(text in words[0] for text in ("steady", "trend 5.2", "limit 4.00", "check calibration"))


def test_who_explains_withheld_tracks_worse_than_the_motion_is_named(
    comparison: Comparison, rescored: Rescored
) -> None:
    harm = "explains withheld tracks worse than dead reckoning, with 3.00 +- 0.10 times its error"

    def given(row: Row) -> Scores:
        is_first = row.estimator == comparison.lines[0].estimator
        found = {"heldout_over_motion": 3.0 if is_first else 0.9}
        return Scores(row.scores.values | found, {"heldout_over_motion": harm} if is_first else {})

    reported = [line for line in note_lines(rescored(comparison, given)) if "withheld tracks worse" in line]
    assert reported == [f"{comparison.lines[0].estimator} {harm}"] * len(reported)
    assert reported


def test_a_gate_that_refuses_much_is_reported_with_its_share(comparison: Comparison, rescored: Rescored) -> None:
    def words(accepted: float) -> list[str]:
        reported = rescored(comparison, lambda row: Scores(row.scores.values | {"gate_accepted_percent": accepted}, {}))
        return [line for line in note_lines(reported) if "outlier gate" in line]

    assert words(91.0) == []
    (line,) = words(55.0)
    assert "steady 45 %" in line
    assert "calibration" in line


def test_a_value_that_is_not_finite_becomes_null_with_a_note(comparison: Comparison, rescored: Rescored) -> None:
    scores = Scores(dict.fromkeys(describe(), float("nan")), {})
    built = metrics_document(rescored(comparison, lambda _: scores))
    assert parse(to_text(built), MetricsDocument) == built
    assert built.runs[0].metrics["ate_se3_m"] is None
