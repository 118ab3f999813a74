"""What a check writes is well-formed, complete and says the same everywhere."""

import json
from dataclasses import replace
from xml.etree import ElementTree

import pytest
from msgspec import structs

from tests.gate.conftest import as_measured, checked, edited, planted
from toolkit.report.gate import BEGINNINGS, WRITERS, gate_markdown, gate_text, write_check
from toolkit.report.records import read_check


@pytest.fixture
def failed(baseline):
    """A check with a regression, a missing estimator whose reason would break a table, and an improvement."""
    simulated, recorded = as_measured(baseline)
    worse = edited(simulated, planted(8.0, 1))
    runs = {name: one for name, one in recorded.runs.items() if name != "three"}
    slower = structs.replace(worse.runs["one"], speed=tuple(0.5 * s for s in worse.runs["one"].speed))
    now = [
        replace(worse, runs=worse.runs | {"one": slower}),
        replace(recorded, runs=runs, absent={"three": "it needs <a | b> &\nmore"}),
    ]
    return checked(baseline, now)


@pytest.fixture
def passed(baseline):
    return checked(baseline, as_measured(baseline))


@pytest.fixture(params=["failed", "passed"])
def check(request):
    return request.getfixturevalue(request.param)


def test_junit_parses_and_counts_right(check, tmp_path):
    write_check(check, {"junit": tmp_path / "gate.xml"})
    root = ElementTree.parse(tmp_path / "gate.xml").getroot()
    cases = root.findall("./testsuite/testcase")
    assert int(root.get("tests")) == len(cases) == len(check.verdicts)
    assert int(root.get("failures")) == len(root.findall(".//failure")) == len(check.failing)
    for suite in root:
        assert int(suite.get("tests")) == len(suite.findall("testcase"))
        assert int(suite.get("failures")) == len(suite.findall("testcase/failure"))
    names = [(case.get("classname"), case.get("name")) for case in cases]
    assert len(set(names)) == len(names)


def test_json_has_every_verdict_and_no_number_that_is_none(check, tmp_path):
    write_check(check, {"json": tmp_path / "deep" / "gate.json"})
    document = json.loads((tmp_path / "deep" / "gate.json").read_text(), parse_constant=pytest.fail)
    assert read_check(tmp_path / "deep" / "gate.json") == check
    assert document["schema"] == "vislam.check/2"
    assert document["passed"] is check.passed
    assert document["failures"] == len(check.failing)
    assert [v["fails"] for v in document["verdicts"]] == [v.fails for v in check.verdicts]
    assert document["tests"] == sum(v["p"] is not None for v in document["verdicts"])


def test_the_table_has_what_fails_and_all_with_verbose(check):
    for verbose, shown in ((False, check.failing), (True, check.verdicts)):
        table = gate_text(check, verbose=verbose).split("\n\n")[0].splitlines()
        found = [line.split()[0] for line in table if line.startswith("  ") and not line.startswith("  ---")]
        assert found[2:] == [verdict.metric for verdict in shown] if shown else table[0].startswith("notes")


def test_no_name_in_the_table_is_folded_nor_wider_than_100_columns(failed):
    names = {"sequence": "a-recording-of-a-long-name/part.2", "metric": "heldout_reproj_median_px"}
    verdicts = [
        structs.replace(v, **names, output="causal", before=0.00012345, after=123456.7) for v in failed.verdicts
    ]
    table = gate_text(structs.replace(failed, verdicts=tuple(verdicts)), verbose=True).split("\n\n")[0].splitlines()
    assert sum(names["metric"] in line for line in table) == len(verdicts)
    assert {line for line in table if names["sequence"] in line} == {
        f"{names['sequence']}, {v.estimator} causal" for v in failed.verdicts
    }
    assert max(map(len, table)) <= 100


def test_every_kind_of_file_begins_as_it_is_set_to_and_markdown_tables_are_well_formed(check):
    text = gate_markdown(check)
    assert BEGINNINGS.keys() == WRITERS.keys()
    assert all(write(check).startswith(BEGINNINGS[kind]) for kind, write in WRITERS.items())
    tables = [part.splitlines() for part in text.split("\n\n") if part.startswith("|")]
    assert len(tables) == (1 if check.passed else 2)
    for table in tables:
        assert len({line.count("|") for line in table}) == 1
        assert all(set(cell.strip()) <= set(":-") for cell in table[1].strip("|").split("|"))
    assert len(tables[-1]) == 2 + len(check.verdicts)
    assert text.count("<details>") == text.count("</details>") == 1
