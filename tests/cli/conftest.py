"""The command line run in this process, in an empty directory."""

from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit.cli import main

Vislam = Callable[..., int]


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
