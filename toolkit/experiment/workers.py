"""Units of work side by side, in processes of one numeric thread each (loky's).

A process that dies takes the unit it was busy with along and nothing else: the units that were under way are tried once
more, each alone, and one that dies again is lost. An interrupt is the parent's alone to handle: it ends the processes
it started, and where it is itself killed they end by themselves. Loky's processes do not run the caller's main module
again, so a script needs no guard.
"""

import os
import re
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
from loky import ProcessPoolExecutor
from loky.process_executor import BrokenProcessPool

from toolkit.progress import Progress

T = TypeVar("T")
R = TypeVar("R")
Work = Callable[[T, Progress], R]

# A recording in memory and a smoother's graph are no leak: loky takes 300 MB for one, and begins the process anew.
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1") | {
    "LOKY_MAX_MEMORY_LEAK_SIZE": str(4 * 2**30)
}
_POLL_S, _PARENT_POLL_S = 0.1, 1.0
# How far a unit has come, as its process writes it and the parent reads it.
_ENTRY = np.dtype(
    [("begun", np.int64), ("done", np.int64), ("total", np.int64), ("stages", np.int64), ("stage", "S64")]
)
# Shown for each unit: its frames take the first half, what a smoother does in the end the second.
_STEPS = 100


@dataclass(frozen=True)
class Lost:
    """What became of a unit whose process died twice: how, in words."""

    why: str


def usable_cpus() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def results_of(
    units: Sequence[T], workers: int, work: Work[T, R], progress: Progress
) -> Generator[tuple[int, R | Lost], None, None]:
    """Yield the place and the result of every unit as each is there, from so many processes; see :class:`Workers`."""
    with Workers(workers) as pool:
        yield from pool.results(units, work, progress)


class Pool(Protocol):
    """Does units of work somewhere, ``count`` at a time; a context that ends what it started."""

    count: int

    def __enter__(self) -> Self:
        """Begin."""

    def __exit__(self, *_: object) -> None:
        """End what was started."""

    def results(
        self, units: Sequence[T], work: Work[T, R], progress: Progress
    ) -> Generator[tuple[int, R | Lost], None, None]:
        """Yield the place and the result of every unit as each is there; an error of the work is raised."""


