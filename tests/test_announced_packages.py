"""Metrics and datasets of another distribution are found where it announces its packages, with no list of names."""

import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from filters import dead_reckoning
from toolkit import datasets, discovery, metrics, runner
from toolkit.cli import main
from toolkit.errors import DataError, ExtensionError, VislamError
from toolkit.registry import find
from toolkit.simulation import DRIVE, simulate

METRIC = """'''A metric of another project.'''

from toolkit.metrics import Metric, Scores

ORDER = 99
METRICS = (Metric("answer", "the answer (1)", "1", ("the", "answer")),)


def score(evaluation):
    return Scores({"answer": 42.0})
"""
DATASET = """'''A format of another project.'''


def recognises(path):
    return path.read_text().startswith("theirs")


def load(path):
    from dataclasses import replace

    from toolkit.simulation import DRIVE, simulate

    return replace(simulate(replace(DRIVE, duration_s=1.0), 0), name=f"loaded {path.name}")
"""

Announce = Callable[[str, dict[str, str]], None]


@pytest.fixture
def announce(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Announce]:
    """Return a function that installs a package of given files and announces it under a group."""
    points: list[EntryPoint] = []

    def installed(group: str, files: dict[str, str]) -> None:
        package = f"their_{group.rpartition('.')[2]}"
        (tmp_path / package).mkdir()
        for name, text in ({"__init__.py": ""} | files).items():
            (tmp_path / package / name).write_text(text)
        points.append(EntryPoint(package, package, group))

    def forget() -> None:
        metrics._found.cache_clear()
        datasets._found.cache_clear()

    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(discovery, "entry_points", lambda group: [p for p in points if p.group == group])
    forget()
    yield installed
    forget()
    for module in [m for m in sys.modules if m.startswith("their_")]:
        del sys.modules[module]


def test_a_metric_of_another_package_is_known(announce: Announce) -> None:
    announce(metrics.ENTRY_POINT_GROUP, {"answers.py": METRIC, "_part.py": "raise RuntimeError"})
    assert list(metrics.describe())[-1] == "answer"


def test_a_dataset_of_another_package_is_read(announce: Announce, tmp_path: Path) -> None:
    announce(datasets.ENTRY_POINT_GROUP, {"their_format.py": DATASET, "more.py": "BUILT_IN = {'theirs': str}\n"})
    assert datasets.formats()["their-format"] == "A format of another project."
    assert "theirs" in datasets.built_in_names()
    (tmp_path / "recording").write_text("theirs, all of it")
    assert datasets.load_sequence(str(tmp_path / "recording")).name == "loaded recording"


def test_a_missing_dependency_makes_one_file_unavailable(announce: Announce, tmp_path: Path) -> None:
    announce(
        metrics.ENTRY_POINT_GROUP, {"answers.py": METRIC, "needy.py": f"import a_package_nobody_has.part\n{METRIC}"}
    )
    announce(datasets.ENTRY_POINT_GROUP, {"needy.py": "import a_package_nobody_has\n"})
    lacking = {"needy": "it needs the package a_package_nobody_has"}
    assert metrics.unavailable() == datasets.unavailable() == lacking
    assert "answer" in metrics.describe()
    (tmp_path / "recording").write_text("of nobody")
    with pytest.raises(DataError, match=r"no known format.*; needy is unavailable: it needs the package a_package_nob"):
        datasets.load_sequence(str(tmp_path / "recording"))


def test_a_metric_that_is_unavailable_is_named_where_it_is_requested(announce: Announce) -> None:
    announce("toolkit.metrics", {"answer.py": f"import no_such_package\n{METRIC}"})
    with pytest.raises(VislamError, match="answer is unavailable: it needs the package no_such_package"):
        metrics.metrics_called(["answer"])


@pytest.mark.parametrize(
    ("file", "text", "why"),
    [
        ("empty.py", "", "empty.py: defines neither recognises(path) and load(path) nor BUILT_IN"),
        ("their_world.py", "BUILT_IN = {'drive': lambda seed: None}\n", "both offer the sequence drive; rename one"),
        ("course_npz.py", DATASET, "two dataset modules are called course-npz"),
    ],
)
def test_a_module_that_is_no_dataset_is_named(announce: Announce, file: str, text: str, why: str) -> None:
    announce(datasets.ENTRY_POINT_GROUP, {file: text})
    with pytest.raises(ExtensionError, match=re.escape(why)):
        datasets.formats()
        datasets.built_ins()


