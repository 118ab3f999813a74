"""What the subcommands do when all is well: what they write, where, and what they print."""

import csv
import io
import json
import re
from pathlib import Path

import pytest

from tests.report.test_html_report import embedded
from toolkit import audit
from toolkit.audit import Audit, Finding
from toolkit.cli import progress_display
from toolkit.experiment import recording
from toolkit.report.records import read_metrics, read_seeds

pytestmark = pytest.mark.usefixtures("unrendered")

# Nobody looks at the figures here: drawing them takes as long as all else.
QUICK = ("--estimators", "dead-reckoning", "--max-frames", "10", "--workers", "1", "--figures", "none")


def test_several_sequences_get_a_directory_each_and_take_the_place_of_an_earlier_run(vislam):
    for _ in range(2):
        assert vislam("compare", "drive", "drive-imu", "drive", *QUICK, "--out", "all") == 0
    assert sorted(path.name for path in Path("all").iterdir()) == ["drive", "drive-2", "drive-imu"]
    for path in Path("all").iterdir():
        assert read_metrics(path / "metrics.json").runs
    Path("file").touch()
    assert vislam("compare", "drive", "drive-imu", *QUICK, "--out", "file") == 4


@pytest.mark.parametrize("form", ["csv", "latex", "markdown"])
def test_a_table_is_printed_in_the_form_that_was_asked_for(vislam, capsys, form):
    for words in (("--quiet",), ("--format", form)):
        assert vislam("compare", "drive", *QUICK, *words) == 0
    assert len(list(Path("runs").iterdir())) == 2  # a new directory each time
    text = capsys.readouterr().out
    if form == "csv":
        (values,) = csv.DictReader(io.StringIO(text))
        assert [values[key] for key in ("estimator", "output", "runs", "ok")] == ["dead-reckoning", "both", "1", "1"]
        assert 0.0 < float(values["ate_se3_m"]) < 1.0
    else:
        assert ("dead-reckoning & both & ok" if form == "latex" else "| dead-reckoning | both") in " ".join(
            text.split()
        )
        assert "results:" not in text


def test_json_prints_the_document_and_quiet_nothing(vislam, capsys):
    assert vislam("compare", "drive", *QUICK, "--json", "--out", "run") == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert json.loads(line) == json.loads(Path("run/metrics.json").read_text())
    assert vislam("compare", "drive", *QUICK, "--quiet", "--out", "run") == 0
    assert capsys.readouterr().out == ""


def test_a_run_directory_over_seeds(vislam, capsys, monkeypatch):
    monkeypatch.setattr(progress_display, "LOG_EVERY_S", float("inf"))  # work that is soon done leaves no line
    words = ("--estimators", "dead-reckoning", "--max-frames", "10", "--seeds", "3", "--seed", "1", "--workers", "1")
    assert vislam("compare", "drive", *words, "--out", "run") == 0
    messages = capsys.readouterr()
    assert messages.err == ""
    assert "results: run;" in messages.out
    document = read_seeds(Path("run/seeds.json"))
    assert document.seeds == (1, 2, 3)
    assert len(set(document.hashes)) == 3
    manifest = json.loads(Path("run/manifest.json").read_text())
    assert manifest["seeds"] == {"sequence": 1, "count": 3}
    assert manifest["sequence"]["hash"] == document.hashes[0]
    figures = sorted(path.name for path in Path("run/figures").iterdir())
    assert figures == ["errors_over_seeds.png", "nees_over_seeds.png"]
    assert all(name in Path("run/report.md").read_text() for name in figures)


def test_several_runs_and_runs_over_seeds_make_one_page_beside_them(vislam):
    assert vislam("compare", "drive", "drive-imu", *QUICK, "--out", "all") == 0
    assert vislam("report", "all/drive", "all/drive-imu", "all/drive") == 0
    titles = [case["title"] for case in embedded(Path("report.html").read_text())["cases"]]
    assert titles == ["drive (all/drive)", "drive-imu", "drive (all/drive)"]
    assert vislam("report", "all") == 0
    assert [case["title"] for case in embedded(Path("all/report.html").read_text())["cases"]] == ["drive", "drive-imu"]
    assert vislam("compare", "drive", *QUICK, "--seeds", "2", "--out", "seeds") == 0
    assert vislam("report", "seeds", "all/drive", "--out", "pages/both.html") == 0
    assert [case["kind"] for case in embedded(Path("pages/both.html").read_text())["cases"]] == ["seeds", "run"]
    Path("all/drive/manifest.json").unlink()  # nothing is left out in silence
    assert vislam("report", "all") == 3


def test_list_counts_every_kind_and_names_all_of_one(vislam, capsys):
    assert vislam("list") == 0
    counts = re.findall(r"^ *(\d+) (\w+)", capsys.readouterr().out, flags=re.MULTILINE)
    listed = {kind: (vislam("list", kind), capsys.readouterr().out)[1] for _, kind in counts}
    for count, kind in counts:
        assert len(re.findall(r"^\S", listed[kind], flags=re.MULTILINE)) == int(count), kind
    names = {"estimators": ["dead-reckoning"], "sequences": ["kitti00", "drive"], "metrics": ["ate_se3_m"]}
    names |= {"faults": list(audit.faults()), "settings": ["window.lag_s"], "formats": ["euroc"]}
    for kind, some in names.items():
        assert {*some} <= {line.split()[0] for line in listed[kind].splitlines()}


@pytest.mark.parametrize(("repaired", "blocking", "status"), [(True, False, 0), (False, True, 1), (False, False, 0)])
def test_check_data_fails_on_a_fault_that_stays(vislam, capsys, monkeypatch, *, repaired, blocking, status):
    finding = Finding("time-gap", 2, repaired, "two frames are 3 s apart", blocking)
    monkeypatch.setattr(recording, "audit", lambda sequence, _keep: Audit(sequence, (finding,)))
    assert vislam("check-data", "drive") == status
    messages = capsys.readouterr().out
    assert "time-gap" in messages
    assert finding.detail in messages
    assert ("not repaired" in messages) == blocking


def test_check_data_says_what_was_done_to_read_the_recording(vislam, capsys):
    """Images that cannot be used are left out, and tracks simulated where there are none: no fault, and to be known."""
    assert vislam("simulate", "flight", "--images", "--duration", "0.4", "--out", "film") == 0
    sorted(Path("film/mav0/cam0/data").iterdir())[3].write_bytes(b"")
    vislam("check-data", "film")
    assert "1 of 9 image pairs could not be used and are left out" in " ".join(capsys.readouterr().out.split())


def test_keep_reaches_the_audit(vislam, monkeypatch):
    kept: list[frozenset[str]] = []
    first, second = list(audit.faults())[:2]

    def listening(sequence: object, keep: frozenset[str]) -> Audit:
        kept.append(keep)
        return Audit(sequence, ())

    monkeypatch.setattr(recording, "audit", listening)
    for words in ((), ("--no-repair",), ("--keep", f"{first},{second}")):
        vislam("check-data", "drive", *words)
    assert kept == [frozenset(), frozenset(audit.faults()), frozenset({first, second})]
