"""The two commands together, on short simulations: what ``vislam baseline`` writes, ``vislam check`` compares with."""

import json
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit.cli import main
from toolkit.gate.baseline import installed_releases

Vislam = Callable[..., int]
ONE_PROCESS = ("--workers", "1")
MAKE = ("baseline", "drive:1", "data-copy:4", "--estimators", "dead-reckoning,ekf", "--seeds", "5", *ONE_PROCESS)
PROJECT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The text of a baseline of a simulated and a recorded sequence."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("VISLAM_DATA", str(folder / "root"))
        (folder / "root").mkdir()
        (folder / "root/data-copy").symlink_to(PROJECT / "data/drive_small")
        assert main([*MAKE, "--out", str(folder / "base.json")]) == 0
    return (folder / "base.json").read_text()


@pytest.fixture
def vislam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made: str) -> Vislam:
    """Return a function that runs ``vislam`` beside the baseline, with the recording under VISLAM_DATA."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("VISLAM_DATA", str(tmp_path / "root"))
    Path("root").mkdir()
    Path("root/data-copy").symlink_to(PROJECT / "data/drive_small")
    Path("base.json").write_text(made)
    return lambda *words: main(words)


def changed(change: Callable[[dict], object]) -> None:
    document = json.loads(Path("base.json").read_text())
    change(document)
    Path("base.json").write_text(json.dumps(document))


CHECK = ("check", "--baseline", "base.json", "--skip-speed", *ONE_PROCESS)


def test_a_baseline_says_by_which_command_it_was_made_but_not_in_which_folder(made):
    assert json.loads(made)["made_by"]["command"] == f"vislam {shlex.join(MAKE)} --out base.json"


def test_the_same_code_passes_bit_for_bit(vislam, capsys):
    assert vislam(*CHECK, "--json", "check.json", "--junit", "check.xml", "--markdown", "check.md") == 0
    verdicts = json.loads(Path("check.json").read_text())["verdicts"]
    assert {v["sequence"] for v in verdicts} == {"drive", "data-copy"}
    assert all(v["before"] == v["after"] for v in verdicts)
    messages = capsys.readouterr()
    assert messages.err == ""
    assert "the gate passes" in messages.out
    assert {path.name for path in Path().iterdir()} == {"root", "base.json", "check.json", "check.xml", "check.md"}


def test_what_is_missing_is_1_and_named(vislam, capsys):
    def lose(document: dict) -> None:
        runs = document["sequences"][0]["runs"]
        runs["oracle"] = runs.pop("ekf")

    changed(lose)
    Path("root/data-copy").unlink()
    assert vislam(*CHECK) == 1
    messages = " ".join(capsys.readouterr().out.split())
    assert "drive, oracle: estimator is missing: no estimator is called oracle" in messages
    assert "data-copy: sequence is missing: data-copy: no such file or directory" in messages


def test_another_release_is_3_in_one_line_unless_allowed(vislam, capsys):
    changed(lambda document: document.update(releases=installed_releases() | {"gtsam": "4.2.0"}))
    assert vislam(*CHECK) == 3
    messages = capsys.readouterr().err
    assert messages.startswith("vislam: error: base.json: made with gtsam 4.2.0, here ")
    assert messages.count("\n") == 1
    assert vislam(*CHECK, "--allow-other-releases") == 0
