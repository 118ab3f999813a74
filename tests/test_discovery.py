"""Finding estimators: by the files of an announced package, with no list of names and no re-install."""

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from toolkit import discovery
from toolkit.discovery import FoundModule
from toolkit.errors import EstimatorError, ExtensionError
from toolkit.registry import ENTRY_POINT_GROUP, LADDER, RULES, EstimatorEntry, discover, find, find_all, ladder
from toolkit.settings import DEFAULTS

PACKAGE = "temporary_estimators"


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty package that an entry point announces, as an installed distribution would."""
    folder = tmp_path / PACKAGE
    folder.mkdir()
    (folder / "__init__.py").write_text('"""Somebody\'s estimators."""\n')
    monkeypatch.syspath_prepend(str(tmp_path))
    point = EntryPoint(PACKAGE, PACKAGE, ENTRY_POINT_GROUP)
    monkeypatch.setattr(discovery, "entry_points", lambda group: [point] if group == ENTRY_POINT_GROUP else [])
    yield folder
    for module in [m for m in sys.modules if m.partition(".")[0] == PACKAGE]:
        del sys.modules[module]


def write(package: Path, file: str, body: str) -> None:
    (package / file).write_text(f'"""Stands still and says so."""\n\n{body}\n')


def test_the_projects_own_estimators_are_found():
    assert {"batch", "dead-reckoning", "ekf", "mapping", "seed-ekf"} <= discover().keys()
    rungs = ladder()
    assert len({entry.rung() for entry in rungs}) == len(rungs) > 2
    assert all(entry.change() for entry in rungs)


def test_a_new_file_is_a_new_estimator(package):
    (package / "parts").mkdir()  # folders and private files are parts, not estimators
    (package / "parts" / "__init__.py").write_text("")
    write(package, "_helper.py", "")
    assert discover() == {}
    write(package, "my_new_filter.py", "def build(setup):\n    return setup")
    assert list(discover()) == ["my-new-filter"]
    entry = find("my-new-filter")
    assert entry.summary() == "Stands still and says so."
    assert entry.load()("a setup") == "a setup"


def test_discovery_and_summaries_import_nothing(package):
    write(package, "explosive.py", "raise RuntimeError('imported')")
    assert find("explosive").summary() == "Stands still and says so."
    assert f"{PACKAGE}.explosive" not in sys.modules


def test_several_packages_are_found_together(package, tmp_path, monkeypatch):
    other = tmp_path / "other_estimators"
    other.mkdir()
    (other / "__init__.py").write_text("")
    write(package, "zebra.py", "build = print")
    (other / "ant.py").write_text("")
    points = [EntryPoint(name, name, ENTRY_POINT_GROUP) for name in (PACKAGE, "other_estimators")]
    monkeypatch.setattr(discovery, "entry_points", lambda group: points)
    assert list(discover()) == ["ant", "zebra"]


def test_a_missing_optional_dependency_makes_one_estimator_unavailable(package):
    write(package, "needy.py", "import a_package_nobody_has.part\n\ndef build(setup): ...")
    write(package, "modest.py", "def build(setup): ...")
    write(package, "empty.py", "")
    with pytest.raises(EstimatorError, match=r"empty.py defines no function build\(setup\)"):
        find("empty").load()
    with pytest.raises(EstimatorError, match="needy is unavailable: it needs the package a_package_nobody_has"):
        find("needy").load()
    assert callable(find("modest").load())


@pytest.mark.parametrize(
    ("body", "error"),
    [
        (f"import {PACKAGE}.prats", ModuleNotFoundError),
        ("from toolkit.geometri import se3", ModuleNotFoundError),
        ("from toolkit.geometry import se4", ImportError),
        ("buildd = setupp", NameError),
        ("def build(setup)\n    return 1", SyntaxError),
    ],
    ids=["own package", "toolkit module", "toolkit name", "name", "syntax"],
)
def test_a_typo_still_fails(package, body, error):
    """It must not pass for a missing dependency: the run would go on without the estimator."""
    write(package, "typo.py", body) if error is not SyntaxError else (package / "typo.py").write_text(body)
    with pytest.raises(error):
        find("typo").load()


def test_the_ladder_is_every_estimator_with_a_rung_in_their_order(package):
    write(package, "aaa.py", 'RUNG, CHANGE = 20, "+ the future"')
    write(package, "bbb.py", 'RUNG: int = 10\nCHANGE = "the past"')
    write(package, "ccc.py", "raise RuntimeError('imported')")
    assert [(entry.name, entry.rung(), entry.change()) for entry in ladder()] == [
        ("bbb", 10, "the past"),
        ("aaa", 20, "+ the future"),
    ]
    assert find("ccc").rung() is None
    assert find("ccc").change() == ""
    assert list(find_all(["ccc", LADDER, "aaa"])) == ["ccc", "bbb", "aaa"]
    with pytest.raises(EstimatorError, match="no estimator is called ddd"):
        find_all([LADDER, "ddd"])


def test_a_module_says_which_common_rules_it_treats_otherwise(package):
    write(package, "says.py", 'RULES = {"window": "it keeps all"}')
    write(package, "silent.py", "")
    write(package, "parts.py", 'RULES = {"window": ("imu",)}')
    says, silent, parts = find("says"), find("silent"), find("parts")
    assert parts.obeys("window", "imu")
    assert not parts.obeys("window", "twist")
    assert not parts.obeys("window")
    assert {rule for rule in RULES if says.obeys(rule)} == {"outliers"}
    assert says.ignores() == {"window": "it keeps all"}
    assert {rule for rule in RULES if silent.obeys(rule)} == {"outliers", "window"}
    assert not silent.ignores()


@pytest.mark.parametrize(
    "rules",
    ['{"windw": "it keeps all"}', '{"window": False}', '{"window": ""}', '{"window": ("car",)}', '("window",)'],
)
def test_a_rule_that_is_unknown_or_goes_without_a_reason_is_refused(package, rules):
    write(package, "odd.py", f"RULES = {rules}\n\ndef build(setup): ...")
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
        ("RUNG: int = 7", 7, ""),
        ('"""RUNG = 3"""\nother = 4', None, ""),
        ("import no_such_package\nRUNG = 1\nRUNG = 2", 2, ""),
        ('RUNG = "high"\ndef f():\n    CHANGE = "x"', None, ""),
    ],
)
def test_a_rung_is_read_without_importing(tmp_path: Path, source: str, rung: int | None, change: str) -> None:
    path = tmp_path / "one.py"
    path.write_text(source)
    entry = EstimatorEntry("one", FoundModule("nowhere.one", path))
    assert (entry.rung(), entry.change()) == (rung, change)
