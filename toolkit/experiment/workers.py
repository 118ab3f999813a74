"""Units of work side by side, in processes of one numeric thread each (loky's).

When a process dies, only its current unit is affected: the unit is tried once more when all others are done, with no
other process running, and is lost if its process dies again. Units that need the same recording go to the process that
has it prepared, as long as there is other work for the others.

Only the parent handles interrupts: it ends the processes it started. If the parent itself is killed, they end by
themselves. Loky's processes do not run the caller's main module again, so a script needs no guard.
"""

import os
import re
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Hashable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import resource_tracker
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Generic, Self, TypeVar

import numpy as np
from loky import ProcessPoolExecutor, cpu_count
from loky.process_executor import BrokenProcessPool

from toolkit.errors import SystemLimitError
from toolkit.files.writing import uninterrupted
from toolkit.progress import Progress
from toolkit.threads import THREAD_VARIABLES

T = TypeVar("T")
R = TypeVar("R")
Work = Callable[[T, Progress], R]
# Key of the data that a process keeps from one unit for the next; equal keys share it.
Needs = Callable[[T], Hashable]

# Loky takes growth by 300 MB for a leak and restarts the process; a recording and a smoother's graph are no leak.
# glibc returns every array of a few hundred kB to the system and has its pages cleared for the next one: a tenth of the
# time of dense algebra. Elsewhere the two variables say nothing.
_ENVIRONMENT = dict.fromkeys(THREAD_VARIABLES, "1") | {
    "LOKY_MAX_MEMORY_LEAK_SIZE": str(4 * 2**30),
    "MALLOC_MMAP_THRESHOLD_": str(8 * 2**20),
    "MALLOC_TRIM_THRESHOLD_": str(64 * 2**20),
}
_PARENT_POLL_S, _POLL_S = 1.0, 0.1
# How many processors this process may use: by its affinity, and by the limits of its container.
usable_cpus: Callable[[], int] = cpu_count
# Signals that a terminal sends to every process of its group, and that the parent alone handles.
_OF_A_TERMINAL = (signal.SIGINT, signal.SIGHUP)
# Progress of a unit, written by its process and read by the parent.
_ENTRY = np.dtype([("done", np.int64), ("total", np.int64), ("solving", np.bool_), ("stage", "S64")])
# Progress steps of each unit: its frames are the first half, a smoother's final solve the second.
_STEPS = 100


class WorkerProcess:
    """A process, started with its first work, and anew after it died."""

    def __init__(self) -> None:
        self._executor: ProcessPoolExecutor | None = None

    def submit(self, work: Callable[..., R], *arguments: Any) -> "Future[R]":
        """Queue work for the process, whose result is BrokenProcessPool where the process dies.

        Signals are held back until it is started, lest a half-started one leave what it shares behind. Raises
        SystemLimitError where the system lets no process be started.
        """
        with uninterrupted(), _refusals_shown():
            # Up to Python 3.11 its resource tracker leaves interrupts unblocked when it has started, so they are held
            # back anew for the process.
            with _interrupts_held_back():
                resource_tracker.ensure_running()
            with _interrupts_held_back():
                return self._submitted(work, *arguments)

    def _submitted(self, work: Callable[..., R], *arguments: Any) -> "Future[R]":
        if self._executor is None:
            self._executor = _executor()
        try:
            future: Future[R] = self._executor.submit(work, *arguments)
        except BrokenProcessPool:  # it died with nothing to do
            self.end()
            self._executor = _executor()
            future = self._executor.submit(work, *arguments)
        return future

    def end(self) -> None:
        if self._executor is not None:
            self._executor.shutdown(wait=True, kill_workers=True)
            self._executor = None


def how_it_ended(error: BrokenProcessPool) -> str:
    named = re.search(r"exit codes of the workers are \{(\w+)\((-?\d+)\)", str(error))
    if named is None:
        return "ended"
    return f"was ended by signal {-int(named[2])}" if int(named[2]) < 0 else f"ended with status {named[2]}"


def _executor() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, initializer=_begin, initargs=(os.getpid(),), env=_ENVIRONMENT)


