"""Estimators, metrics and datasets are found by the files of an announced package, with no list of names."""

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
from toolkit.errors import DataError, EstimatorError, ExtensionError, VislamError
from toolkit.registry import ENTRY_POINT_GROUP, LADDER, RULES, discover, find, find_all, ladder
from toolkit.settings import DEFAULTS
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

    def installed(group: str, files: dict[str, str], package: str = "") -> None:
        package = package or f"their_{group.rpartition('.')[2]}"
        (tmp_path / package).mkdir(exist_ok=True)
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


@pytest.fixture
def write(announce: Announce) -> Callable[[str, str], None]:
    """Return a function that writes an estimator's file, with a docstring, into an announced package."""
    return lambda file, body: announce(ENTRY_POINT_GROUP, {file: f'"""Stands still and says so."""\n\n{body}\n'})


def test_the_projects_own_estimators_are_found():
    assert {"batch", "dead-reckoning", "ekf", "mapping", "seed-ekf"} <= discover().keys()
    rungs = ladder()
    assert len({entry.rung() for entry in rungs}) == len(rungs) > 2
    assert all(entry.change() for entry in rungs)


def test_a_new_file_is_a_new_estimator_and_none_is_imported_to_find_it(write, announce, tmp_path):
    write("_helper.py", "")
    parts = tmp_path / "their_estimators" / "parts"  # folders and private files are parts, not estimators
    parts.mkdir()
    (parts / "__init__.py").write_text("")
    assert discover() == {}
    write("my_new_filter.py", "def build(setup):\n    return setup")
    write("explosive.py", "raise RuntimeError('imported')")
    announce(ENTRY_POINT_GROUP, {"ant.py": ""}, "their_others")
    assert list(discover()) == ["ant", "explosive", "my-new-filter"]
    assert find("explosive").summary() == "Stands still and says so."
    assert "their_estimators.explosive" not in sys.modules
    entry = find("my-new-filter")
    assert entry.summary() == "Stands still and says so."
    assert entry.load()("a setup") == "a setup"


@pytest.mark.parametrize(
    ("body", "error"),
    [
        ("import their_estimators.prats", ModuleNotFoundError),
        ("from toolkit.geometri import se3", ModuleNotFoundError),
        ("from toolkit.geometry import se4", ImportError),
        ("buildd = setupp", NameError),
        ("def build(setup)\n    return 1", SyntaxError),
    ],
    ids=["own package", "toolkit module", "toolkit name", "name", "syntax"],
)
def test_a_typo_still_fails(write, body, error):
    """It must not pass for a missing dependency: the run would go on without the estimator."""
    write("typo.py", body)
    with pytest.raises(error):
        find("typo").load()


def test_a_module_says_which_common_rules_it_treats_otherwise(write):
    write("says.py", 'RULES = {"window": "it keeps all"}')
    write("silent.py", "")
    write("parts.py", 'RULES = {"window": ("imu",)}')
    says, silent, parts = find("says"), find("silent"), find("parts")
    assert parts.obeys("window", "imu")
    assert not parts.obeys("window", "twist")
    assert not parts.obeys("window")
    assert {rule for rule in RULES if says.obeys(rule)} == {"outliers"}
    assert says.ignores() == {"window": "it keeps all"}
    assert {rule for rule in RULES if silent.obeys(rule)} == {"outliers", "window"}
    assert not silent.ignores()


@pytest.mark.parametrize(
    "rules", ['{"windw": "it keeps all"}', '{"window": False}', '{"window": ""}', '{"window": ("car",)}', '("window",)']
)
def test_a_rule_that_is_unknown_or_goes_without_a_reason_is_refused(write, rules):
    write("odd.py", f"RULES = {rules}\n\ndef build(setup): ...")
    with pytest.raises(EstimatorError, match=r"odd: in odd.py RULES has to map some of outliers, .* to True"):
        find("odd").check_usable(DEFAULTS)


def test_an_entry_point_to_nowhere_is_reported(monkeypatch):
    point = EntryPoint("gone", "gone_package", ENTRY_POINT_GROUP)
    monkeypatch.setattr(discovery, "entry_points", lambda group: [point])
    with pytest.raises(ExtensionError, match="names gone_package, which is not a package"):
        discover()


