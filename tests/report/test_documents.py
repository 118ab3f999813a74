"""The documents of a run are those that their contracts describe: written, read back, refused with the place."""

import json
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import numpy as np
import pytest
from msgspec import to_builtins

from tests.report.conftest import rescored
from toolkit.errors import DataError
from toolkit.experiment.comparison import Comparison, Row
from toolkit.experiment.configuration import Request, read_configuration, record_of
from toolkit.files.documents import parse, read, to_line, to_text
from toolkit.gate import baseline
from toolkit.metrics import Evaluation, Scores, describe
from toolkit.metrics.parts.consistency import body_errors
from toolkit.report.curves import components
from toolkit.report.messages import note_lines
from toolkit.report.records import read_card, read_check, read_manifest
from toolkit.report.report_json import report_document
from toolkit.report.scores import MetricsDocument, metrics_document
from toolkit.settings import Noise, Settings
from toolkit.settings.reading import settings_of

Document = dict[str, Any]

# Written by the commands of revision 0d93a31 on `drive`: the hand-written predecessors of the records; card and sweep
# by the first command that made one of its version.
OLD = Path(__file__).parent / "documents"
PROJECT = Path(__file__).parents[2]
DOCS = PROJECT / "docs"
SCHEMAS, MADE = DOCS / "schemas", runpy.run_path(str(DOCS / "site/schemas.py"))
RECORDS: dict[str, type[msgspec.Struct]] = MADE["RECORDS"]
OF_KIND = {name.rpartition("-")[0]: name for name in RECORDS} | {"manifest-over-seeds": "manifest-1"}
CASES = {path.name: OF_KIND[path.stem] for path in sorted(OLD.iterdir())}
# Baselines are made to be reviewed, and laid out otherwise than other documents.
REVIEWED = {"baseline.json", "trajectory-baseline.json"}


def old(name: str) -> Document:
    document: Document = json.loads((OLD / name).read_text())
    return document


def refused(name: str, document: object) -> str:
    """Return what is said of a document that must not be read."""
    with pytest.raises(DataError) as raised:
        parse(json.dumps(document), RECORDS[CASES[name]])
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_there_is_an_old_document_of_each_kind() -> None:
    assert set(CASES.values()) == RECORDS.keys()


@pytest.mark.parametrize("name", CASES)
def test_an_old_document_is_written_again_as_it_was(name: str) -> None:
    written = (OLD / name).read_text()
    record = read(OLD / name, RECORDS[CASES[name]])
    assert written in (to_text(record), to_line(record)) or name in REVIEWED


@pytest.mark.parametrize("name", CASES)
def test_an_old_document_keeps_the_published_schema(name: str) -> None:
    published = json.loads((SCHEMAS / f"{CASES[name]}.json").read_text())
    jsonschema.Draft202012Validator.check_schema(published)
    jsonschema.validate(old(name), published)


def test_a_check_of_version_1_is_read_as_one_that_let_pass_what_got_better() -> None:
    path = OLD.with_name("older_documents") / "check-1.json"
    expected = json.loads(path.read_text()) | {"schema": "vislam.check/2", "accept_better": True}
    assert json.loads(to_text(read_check(path))) == expected


def test_a_card_of_version_1_is_read_as_one_whose_tracks_were_not_weighed() -> None:
    path = OLD.with_name("older_documents") / "card-1.json"
    card = read_card(path)
    assert (card.schema, card.track_weight) == ("vislam.card/1", msgspec.UNSET)
    given = json.loads(path.read_text())
    assert {key: given[key] for key in json.loads(to_text(card))} == json.loads(to_text(card))


def test_a_manifest_with_settings_of_then_that_changed_no_answer_is_read_and_repeated_without() -> None:
    path = OLD.with_name("older_documents") / "manifest-1.json"  # revision eb80bd9a, the last with compiled twins
    given = json.loads(path.read_text())
    assert given.pop("arithmetic") == {"msckf": "compiled"} and given["settings"].pop("arithmetic") == "auto"
    assert given["settings"]["tracks"].pop("leave_out_moving") is False
    given["settings"]["noise"]["biases"] = "estimated"  # a setting since then
    assert json.loads(to_text(read_manifest(path))) == given
    request, settings = read_configuration(path)
    assert to_builtins(settings_of(settings, str(path))) == given["settings"]
    assert record_of(Request, request).estimators == ("ekf", "msckf")


def test_a_baseline_that_chose_the_arithmetic_is_read_without() -> None:
    record = read(OLD / "baseline.json", RECORDS["baseline-1"])
    chosen = msgspec.structs.replace(record, settings={"arithmetic": "numpy", "noise": {"bridge_gaps": False}})
    assert baseline.from_document(chosen).settings == Settings(noise=Noise(bridge_gaps=False))


def test_the_published_schemas_are_those_of_the_records() -> None:
    """In a process of its own, as they are written; all that differs is shown."""
    made = "import json, runpy; print(json.dumps(runpy.run_path('docs/site/schemas.py')['schema_files']()))"
    done = subprocess.run([sys.executable, "-c", made], cwd=PROJECT, capture_output=True, text=True, check=True)
    found, expected = {path.name: path.read_text() for path in SCHEMAS.iterdir()}, json.loads(done.stdout)
    assert found.keys() == expected.keys()
    for name, text in found.items():
        assert text.splitlines() == expected[name].splitlines(), f"{name}: python docs/site/schemas.py renews it"