def _begin(parent: int) -> None:
    """Prepare a process: leave interrupts to the parent, and end when the parent ends."""
    for number in _OF_A_TERMINAL:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _OF_A_TERMINAL)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this process when its parent is gone: one that was killed could not tell it to."""
    while os.getppid() == parent:
        time.sleep(_PARENT_POLL_S)
    os._exit(1)


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Keep signals that a terminal sends to its whole process group (Ctrl-C, hang-up) from processes started here.

    A signal that comes meanwhile is delivered afterwards. Loky's resource tracker ignores Ctrl-C by itself, and keeps
    the hang-up signal blocked: if it died, its successor would warn about resources that it does not know.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _OF_A_TERMINAL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _refusals_shown() -> Iterator[None]:
    """Raise SystemLimitError where the system cannot start a process, which needs open files and room in /dev/shm."""
    try:
        yield
    except (OSError, ImportError) as error:  # the latter where the system has no semaphores at all
        why = (error.strerror if isinstance(error, OSError) else None) or error
        remedy = "one worker does without them: --workers 1"
        raise SystemLimitError(
            f"no worker process can be started ({why}): they need processes, open files and room in /dev/shm; {remedy}"
        ) from error


@dataclass(frozen=True)
class LostUnit:
    """The result of a unit whose process died twice: how the process ended, in words."""

    why: str


def results_of(
    units: Sequence[T], workers: int, work: Work[T, R], progress: Progress, needs: Needs[T] | None = None
) -> Generator[tuple[int, R | LostUnit], None, None]:
    """Yield the place and the result of every unit as each is there, from several processes; see :class:`Workers`."""
    with Workers(workers) as pool:
        yield from pool.results(units, work, progress, needs)


class Workers:
    """Processes, started once for several pieces of work; when the context ends none is left.

    With one worker the work is done in this process.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._processes = [WorkerProcess() for _ in range(count)] if count > 1 else []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._processes:
            with ThreadPoolExecutor(len(self._processes)) as threads:
                list(threads.map(WorkerProcess.end, self._processes))

    def warm_up(self, module: str) -> None:
        """Start the processes and have them import a module, while the caller does something else."""
        for process in self._processes:
            process.submit(import_module, module)

    def results(
        self, units: Sequence[T], work: Work[T, R], progress: Progress, needs: Needs[T] | None = None
    ) -> Generator[tuple[int, R | LostUnit], None, None]:
        """Yield the place and the result of every unit as each is there.

        An error that the work raises ends everything and is raised here.
        """
        if self.count == 1:
            board = _Board(len(units))
            for place, unit in enumerate(units):
                yield place, work(unit, _Entry(board.entries, place, lambda: progress.advance(*board.progress())))
                board.finish(place)
            return
        with tempfile.TemporaryDirectory(prefix="vislam-") as folder:
            path = Path(folder) / "progress"
            board = _Board(len(units), path)
            tasks = [(_do, work, unit, path, place) for place, unit in enumerate(units)]
            handing_out: _HandingOut[R] = _HandingOut(
                self._processes, tasks, [None if needs is None else needs(unit) for unit in units]
            )
            progress.advance(*board.progress())
            try:
                for place, result in handing_out.results(lambda: progress.advance(*board.progress())):
                    board.finish(place)
                    progress.advance(*board.progress())
                    yield place, result
            finally:
                handing_out.stop()


