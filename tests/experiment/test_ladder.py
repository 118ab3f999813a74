"""The ladder: read from the files alone, in the order of the rungs."""

from pathlib import Path

import pytest

from toolkit.discovery import FoundModule
from toolkit.errors import EstimatorError
from toolkit.registry import EstimatorEntry, find_all, ladder


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


def test_the_ladder_is_in_the_order_of_its_rungs() -> None:
    rungs = [entry.rung() for entry in ladder()]
    assert len(rungs) >= 3
    assert rungs == sorted(set(rungs))


def test_every_rung_says_what_it_changes() -> None:
    assert all(entry.change() for entry in ladder())


def test_ladder_stands_for_every_rung_and_names_count_once() -> None:
    names = [entry.name for entry in ladder()]
    assert list(find_all(["ladder"])) == names
    assert list(find_all([names[-1], "ladder"])) == [names[-1], *names[:-1]]
    with pytest.raises(EstimatorError, match="oracle"):
        find_all(["ladder", "oracle"])
