"""What tests of several packages share: the way to the real recordings, and one line that runs an estimator."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from toolkit import runner
from toolkit.audit import Audit
from toolkit.estimate import Run
from toolkit.estimator import find
from toolkit.experiment import pipeline, recording, workers
from toolkit.experiment.recording import Recording
from toolkit.progress import SILENT
from toolkit.sequence import Prior, Sequence
from toolkit.settings import DEFAULTS, Settings
from toolkit.simulation import SCENARIOS

PROJECT = Path(__file__).parents[1]

# Where systems keep what is one user's or passing. Before it stands no part of a longer path or of an address.
_OF_ONE_MACHINE = re.compile(
    r"(?:file://|(?<![\w.:/~-]))/(?:home|Users|root|tmp|var|private|mnt|media)/[\w.~-]+|\b[A-Z]:\\+Users\\+"
)


def pytest_configure() -> None:
    """Let interrupts be tested also where the tests run in the background, to which a shell gives none."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def starts_group() -> Iterator[Callable[[tuple[str, ...], Path, Mapping[str, str]], subprocess.Popen[str]]]:
    """Start Python, with arguments, a directory and variables, in a group of processes that the test's end ends."""
    started: list[subprocess.Popen[str]] = []

    def start(arguments: tuple[str, ...], cwd: Path, variables: Mapping[str, str]) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            cwd=cwd,
            env={**os.environ, **variables},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


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
def machine_paths() -> Callable[[str], list[str]]:
    """Return a function that finds, in a text for everybody, the paths that exist on one machine alone."""
    return _OF_ONE_MACHINE.findall


@contextmanager
def _without_pixels() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda _figure, path, **_options: Path(path).touch())
        yield


@pytest.fixture(scope="session")
def without_pixels() -> Callable[[], AbstractContextManager[None]]:
    """Return a context in which every figure is drawn, but an empty file stands where its pixels would be.

    Rendering takes longer than all else in a comparison of a few frames. Tests that are about something else do
    without; the first line of the README and a test of run directories render theirs.
    """
    return _without_pixels


_audited_recording = recording.audited_recording


@cache
def _audited(_audit: Callable[..., Audit], source: str, keep: frozenset[str], seed: int) -> Audit:
    """Return a simulated recording audited; a test that puts another audit in gets what that one says."""
    return _audited_recording(Recording(source, seed, keep=keep))


@pytest.fixture(scope="module")
def audited_once() -> Iterator[None]:
    """Simulate and audit each built-in recording once for all tests of a worker that run a few frames of it."""

    def remembered(asked: Recording) -> Audit:
        if asked.truth is None and asked.duration_s is None and asked.source in SCENARIOS:
            return _audited(recording.audit, asked.source, asked.keep, asked.seed)
        return _audited_recording(asked)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "audited_recording", remembered)
        yield


@pytest.fixture
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have all work done in this process where nobody says in how many: each takes a second to start."""
    for module in (workers, pipeline):
        monkeypatch.setattr(module, "usable_cpus", lambda: 1)


@pytest.fixture
def unrendered() -> Iterator[None]:
    """Run a test without the pixels of its figures."""
    with _without_pixels():
        yield


@pytest.fixture(scope="session")
def run_estimator() -> Callable[..., Run]:
    """Return a function that runs an estimator, by its name, over a sequence from its own or a given prior."""

    def run(name: str, sequence: Sequence, prior: Prior | None = None, settings: Settings = DEFAULTS) -> Run:
        start = sequence.prior if prior is None else prior
        assert start is not None
        return runner.run(name, find(name).load(), sequence, start, SILENT, settings=settings)

    return run
