"""The command line run in this process, in an empty directory."""

from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit.cli import main

Vislam = Callable[..., int]
OneLine = Callable[[], str]


@pytest.fixture
def vislam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Vislam:
    """Return a function that runs ``vislam`` with the given words and returns its exit status."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str) -> int:
        try:
            return main(words)
        except SystemExit as left:  # argparse leaves this way, with a status of its own
            assert isinstance(left.code, int)
            return left.code

    return run


@pytest.fixture
def one_line(capsys: pytest.CaptureFixture[str]) -> OneLine:
    """Return a function that returns what was told on stderr, which must be an error in one line."""

    def read() -> str:
        told = capsys.readouterr().err
        assert told.startswith("vislam: error: ")
        assert told.count("\n") == 1
        return told

    return read