def test_an_estimators_file_that_is_no_python_is_named_with_its_line(announce: Announce) -> None:
    announce("toolkit.estimators", {"broken.py": "import math\ndef (\n"})
    with pytest.raises(ExtensionError, match=r"broken\.py: line 2 is no Python \(invalid syntax\)"):
        find("broken").summary()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (METRIC.replace("ORDER", "ORDR"), "answer.py: a metric file defines METRICS, a tuple of Metric records, ORDER"),
        (METRIC.replace("),)", "))"), "a metric file defines METRICS, a tuple"),
        (METRIC.replace("def score", "def scored"), "a metric file defines METRICS"),
        (
            METRIC.replace('"answer")),)', '"answer"), best="bigger"),)'),
            "answer.py: the metric answer has best='bigger'; it is one of",
        ),
        (METRIC.replace('("the", "answer")', '"answer"'), "the metric answer has heading='answer'; it is two lines"),
    ],
)
def test_a_metric_file_that_is_none_is_named(
    announce: Announce, text: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is a defect of that file (70), whatever the command line asks for, and no wrong command line (2)."""
    announce("toolkit.metrics", {"answer.py": text})
    with pytest.raises(ExtensionError, match=re.escape(why)):
        metrics.known_metrics()
    for words in (
        ("compare", "drive", "--columns", "answer"),
        ("diff", "one", "two", "--columns", "all"),
        ("list", "metrics"),
    ):
        assert main(words) == 70
        assert why in capsys.readouterr().err


@pytest.mark.parametrize("answer", ['Scores({"other": 1.0})', '{"answer": 1.0}', "None"])
def test_a_metric_file_that_scores_otherwise_is_named(announce: Announce, answer: str) -> None:
    announce("toolkit.metrics", {"answer.py": METRIC.replace('Scores({"answer": 42.0})', answer)})
    sequence = simulate(replace(DRIVE, duration_s=0.5), 0)
    run = runner.run("dead-reckoning", dead_reckoning.build, sequence, sequence.prior)
    with pytest.raises(ExtensionError, match=r"answer\.py: score must return Scores of \['answer'\], and returned"):
        metrics.score_run(run, "causal", sequence)


def test_a_loader_that_answers_with_no_sequence_is_named(announce: Announce, tmp_path: Path) -> None:
    announce(
        "toolkit.datasets",
        {"theirs.py": DATASET.replace("return replace(", "return str(").replace(", name=", ") or (")},
    )
    (tmp_path / "some.file").write_text("theirs")
    with pytest.raises(ExtensionError, match=r"theirs\.py returned a str; it must return a Sequence"):
        datasets.load_sequence(str(tmp_path / "some.file"))


def test_a_defect_of_another_package_is_not_blamed_on_vislam(
    announce: Announce, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = DATASET.replace("    from dataclasses", "    1 / 0\n    from dataclasses")
    announce("toolkit.datasets", {"theirs.py": broken})
    (tmp_path / "some.file").write_text("theirs")
    assert main(["check-data", str(tmp_path / "some.file")]) == 70
    message = capsys.readouterr().err.splitlines()[-1]
    assert re.search(r"a defect of \S+theirs\.py, line 9, which another package brings \(ZeroDivisionError", message)
    assert "vislam itself" not in message


def test_a_defect_that_comes_back_from_another_process_keeps_its_place(announce: Announce, tmp_path: Path) -> None:
    announce("toolkit.datasets", {"theirs.py": DATASET})
    file = tmp_path / "their_datasets" / "theirs.py"
    error = ValueError("boom")
    error.__cause__ = RuntimeError(f'\n"""\nTraceback (most recent call last):\n  File "{file}", line 7, in load\n"""')
    assert discovery.line_of_another_package(error) == f"{file}, line 7"
    assert discovery.line_of_another_package(ValueError("boom")) == ""


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        ("replace(drawn, name=3)", "a recording: its name is of type int, expected str"),
        ("replace(drawn, observations=None)", "drive: its observations is of type NoneType, expected Observations"),
        ("replace(drawn, provenance='x')", "drive: its provenance is of type str"),
        (
            "replace(drawn, rig=replace(drawn.rig, fx_px=None))",
            "drive: its rig.fx_px is of type NoneType",
        ),
        ("replace(drawn, motion=replace(drawn.motion, v_mps=drawn.motion.v_mps[1:]))", "motion.v_mps has 10 rows, and"),
        ("replace(drawn, frames_t_ns=drawn.frames_t_ns[:3])", "is of frame 3, there are 3"),
    ],
)
def test_a_part_of_a_sequence_that_is_none_is_named(announce: Announce, tmp_path: Path, answer: str, why: str) -> None:
    drawn = "drawn = simulate(replace(DRIVE, duration_s=1.0), 0)\n    return "
    text = DATASET[: DATASET.index("return replace(")] + drawn + answer + "\n"
    announce("toolkit.datasets", {"theirs.py": text})
    (tmp_path / "some.file").write_text("theirs")
    with pytest.raises(DataError, match=re.escape(why)):
        datasets.load_sequence(str(tmp_path / "some.file"))
