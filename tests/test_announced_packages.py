"""Metrics and datasets of another distribution are found where it announces its packages, with no list of names."""

import sys
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from toolkit import datasets, discovery, metrics
from toolkit.errors import DataError, VislamError

METRIC = """'''A metric of another project.'''

from toolkit.metrics import Metric, Scores

ORDER = 99
METRICS = (Metric("answer", "the answer (1)", "1", ("the", "answer"), in_contract=True),)


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


def test_a_metric_of_another_package_is_known_and_the_contract_stays(announce: Announce) -> None:
    own = metrics.contract_keys()
    announce(metrics.ENTRY_POINT_GROUP, {"answers.py": METRIC, "_part.py": "raise RuntimeError"})
    assert list(metrics.describe())[-1] == "answer"
    assert metrics.contract_keys() == own


def test_a_dataset_of_another_package_is_read(announce: Announce, tmp_path: Path) -> None:
    announce(datasets.ENTRY_POINT_GROUP, {"their_format.py": DATASET, "more.py": "BUILT_IN = {'theirs': str}\n"})
    assert datasets.formats()["their-format"] == "A format of another project."
    assert "theirs" in datasets.built_in_names()
    (tmp_path / "recording").write_text("theirs, all of it")
    assert datasets.load_sequence(str(tmp_path / "recording")).name == "loaded recording"


def test_a_missing_dependency_makes_one_metric_file_unavailable(announce: Announce) -> None:
    announce(metrics.ENTRY_POINT_GROUP, {"answers.py": METRIC, "needy_one.py": "import a_package_nobody_has.part\n"})
    assert metrics.unavailable() == {"needy-one": "it needs the package a_package_nobody_has"}
    assert "answer" in metrics.describe()


def test_a_missing_dependency_makes_one_dataset_unavailable(announce: Announce, tmp_path: Path) -> None:
    announce(datasets.ENTRY_POINT_GROUP, {"needy.py": "import a_package_nobody_has\n"})
    assert datasets.unavailable() == {"needy": "it needs the package a_package_nobody_has"}
    (tmp_path / "recording").write_text("of nobody")
    with pytest.raises(DataError, match=r"no known format.*; needy is unavailable: it needs the package a_package_nob"):
        datasets.load_sequence(str(tmp_path / "recording"))


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("import their_metrics.prats", ModuleNotFoundError),
        ("from toolkit.geometri import se3", ModuleNotFoundError),
        ("from toolkit.geometry import se4", ImportError),
        ("ORDER = ordre", NameError),
    ],
)
@pytest.mark.parametrize("group", [metrics.ENTRY_POINT_GROUP, datasets.ENTRY_POINT_GROUP])
def test_a_typo_still_fails(announce: Announce, group: str, line: str, error: type[Exception]) -> None:
    announce(group, {"typo.py": line.replace("their_metrics", f"their_{group.rpartition('.')[2]}")})
    found = {metrics.ENTRY_POINT_GROUP: metrics.describe, datasets.ENTRY_POINT_GROUP: datasets.formats}[group]
    with pytest.raises(error):
        found()


def test_an_entry_point_to_nowhere_is_refused(monkeypatch: pytest.MonkeyPatch, announce: Announce) -> None:
    point = EntryPoint("gone", "gone_package.parts", "any")
    monkeypatch.setattr(discovery, "entry_points", lambda group: [point])
    for found in (metrics.describe, datasets.formats):
        with pytest.raises(VislamError, match=r"names gone_package.parts, which is not a package"):
            found()


def test_a_module_that_is_no_dataset_says_what_it_lacks(announce: Announce) -> None:
    announce(datasets.ENTRY_POINT_GROUP, {"empty.py": ""})
    with pytest.raises(DataError, match=r"empty.py: defines neither recognises\(path\) and load\(path\) nor BUILT_IN"):
        datasets.formats()


def test_two_datasets_cannot_share_a_name(announce: Announce) -> None:
    announce(datasets.ENTRY_POINT_GROUP, {"course_npz.py": DATASET})
    with pytest.raises(DataError, match="two dataset modules are called course-npz"):
        datasets.formats()