class _HandingOut(Generic[R]):
    """A thread for each process gives it its next task as soon as it is free, whenever the results are read.

    ``tasks`` are functions with their arguments, ``needs`` the keys of the data that processes keep for them.
    """

    def __init__(
        self, processes: list[WorkerProcess], tasks: Sequence[tuple[Any, ...]], needs: Sequence[Hashable]
    ) -> None:
        self._tasks, self._needs, self._waiting = tasks, needs, list(range(len(tasks)))
        self._ready: dict[WorkerProcess, Hashable] = {}
        self._answers: SimpleQueue[tuple[int, Future[R]] | Exception] = SimpleQueue()
        self._lock = threading.Lock()
        for process in processes:
            threading.Thread(target=self._serve, args=(process,), name="vislam-workers", daemon=True).start()

    def stop(self) -> None:
        with self._lock:
            self._waiting.clear()

    def results(self, meanwhile: Callable[[], None]) -> Generator[tuple[int, R | LostUnit], None, None]:
        died = []
        for _ in self._tasks:
            while True:
                try:
                    answer = self._answers.get(timeout=_POLL_S)
                    break
                except Empty:
                    meanwhile()
            if isinstance(answer, Exception):
                raise answer
            place, future = answer
            try:
                result = future.result()
            except BrokenProcessPool:
                died.append(place)
            else:
                yield place, result
        for place in died:
            yield place, self._retry_alone(place, meanwhile)

    def _retry_alone(self, place: int, meanwhile: Callable[[], None]) -> R | LostUnit:
        process = WorkerProcess()
        try:
            future: Future[R] = process.submit(*self._tasks[place])
            while not wait([future], timeout=_POLL_S).done:
                meanwhile()
            return future.result()
        except BrokenProcessPool as error:
            return LostUnit(f"its process {how_it_ended(error)} before it answered")
        finally:
            process.end()

    def _serve(self, process: WorkerProcess) -> None:
        """Hand a process one task after the other and pass the answers on, until none is waiting."""
        try:
            while (handed := self._next_for(process)) is not None:
                wait([handed[1]])
                self._answers.put(handed)
        except Exception as error:  # any error is raised where the results are read
            self._answers.put(error)

    def _next_for(self, process: WorkerProcess) -> "tuple[int, Future[R]] | None":
        """Submit the next task for a process: one it is ready for, else one that no process is, else any."""
        with self._lock:  # so that no process is started once this is stopped
            if not self._waiting:
                return None
            mine, elsewhere = self._ready.get(process), set(self._ready.values())
            place = next(
                (one for one in self._waiting if mine is not None and self._needs[one] == mine),
                next((one for one in self._waiting if self._needs[one] not in elsewhere - {None}), self._waiting[0]),
            )
            self._waiting.remove(place)
            self._ready[process] = self._needs[place]
            return place, process.submit(*self._tasks[place])


class _Board:
    """Progress of each unit: in a file that the processes write, or in memory where there is one process."""

    def __init__(self, count: int, path: Path | None = None) -> None:
        size, self._total = max(count, 1), _STEPS * count
        self.entries = np.zeros(size, _ENTRY) if path is None else np.memmap(path, _ENTRY, "w+", shape=(size,))
        self._under_way, self._most = np.ones(count, dtype=bool), 0

    def finish(self, place: int) -> None:
        self._under_way[place] = False

    def progress(self) -> tuple[int, int, str]:
        """Return the steps done, of how many, and the current stage of the first unit that is in one.

        A unit that solves anew does not undo what was done: fewer steps than before would begin another count.
        """
        entries, half = np.array(self.entries[: self._under_way.size])[self._under_way], _STEPS // 2
        done = half * entries["done"] // np.maximum(entries["total"], 1) + half * entries["solving"]
        stage = ""
        for one in entries[entries["stage"] != b""][:1]:
            stage = one["stage"].decode() + (f", iteration {one['done'] + 1}" if one["solving"] else "")
        self._most = max(self._most, self._total - _STEPS * entries.size + int(done.sum()))
        return self._most, self._total, stage


def _do(work: Work[T, R], unit: T, board: Path, place: int) -> R:
    entries = np.memmap(board, dtype=_ENTRY, mode="r+")
    entries[place] = (0, 1, False, b"")
    try:
        return work(unit, _Entry(entries, place))
    except MemoryError:
        os._exit(1)  # as if the system had ended the process: the unit alone is lost


class _Entry:
    """Progress of a unit, written to the board and then reported."""

    def __init__(self, entries: Any, place: int, report: Callable[[], None] = lambda: None) -> None:
        self._entries, self._place, self._report = entries, place, report
        self._has_begun = False

    def advance(self, done: int, total: int, stage: str = "") -> None:
        """Write how far the unit has come; a stage before the first frame is no solve, but what a run waits for."""
        self._has_begun |= not stage
        self._entries[self._place] = (done, total, bool(stage) and self._has_begun, stage.encode("ascii", "replace"))
        self._report()
