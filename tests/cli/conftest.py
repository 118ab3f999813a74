"""The command line run in this process, in an empty directory."""

import shutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

from toolkit.audit import Audit
from toolkit.cli import main
from toolkit.experiment import recording
from toolkit.experiment.recording import Recording
from toolkit.simulation import SCENARIOS

Vislam = Callable[..., int]
OneLine = Callable[[], str]


_audited_recording = recording.audited_recording


@cache
def _audited(_audit: Callable[..., Audit], source: str, keep: frozenset[str], seed: int) -> Audit:
    """Return a simulated recording audited; a test that puts another audit in gets what that one says."""
    return _audited_recording(Recording(source, seed, keep=keep))


@pytest.fixture(scope="module", autouse=True)
def audited_once() -> Iterator[None]:
    """Simulate and audit each built-in recording once for all tests: most of them run ten frames of the same one."""

    def remembered(asked: Recording) -> Audit:
        if asked.truth is None and asked.duration_s is None and asked.source in SCENARIOS:
            return _audited(recording.audit, asked.source, asked.keep, asked.seed)
        return _audited_recording(asked)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "audited_recording", remembered)
        yield


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


@pytest.fixture(scope="session")
def _short_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("short") / "run"
    words = ("compare", "drive", "--estimators", "dead-reckoning", "--max-frames", "10")
    assert main([*words, "--out", str(directory)]) == 0
    return directory


@pytest.fixture
def short_run(_short_run: Path, vislam: Vislam) -> Path:
    """Return ``run`` in this test's directory: what a comparison of a few frames left, made once for all tests."""
    return Path(shutil.copytree(_short_run, "run"))


@pytest.fixture
def one_line(capsys: pytest.CaptureFixture[str]) -> OneLine:
    """Return a function that returns what was told on stderr, which must be an error in one line."""

    def read() -> str:
        told = capsys.readouterr().err
        assert told.startswith("vislam: error: ")
        assert told.count("\n") == 1
        return told

    return read
