"""An estimator in a file of one's own is compared, kept, gated and reported like an installed one."""

import json
from pathlib import Path

import pytest

import toolkit
from toolkit.cli import main
from toolkit.registry import find

PROJECT = Path(__file__).parents[2]
SHORT = ["--max-frames", "12", "--figures", "none"]


@pytest.fixture(autouse=True)
def my_filter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Dead reckoning as a file of one's own, which imports what stands beside it."""
    monkeypatch.chdir(tmp_path)
    text = (PROJECT / "filters/dead_reckoning.py").read_text()
    Path("beside_my_filter.py").write_text("FACTOR = 1\n")
    path = Path("my_filter.py")
    path.write_text(f"{text}\nfrom beside_my_filter import FACTOR\n")
    return path


def test_a_file_is_compared_beside_names_and_gives_what_its_code_gives(my_filter, capsys):
    for workers in ("1", "2"):
        words = ["compare", "drive", "--estimators", "dead-reckoning,my_filter.py", *SHORT, "--workers", workers]
        assert main([*words, "--json"]) == 0
        found = {run["estimator"]: run["metrics"]["ate_se3_m"] for run in json.loads(capsys.readouterr().out)["runs"]}
        assert found == dict.fromkeys(["dead-reckoning", "my-filter"], found["my-filter"])
    result = toolkit.compare("drive", ["dead-reckoning", "my_filter.py"], max_frames=12, workers=1)
    assert set(result.runs) == {"dead-reckoning", "my-filter"}
    entry = find("my_filter.py")
    my_filter.unlink()
    assert callable(entry.load())  # what was read runs, whatever becomes of the file


def test_over_seeds_runs_are_found_again_until_the_file_changes(my_filter, capsys):
    words = ["compare", "drive", "--estimators", "dead-reckoning,my_filter.py", *SHORT, "--seeds", "2", "--out", "over"]
    found = []
    for change in ("", "", "# another filter\n"):
        with my_filter.open("a") as file:
            file.write(change)
        assert main([*words, "--workers", "1"]) == 0
        said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("results:")]
        found.append(said[-1].partition(";")[0])
    assert found == [
        "results: over",
        "results: over (4 of 4 runs were there)",
        "results: over (2 of 4 runs were there)",
    ]


def test_a_baseline_of_a_file_is_checked_with_the_file(my_filter, capsys):
    made = ["baseline", "drive:1", "--estimators", "my_filter.py", "--seeds", "5", "--out", "base.json"]
    check = ["check", "--baseline", "base.json", "--workers", "1"]
    assert main([*made, "--workers", "1"]) == main(check) == 0
    my_filter.rename("other_filter.py")
    assert main(check) == 1
    assert "my_filter.py: there is no such file" in " ".join(capsys.readouterr().out.split())


def test_a_run_of_a_file_is_reproduced_from_the_file(my_filter, capsys):
    assert main(["compare", "drive", "--estimators", "my_filter.py", *SHORT, "--workers", "1", "--out", "run"]) == 0
    assert main(["export", "run", "--bundle", "run.zip"]) == main(["reproduce", "run.zip", "--workers", "1"]) == 0
    my_filter.unlink()
    assert main(["reproduce", "run.zip", "--workers", "1"]) == 5
    assert "my_filter.py: there is no such file" in capsys.readouterr().err


def test_a_file_whose_process_dies_is_a_run_that_failed_and_the_others_are_kept(capsys):
    Path("dies.py").write_text("import os\ndef build(setup): os._exit(7)\n")
    words = ["compare", "drive", "--estimators", "dies.py,dead-reckoning", *SHORT, "--workers", "2", "--out", "run"]
    assert main(words) == 1
    assert "dies failed: its process ended with status 7 before it answered" in capsys.readouterr().out
    ended = {run["estimator"]: run["status"] for run in json.loads(Path("run/metrics.json").read_text())["runs"]}
    assert ended == {"dies": "failed", "dead-reckoning": "ok"}
    assert main(["report", "run"]) == 0


@pytest.mark.parametrize(
    ("estimators", "text", "told"),
    [
        ("opts.py", "OPTIONS = {'a': 5}\ndef build(setup): ...\n", "OPTIONS has to be a tuple of names, or to map"),
        ("my_filter", "", "is given as its file, as in my_filter.py"),
        ("ekf.py", "def build(setup): ...\n", "give the file another name"),
        ("my_filter.py,deeper/my_filter.py", "def build(setup): ...\n", "give the file another name"),
    ],
)
def test_a_file_that_is_no_estimator_is_reported_in_one_line(capsys, estimators, text, told):
    Path("deeper").mkdir()
    if text:
        Path(estimators.rsplit(",", maxsplit=1)[-1]).write_text(text)
    assert main(["compare", "drive", "--estimators", estimators, *SHORT]) == 5
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert told in printed
