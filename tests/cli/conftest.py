"""The command line run in this process, in an empty directory."""

from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit.cli import main

Vislam = Callable[..., int]
OneLine = Callable[[], str]


@pytest.fixture
def vislam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, one_process: None) -> Vislam:
    """Return a function that runs ``vislam`` with the given words and returns its exit status.

    All is done in this process but where the words ask for more.
    """
    monkeypatch.chdir(tmp_path)

    def run(*words: str) -> int:
        try:
            return main(words)
        except SystemExit as left:  # argparse leaves this way, with a status of its own
            return left.code

    return run


@pytest.fixture
def one_line(capsys: pytest.CaptureFixture[str]) -> OneLine:
    """Return a function that returns what was told on stderr, which must be an error in one line."""

    def read() -> str:
        messages = capsys.readouterr().err
        assert messages.startswith("vislam: error: ")
        assert messages.count("\n") == 1
        return messages

    return read
