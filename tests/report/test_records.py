"""Every document that revision 0d93a31 wrote is read, to the byte; what breaks a contract is refused with its place."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest

from toolkit.errors import DataError
from toolkit.evaluation import against_baseline
from toolkit.files.documents import parse, read, to_line, to_text
from toolkit.gate import baseline_file
from toolkit.report.records import RECORDS, read_card, read_check, schema_files

Document = dict[str, Any]

# Written by the commands of revision 0d93a31 on `drive`: the hand-written predecessors of the records; the card by the
# first command that made one of its version.
OLD = Path(__file__).parent / "documents"
SCHEMAS = Path(__file__).parents[2] / "docs" / "schemas"
CASES = {
    "metrics.json": "metrics-1",
    "seeds.json": "seeds-1",
    "report.json": "report-1",
    "report-over-seeds.json": "report-over-seeds-1",
    "manifest.json": "manifest-1",
    "manifest-over-seeds.json": "manifest-1",
    "baseline.json": "baseline-1",
    "trajectory-baseline.json": "trajectory-baseline-1",
    "check.json": "check-2",
    "card.json": "card-2",
    "evaluation.json": "evaluation-1",
    "verification.json": "verification-1",
    "diff.json": "diff-1",
    "bundle.json": "bundle-1",
}


# Baselines are made to be reviewed, and laid out otherwise than other documents.
REVIEWED = {
    "baseline.json": lambda path: baseline_file.to_text(baseline_file.load_baseline(path)),
    "trajectory-baseline.json": lambda path: against_baseline.to_text(against_baseline.load_trajectory_baseline(path)),
}


OPTIONAL = {"references", "track_weight", "track_weight_error"}


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
    assert {path.name for path in OLD.iterdir()} == CASES.keys()
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


@pytest.mark.parametrize("name", CASES)
def test_a_document_without_any_one_of_its_fields_is_refused(name: str) -> None:
    for field in old(name).keys() - OPTIONAL:
        lacking = {key: value for key, value in old(name).items() if key != field}
        assert field in refused(name, lacking)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("document", [None, 3, [], {}, {"runs": [3]}, {"schema": 3}, "text"])
def test_what_is_no_document_is_reported(name: str, document: object) -> None:
    assert "has not the schema vislam." in refused(name, document)


def test_the_published_schemas_are_those_of_the_records() -> None:
    reported = "docs/schemas differs from the records: python -m toolkit.report.records docs/schemas renews it"
    assert {path.name: path.read_text() for path in SCHEMAS.iterdir()} == schema_files(), reported


def _second_run(document: Document) -> Document:
    run: Document = document["runs"][1]
    return run


@pytest.mark.parametrize(
    ("spoil", "wanted"),
    [
        (lambda d: _second_run(d)["metrics"].pop("ate_se3_m"), "runs[1]: metrics.ate_se3_m is missing"),
        (lambda d: _second_run(d)["notes"].clear(), "is null, and notes does not say why"),
        (
            lambda d: _second_run(d)["metrics"].update(ate_se3_m="0.2"),
            "runs[1].metrics.ate_se3_m: expected number or null, got string",
        ),
        (
            lambda d: _second_run(d)["metrics"].update(ate_se3_m=float("nan")),
            "runs[1].metrics.ate_se3_m: expected number or null, got NaN or infinity",
        ),
        (lambda d: d["sequence"].update(frames=True), "sequence.frames: expected integer, got true or false"),
        (lambda d: d["sequence"].update(frames=-1), "sequence.frames: expected integer >= 0"),
        (lambda d: _second_run(d).update(status="fine"), "runs[1].status: cannot be 'fine', only diverged, failed, ok"),
        (lambda d: d.update(schema="vislam.metrics/2"), "its schema is 'vislam.metrics/2'"),
        (lambda d: d["audit"].append({"fault": "gap", "count": 1, "repaired": True}), "audit[0]: lacks detail"),
        (lambda d: d.pop("runs"), "the document: lacks runs"),
    ],
)
def test_broken_metrics_are_refused_with_the_place(spoil: Callable[[Document], object], wanted: str) -> None:
    document = old("metrics.json")
    spoil(document)
    assert wanted in refused("metrics.json", document)


@pytest.mark.parametrize(
    ("spoil", "wanted"),
    [
        (lambda d: d["runs"][0]["nees"]["pose"].pop(), "runs[0].nees: pose has 11 entries, t_s has 12"),
        (lambda d: d["runs"][0]["rotation"].pop(), "runs[0].rotation: expected list of length 3, got 2"),
        (lambda d: d["steps"][0]["t_s"].pop(), "steps[0]: step_ms has 12 entries, t_s has 11"),
    ],
)
def test_a_broken_report_is_refused_with_the_place(spoil: Callable[[Document], object], wanted: str) -> None:
    document = old("report.json")
    spoil(document)
    assert wanted in refused("report.json", document)


@pytest.mark.parametrize(
    ("spoil", "wanted"),
    [
        (lambda d: d.update(passed=False), "the document: passed does not fit failures"),
        (lambda d: d.update(failures=1), "the document: failures does not count the verdicts that fail"),
        (lambda d: d["verdicts"][0].update(fails=True), "verdicts[0]: fails does not fit the finding 'same'"),
    ],
)
def test_a_broken_check_is_refused_with_the_place(spoil: Callable[[Document], object], wanted: str) -> None:
    document = old("check.json")
    spoil(document)
    assert wanted in refused("check.json", document)


@pytest.mark.parametrize("name", CASES)
def test_fields_of_a_later_version_are_passed_over(name: str) -> None:
    record = RECORDS[CASES[name]]
    later = {**old(name), "of a later version": {"a": [1]}}
    assert parse(json.dumps(later), record) == read(OLD / name, record)
