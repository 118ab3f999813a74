"""The contract vislam.metrics/1: what is built obeys it, and the validator notices what does not."""

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from toolkit.metrics import Scores, describe
from toolkit.report import metrics_json
from toolkit.report.comparison import Comparison


@pytest.fixture(scope="module")
def document(comparison: Comparison) -> dict[str, Any]:
    return json.loads(metrics_json.to_text(metrics_json.build(comparison)))


def test_built_document_obeys_the_schema(document: dict[str, Any]) -> None:
    assert metrics_json.violations(document) == []


def test_every_run_and_output_has_one_entry(document: dict[str, Any]) -> None:
    assert [(run["estimator"], run["output"], run["status"]) for run in document["runs"]] == [
        ("steady", "causal", "ok"),
        ("steady", "final", "ok"),
        ("astray", "causal", "diverged"),
        ("astray", "final", "diverged"),
        ("late", "final", "ok"),
        ("broken", "final", "failed"),
    ]


def test_the_metrics_package_knows_every_key_of_the_contract() -> None:
    assert set(metrics_json.METRIC_KEYS) <= describe().keys()


def test_key_order_is_stable(document: dict[str, Any]) -> None:
    assert list(document) == ["schema", "sequence", "audit", "runs"]
    expected = ["name", "hash", "frames", "tracks", "observations", "duration_s", "path_m", "motion"]
    assert list(document["sequence"]) == expected
    for run in document["runs"]:
        assert tuple(run["metrics"])[: len(metrics_json.METRIC_KEYS)] == metrics_json.METRIC_KEYS


def test_path_is_the_true_one_and_null_without_truth(document: dict[str, Any], without_truth: Comparison) -> None:
    assert document["sequence"]["path_m"] > 0.0
    blind = metrics_json.build(without_truth)
    assert metrics_json.violations(blind) == []
    assert blind["sequence"]["path_m"] is None


def test_a_value_that_is_not_finite_becomes_null_with_a_note(comparison: Comparison) -> None:
    scores = Scores(dict.fromkeys(describe(), float("nan")), {})
    broken = replace(comparison, rows=(replace(comparison.rows[0], scores=scores),))
    built = metrics_json.build(broken)
    assert metrics_json.violations(json.loads(metrics_json.to_text(built))) == []
    assert built["runs"][0]["metrics"]["ate_se3_m"] is None


def _drop_metric(document: dict[str, Any]) -> None:
    del document["runs"][0]["metrics"]["ate_se3_m"]


def _drop_note(document: dict[str, Any]) -> None:
    document["runs"][-1]["notes"].clear()


def _text_for_a_number(document: dict[str, Any]) -> None:
    document["runs"][0]["metrics"]["ate_se3_m"] = "0.2"


def _truth_for_a_count(document: dict[str, Any]) -> None:
    document["sequence"]["frames"] = True


def _unknown_status(document: dict[str, Any]) -> None:
    document["runs"][0]["status"] = "fine"


def _other_schema(document: dict[str, Any]) -> None:
    document["schema"] = "vislam.metrics/2"


def _finding_without_detail(document: dict[str, Any]) -> None:
    del document["audit"][0]["detail"]


def _no_runs(document: dict[str, Any]) -> None:
    del document["runs"]


@pytest.mark.parametrize(
    "spoil",
    [
        _drop_metric,
        _drop_note,
        _text_for_a_number,
        _truth_for_a_count,
        _unknown_status,
        _other_schema,
        _finding_without_detail,
        _no_runs,
    ],
)
def test_the_validator_notices(document: dict[str, Any], spoil: Callable[[dict[str, Any]], None]) -> None:
    spoiled = copy.deepcopy(document)
    spoil(spoiled)
    assert metrics_json.violations(spoiled)


@pytest.mark.parametrize("document", [None, [], {"runs": [3], "audit": 4}])
def test_the_validator_survives_anything(document: object) -> None:
    assert metrics_json.violations(document)
