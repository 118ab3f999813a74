"""What tests of several packages share: the way to the real recordings, and one line that runs an estimator."""

# ruff: noqa: E402 - the number of threads must be set before NumPy is imported

import fcntl
import gc
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

from toolkit.threads import THREAD_VARIABLES

# Before NumPy is loaded, here and in the workers of these tests: their linear algebra would start a thread for every
# processor, which fight for the processors of the other workers and take ten times as long.
for _variable in THREAD_VARIABLES:
    os.environ.setdefault(_variable, "1")

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from toolkit import runner
from toolkit.answers import Run
from toolkit.audit import Audit, Finding
from toolkit.experiment import pipeline, recording, workers
from toolkit.measurements import Prior
from toolkit.progress import SILENT
from toolkit.registry import find
from toolkit.sequence import Sequence
from toolkit.settings import DEFAULTS, Settings

PROJECT = Path(__file__).parents[1]
# Of the rendered drive: images, (width, height) px, and how far it goes from one to the next.
KITTI_FRAMES, KITTI_SIZE, KITTI_FOCAL_PX, KITTI_BASELINE_M, KITTI_STEP_M = 8, (320, 200), 250.0, 0.4, 0.05

# Where systems keep what is one user's or passing. Before it stands no part of a longer path or of an address.
_OF_ONE_MACHINE = re.compile(
    r"(?:file://|(?<![\w.:/~-]))/(?:home|Users|root|tmp|var|private|mnt|media)/[\w.~-]+|\b[A-Z]:\\+Users\\+"
)


def pytest_configure() -> None:
    """Let interrupts be tested also where the tests run in the background, where a shell has some ignored."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
    gc.disable()  # until the tests are found: all that is made meanwhile stays


# What takes longest comes first, or one worker would still be at it when all others have ended. What stays together
# here has its fixtures made once: it is from the end that another worker takes tests.
_LONGEST = ("docs", "notebooks", "test_figures_on_real_data.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests that take longest first."""
    places = {name: place for place, name in enumerate(_LONGEST)}
    tests = PROJECT / "tests"
    items.sort(key=lambda item: places.get(item.path.relative_to(tests).parts[0], len(places)))


def pytest_collection_finish() -> None:
    """Have the garbage collector pass over what lives until the end: five thousand tests and the modules they import.

    Each of its full rounds would look through all of that again. Of what tests make it looks at the young less often.
    """
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)
    gc.enable()


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
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[], Any]], Any]:
    """Return a function that makes something by its name, or reads what another worker of these tests has made.

    It is kept as JSON in the directory of this session; who comes while it is made waits.
    """
    own = tmp_path_factory.getbasetemp()
    folder = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own

    def read_or_make(name: str, make: Callable[[], Any]) -> Any:
        with (folder / f"{name}.json").open("a+", encoding="utf-8") as kept:
            fcntl.flock(kept, fcntl.LOCK_EX)
            kept.seek(0)
            if text := kept.read():
                return json.loads(text)
            made = make()
            json.dump(made, kept)
            return made

    return read_or_make


@pytest.fixture(scope="session")
def machine_paths() -> Callable[[str], list[str]]:
    """Return a function that finds, in a text for everybody, the paths that exist on one machine alone."""
    return _OF_ONE_MACHINE.findall


_count_memory_anew = runner._count_memory_anew


@pytest.fixture(scope="session", autouse=True)
def _keeps_memory() -> Iterator[None]:
    """Let runs begin with the memory that earlier ones have freed, but where their own is measured.

    To give it back to the system and to have every page cleared again takes longer than many a run of these tests.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "_count_memory_anew", lambda: None)
        yield


@pytest.fixture
def counts_memory_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have runs give memory back and begin to count its peak, as outside of tests."""
    monkeypatch.setattr(runner, "_count_memory_anew", _count_memory_anew)


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


_audit = recording.audit


@pytest.fixture(scope="session", autouse=True)
def _remembers_audits() -> Iterator[None]:
    """Have runs audit the same recording once in all tests of a worker, whichever way it was loaded.

    Of what was left as it was no more than the findings is kept.
    """
    kept: dict[tuple[object, ...], tuple[Sequence | None, tuple[Finding, ...], Mapping[str, str]]] = {}

    def remembered(sequence: Sequence, keep: frozenset[str] = frozenset()) -> Audit:
        key = (sequence.name, sequence.provenance, sequence.content_hash(), keep)
        if key not in kept:
            found = _audit(sequence, keep)
            repaired = None if found.sequence is sequence else found.sequence
            kept[key] = repaired, found.findings, found.undecided
        repaired, findings, undecided = kept[key]
        return Audit(sequence if repaired is None else repaired, findings, undecided)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "audit", remembered)
        yield


@pytest.fixture
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have all work done in this process where nobody says in how many: each takes a second to start."""
    for module in (workers, pipeline):
        monkeypatch.setattr(module, "usable_cpus", lambda: 1)


@pytest.fixture(scope="session", autouse=True)
def _cache_of_tests(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep what is measured or tracked for other tests on the same recording, and not where the user's is kept.

    What is kept is found by its content, and what an earlier state of the code has kept there is not read.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VISLAM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Keep what is measured or tracked where no other test finds it."""
    monkeypatch.setenv("VISLAM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


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
        return runner.run(name, find(name).load(), sequence, start, SILENT, settings=settings)

    return run


@pytest.fixture(scope="session")
def kitti_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a drive towards a textured wall 8 m ahead: its images are the texture, ever larger."""
    root = tmp_path_factory.mktemp("kitti") / "drive"
    rng = np.random.default_rng(2)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (900, 1200)), (0, 0), 2.5) * 4.0 - 382.0
    texture = np.clip(texture, 0, 255).astype(np.float32)
    poses = []
    for k in range(KITTI_FRAMES):
        depth = 8.0 - KITTI_STEP_M * k
        for side, folder in enumerate(("image_0", "image_1")):
            (root / folder).mkdir(parents=True, exist_ok=True)
            u, v = np.meshgrid(np.arange(KITTI_SIZE[0], dtype=np.float32), np.arange(KITTI_SIZE[1], dtype=np.float32))
            x = (u - 160.0) / KITTI_FOCAL_PX * depth + side * KITTI_BASELINE_M
            y = (v - 100.0) / KITTI_FOCAL_PX * depth
            columns, rows = (x * 80.0 + 600.0).astype(np.float32), (y * 80.0 + 450.0).astype(np.float32)
            image = cv2.remap(texture, columns, rows, cv2.INTER_LINEAR) + rng.normal(0.0, 1.0, KITTI_SIZE[::-1])
            cv2.imwrite(str(root / folder / f"{k:06d}.png"), np.clip(image, 0, 255).astype(np.uint8))
        poses.append(f"1 0 0 0 0 1 0 0 0 0 1 {KITTI_STEP_M * k:.6f}\n")
    projection = [
        f"P{i}: {KITTI_FOCAL_PX} 0 160 {-i * KITTI_FOCAL_PX * KITTI_BASELINE_M} 0 {KITTI_FOCAL_PX} 100 0 0 0 1 0\n"
        for i in (0, 1)
    ]
    (root / "calib.txt").write_text("".join(projection) + "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    (root / "times.txt").write_text("".join(f"{0.1 * k:e}\n" for k in range(KITTI_FRAMES)))
    (root / "poses.txt").write_text("".join(poses))
    return root