# What the records check beyond their types: those are msgspec's, and tests/files has how it words them.
BROKEN: dict[str, list[tuple[Callable[[Document], object], str]]] = {
    "metrics.json": [
        (lambda d: d["runs"][1]["metrics"].pop("ate_se3_m"), "runs[1]: metrics.ate_se3_m is missing"),
        (lambda d: d["runs"][1]["notes"].clear(), "is null, and notes does not say why"),
    ],
    "report.json": [
        (lambda d: d["runs"][0]["nees"]["pose"].pop(), "runs[0].nees: pose has 11 entries, t_s has 12"),
        (lambda d: d["steps"][0]["t_s"].pop(), "steps[0]: step_ms has 12 entries, t_s has 11"),
    ],
    "seeds.json": [
        (lambda d: d["runs"][0].update(counts={}), "counts does not count status"),
        (lambda d: d["runs"][0]["metrics"].pop("ate_se3_m"), "metrics.ate_se3_m is missing"),
        (lambda d: d["runs"][0]["metrics"]["ate_none_m"]["values"].pop(), "metrics.ate_none_m.values"),
        (lambda d: d["runs"][0]["metrics"]["ate_none_m"].update(std=None), "n, mean and std are not those of"),
        (lambda d: d["runs"][0]["notes"].clear(), "has no value, and notes does not say why"),
        (lambda d: d["hashes"].pop(), "hashes does not have an entry a seed, or status of a run"),
    ],
    "check.json": [
        (lambda d: d.update(passed=False), "the document: passed does not fit failures"),
        (lambda d: d.update(failures=1), "the document: failures does not count the verdicts that fail"),
        (lambda d: d["verdicts"][0].update(fails=True), "verdicts[0]: fails does not fit the finding 'same'"),
    ],
}


@pytest.mark.parametrize(("name", "spoil", "wanted"), [(name, *row) for name, rows in BROKEN.items() for row in rows])
def test_a_broken_document_is_refused_with_the_place(
    name: str, spoil: Callable[[Document], object], wanted: str
) -> None:
    document = old(name)
    spoil(document)
    assert wanted in refused(name, document)


@pytest.mark.parametrize(
    ("values", "mark", "words"),
    [
        (
            {"nees_pose_mean": 0.1},
            ("timid", "nees_pose_mean", 0.1, pytest.approx((1.2373 / 6, 14.4494 / 6), rel=1e-4)),
            ("timid", "steady", "NEES", "0.100", "2.41"),
        ),
        (
            {"correction_trend": 5.25, "correction_trend_limit": 4.0, "nees_pose_mean": 1.0},
            ("contradicted", "correction_trend", 5.25, (0.0, 4.0)),
            ("contradicted", "steady", "trend 5.2", "limit 4.00", "check calibration"),
        ),
        ({"gate_accepted_percent": 55.0}, None, ("outlier gate", "steady 45 %", "calibration")),
        ({"gate_accepted_percent": 91.0}, None, ()),
    ],
)
def test_a_doubt_is_in_the_document_and_in_a_note_with_its_figures(
    comparison: Comparison, values: dict[str, float], mark: tuple[object, ...] | None, words: tuple[str, ...]
) -> None:
    doubted = rescored(comparison, lambda row: Scores(row.scores.values | values, {}))
    first, *_, failed = metrics_document(doubted).runs
    assert mark is None or msgspec.structs.astuple(first.consistency) == mark
    assert failed.consistency is msgspec.UNSET  # without an answer
    notes = [line for line in note_lines(doubted) if line.startswith(("timid", "contradicted", "the outlier gate"))]
    assert [all(word in line for word in words) for line in notes[:1]] == ([True] if words else [])


def test_who_explains_withheld_tracks_worse_than_the_motion_is_named(comparison: Comparison) -> None:
    harm = "explains withheld tracks worse than dead reckoning, with 3.00 +- 0.10 times its error"

    def given(row: Row) -> Scores:
        is_first = row.estimator == comparison.lines[0].estimator
        found = {"heldout_over_motion": 3.0 if is_first else 0.9}
        return Scores(row.scores.values | found, {"heldout_over_motion": harm} if is_first else {})

    reported = [line for line in note_lines(rescored(comparison, given)) if "withheld tracks worse" in line]
    assert reported == [f"{comparison.lines[0].estimator} {harm}"]


def test_a_value_that_is_not_finite_becomes_null_with_a_note(comparison: Comparison) -> None:
    scores = Scores(dict.fromkeys(describe(), float("nan")), {})
    built = metrics_document(rescored(comparison, lambda _: scores))
    assert parse(to_text(built), MetricsDocument) == built
    assert built.runs[0].metrics["ate_se3_m"] is None


def build(comparison: Comparison) -> Document:
    document: Document = to_builtins(report_document(comparison))
    return document


def run_of(document: Document, estimator: str, output: str = "causal") -> Document:
    runs = document["runs"]
    return next(run for run in runs if (run["estimator"], run["output"]) == (estimator, output))


def test_errors_are_those_from_the_start_that_the_nees_takes_and_components_stand_with_the_causal_entry(
    comparison: Comparison,
) -> None:
    document = build(comparison)
    run, row = run_of(document, "late", "final"), comparison.rows[-2]
    assert row.estimator == "late"
    expected_m = body_errors(Evaluation(row.run, "final", comparison.sequence)).distance_m
    np.testing.assert_allclose(run["errors"]["position_m"], expected_m, rtol=1e-5, atol=1e-9)
    path_m = run["errors"]["path_m"]
    assert np.all(np.diff(path_m) >= 0.0)
    assert path_m[0] == 0.0
    assert run_of(document, "steady")["components"] == to_builtins(components(comparison, comparison.rows[0]))
    assert "components" not in run_of(document, "steady", "final")