class Workers:
    """So many processes, started once for several pieces of work; when the context ends none is left.

    With one worker the work is done in this process.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._executor: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """End the processes, whatever they are doing."""
        if self._executor is not None:
            self._executor.shutdown(wait=True, kill_workers=True)
            self._executor = None

    def warm_up(self, module: str) -> None:
        """Start the processes and have them import a module, while the caller does something else."""
        if self.count > 1:
            for _ in range(self.count):
                self.submit(import_module, module)

    def submit(self, work: Callable[..., R], *arguments: Any) -> "Future[R]":
        """Have a process do some work."""
        # Started with the first process, Python's own tracker would let interrupts through to it again.
        resource_tracker.ensure_running()
        with _interrupts_held_back():
            if self._executor is None:
                self._executor = _executor(self.count)
            future: Future[R] = self._executor.submit(work, *arguments)
        return future

    def results(
        self, units: Sequence[T], work: Work[T, R], progress: Progress
    ) -> Generator[tuple[int, R | Lost], None, None]:
        """Yield the place and the result of every unit as each is there.

        An error that the work raises ends everything and is raised here.
        """
        if self.count == 1:
            for place, unit in enumerate(units):
                yield place, work(unit, _Share(progress, place, len(units)))
            return
        with tempfile.TemporaryDirectory(prefix="vislam-") as folder:
            yield from _Watch(self, units, work, Path(folder) / "progress").results(progress)


class _Share:
    """The progress of one unit as a part of that of all."""

    def __init__(self, whole: Progress, place: int, count: int) -> None:
        self._whole, self._place, self._count = whole, place, count
        self._stages: list[str] = []

    def advance(self, done: int, total: int, stage: str = "") -> None:
        """Pass on how far the unit has come."""
        if stage and stage not in self._stages:
            self._stages.append(stage)
        steps = _share_done(len(self._stages), done, total)
        self._whole.advance(_STEPS * self._place + steps, _STEPS * self._count, _in_words(stage, done))


def _share_done(stages: int, done: int, total: int) -> int:
    half = _STEPS // 2
    part = half * done // max(total, 1)
    return part if stages == 0 else half + part


def _in_words(stage: str, done: int) -> str:
    """Return what a smoother does in the end, nothing where it has not come to that."""
    return f"{stage}, iteration {done + 1}" if stage else ""


class _Watch(Generic[T, R]):
    """Some units under way, how far each has come, and which are finished."""

    def __init__(self, workers: Workers, units: Sequence[T], work: Work[T, R], board: Path) -> None:
        self._workers, self._units, self._work, self._board = workers, units, work, board
        self._entries = np.memmap(board, dtype=_ENTRY, mode="w+", shape=(max(len(units), 1),))
        self._finished: set[int] = set()

    def results(self, progress: Progress) -> Iterator[tuple[int, R | Lost]]:
        """Yield the place and the result of every unit."""
        progress.advance(0, _STEPS * len(self._units))
        while len(self._finished) < len(self._units):
            waiting = [place for place in range(len(self._units)) if place not in self._finished]
            try:
                yield from self._side_by_side(waiting, self._workers, progress)
            except BrokenProcessPool:
                self._workers.end()
                suspects = [place for place in waiting if self._entries["begun"][place] and place not in self._finished]
                for place in suspects:
                    yield from self._alone(place, progress)

    def _side_by_side(self, places: list[int], workers: Workers, progress: Progress) -> Iterator[tuple[int, R | Lost]]:
        pending = {self._submitted(workers, place): place for place in places}
        while pending:
            done, _ = wait(pending, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            for future in done:
                place = pending.pop(future)
                result = future.result()
                self._finished.add(place)
                yield place, result
            progress.advance(self._steps_done(), _STEPS * len(self._units), self._stage())

    def _alone(self, place: int, progress: Progress) -> Iterator[tuple[int, R | Lost]]:
        """Try a unit once more in a process of its own."""
        try:
            with Workers(1) as one:
                yield from self._side_by_side([place], one, progress)
        except BrokenProcessPool as error:
            self._finished.add(place)
            yield place, Lost(f"its process {_how_it_ended(error)} before it answered")

    def _submitted(self, workers: Workers, place: int) -> "Future[R]":
        future: Future[R] = workers.submit(_do, self._work, self._units[place], self._board, place)
        return future

    def _steps_done(self) -> int:
        shares = [_share_done(int(one["stages"]), int(one["done"]), int(one["total"])) for one in self._under_way()]
        return _STEPS * len(self._finished) + sum(shares)

    def _stage(self) -> str:
        """Return what the first of the smoothers that have come to their end does there."""
        stages = (_in_words(one["stage"].decode(), int(one["done"])) for one in self._under_way())
        return next(filter(None, stages), "")

    def _under_way(self) -> list[Any]:
        """Return the entries of the units that are not finished."""
        return [self._entries[place] for place in range(len(self._units)) if place not in self._finished]


def _executor(count: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(count, initializer=_begin, initargs=(os.getpid(),), env=_ENVIRONMENT)


def _begin(parent: int) -> None:
    """Leave interrupts to the parent, and end where it ends; the whole of a process' preparation."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this process when its parent is gone: one that was killed could not tell it to."""
    while os.getppid() == parent:
        time.sleep(_PARENT_POLL_S)
    os._exit(1)


def _do(work: Work[T, R], unit: T, board: Path, place: int) -> R:
    """Do a unit of work in a process of its own."""
    entries = np.memmap(board, dtype=_ENTRY, mode="r+")
    entries[place] = (1, 0, 1, 0, b"")
    try:
        return work(unit, _Entry(entries, place))
    except MemoryError:
        os._exit(1)  # as if the system had ended the process: the unit alone is lost


class _Entry:
    """Progress that a process writes where its parent reads it."""

    def __init__(self, entries: Any, place: int) -> None:
        self._entries, self._place = entries, place
        self._stages: list[str] = []

    def advance(self, done: int, total: int, stage: str = "") -> None:
        """Write how far the unit has come."""
        if stage and stage not in self._stages:
            self._stages.append(stage)
        self._entries[self._place] = (1, done, total, len(self._stages), stage.encode("ascii", "replace"))


def _how_it_ended(error: BrokenProcessPool) -> str:
    """Return how a process ended, of what loky says of it."""
    named = re.search(r"exit codes of the workers are \{(\w+)\((-?\d+)\)", str(error))
    if named is None:
        return "ended"
    return f"was ended by signal {-int(named[2])}" if int(named[2]) < 0 else f"ended with status {named[2]}"


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Have processes started here ignore Ctrl-C from their start; one that comes meanwhile is delivered afterwards."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
