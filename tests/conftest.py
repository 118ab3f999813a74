"""What tests of several packages share: the way to the real recordings, and one line that runs an estimator."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit import runner
from toolkit.estimate import Run
from toolkit.estimator import find
from toolkit.sequence import Prior, Sequence

PROJECT = Path(__file__).parents[1]


class Unheard:
    """A progress nobody looks at."""

    def advance(self, done: int, total: int) -> None:
        """Take no note."""


@pytest.fixture(scope="session")
def real() -> Callable[[str], Path]:
    """Return a real recording by its place in the shared data, or skip where it is absent."""
    root = Path(os.environ.get("VISLAM_DATA", "../shared/data"))

    def find_recording(name: str) -> Path:
        path = PROJECT / root / name
        if not path.exists():
            pytest.skip(f"needs the real data {name} under VISLAM_DATA")
        return path

    return find_recording


@pytest.fixture(scope="session")
def run_estimator() -> Callable[..., Run]:
    """Return a function that runs an estimator, by its name, over a sequence from its own or a given prior."""

    def run(name: str, sequence: Sequence, prior: Prior | None = None) -> Run:
        start = sequence.prior if prior is None else prior
        assert start is not None
        return runner.run(name, find(name).load(), sequence, start, Unheard())

    return run