@pytest.mark.parametrize(
    ("source", "rung", "change"),
    [
        ('RUNG, CHANGE = 30, "+ more"', 30, "+ more"),
        ('RUNG = 30\nCHANGE: str = "+ more"', 30, "+ more"),
        ('"""RUNG = 3"""\nother = 4', None, ""),
        ("import no_such_package\nRUNG = 1\nRUNG: int = 2", 2, ""),
        ('RUNG = "high"\ndef f():\n    CHANGE = "x"', None, ""),
    ],
)
def test_the_ladder_is_every_estimator_with_a_rung_read_without_importing(write, source, rung, change) -> None:
    write("lowest.py", "RUNG = 1")
    write("one.py", source)
    assert (find("one").rung(), find("one").change()) == (rung, change)
    rungs = ["lowest"] + ["one"] * (rung is not None)
    assert list(find_all([LADDER, "lowest"])) == rungs
    assert [entry.name for entry in ladder()] == rungs
    with pytest.raises(EstimatorError, match="no estimator is called ddd"):
        find_all([LADDER, "ddd"])


def test_a_dataset_of_another_package_is_read(announce: Announce, tmp_path: Path) -> None:
    announce(datasets.ENTRY_POINT_GROUP, {"their_format.py": DATASET, "more.py": "BUILT_IN = {'theirs': str}\n"})
    assert datasets.formats()["their-format"] == "A format of another project."
    assert "theirs" in datasets.built_in_names()
    (tmp_path / "recording").write_text("theirs, all of it")
    assert datasets.load_sequence(str(tmp_path / "recording")).name == "loaded recording"


def scored() -> metrics.Scores:
    sequence = simulate(replace(DRIVE, duration_s=0.5), 0)
    run = runner.run("dead-reckoning", dead_reckoning.build, sequence, sequence.prior)
    return metrics.score_run(run, "causal", sequence)


def test_a_missing_dependency_makes_one_file_unavailable(announce: Announce, tmp_path: Path) -> None:
    announce(
        metrics.ENTRY_POINT_GROUP, {"answers.py": METRIC, "needy.py": f"import a_package_nobody_has.part\n{METRIC}"}
    )
    announce(datasets.ENTRY_POINT_GROUP, {"needy.py": "import a_package_nobody_has\n"})
    announce(ENTRY_POINT_GROUP, {"needy.py": "import a_package_nobody_has\n", "modest.py": "def build(setup): ...\n"})
    lacking = {"needy": "it needs the package a_package_nobody_has"}
    assert metrics.unavailable() == datasets.unavailable() == lacking
    assert list(metrics.describe())[-1] == "answer"
    assert scored().values["answer"] == 42.0
    for asked in (lambda: metrics.metrics_called(["needy"]), find("needy").load):
        with pytest.raises(VislamError, match="needy is unavailable: it needs the package a_package_nobody_has"):
            asked()
    assert callable(find("modest").load())
    (tmp_path / "recording").write_text("of nobody")
    with pytest.raises(DataError, match=r"no known format.*; needy is unavailable: it needs the package a_package_nob"):
        datasets.load_sequence(str(tmp_path / "recording"))


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
        (METRIC.replace('"answer"', '"pairs"'), "answer.py: both declare pairs; rename it in one"),
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
    with pytest.raises(ExtensionError, match=r"answer\.py: score must return Scores of \['answer'\], and returned"):
        scored()


def test_a_loader_that_answers_with_no_sequence_is_named(announce: Announce, tmp_path: Path) -> None:
    announce(
        "toolkit.datasets",
        {"theirs.py": DATASET.replace("return replace(", "return str(").replace(", name=", ") or (")},
    )
    (tmp_path / "some.file").write_text("theirs")
    with pytest.raises(ExtensionError, match=r"theirs\.py returned a str; it must return a Sequence"):
        datasets.load_sequence(str(tmp_path / "some.file"))


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        ("replace(drawn, name=3)", "a recording: its name is of type int, expected str"),
        ("replace(drawn, observations=None)", "drive: its observations is of type NoneType, expected Observations"),
        ("replace(drawn, provenance='x')", "drive: its provenance is of type str"),
        ("replace(drawn, rig=replace(drawn.rig, fx_px=None))", "drive: its rig.fx_px is of type NoneType"),
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
