"""A process of one numeric thread that does one piece of work after another (loky's).

An interrupt is the parent's alone to handle: it ends the processes it started, and where it is itself killed they end
by themselves. Loky's processes do not run the caller's main module again, so a script needs no guard.
"""

import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any, TypeVar

from loky import ProcessPoolExecutor
from loky.process_executor import BrokenProcessPool

R = TypeVar("R")

# A recording in memory and a smoother's graph are no leak: loky takes 300 MB for one, and begins the process anew.
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1") | {
    "LOKY_MAX_MEMORY_LEAK_SIZE": str(4 * 2**30)
}
_PARENT_POLL_S = 1.0


class WorkerProcess:
    """A process, started with its first work, and anew after it died."""

    def __init__(self) -> None:
        self._executor: ProcessPoolExecutor | None = None

    def submit(self, work: Callable[..., R], *arguments: Any) -> "Future[R]":
        """Have the process do some work after what it has to do already; where it dies, BrokenProcessPool is raised."""
        # Started with the first process, Python's own tracker would let interrupts through to it again.
        resource_tracker.ensure_running()
        with _interrupts_held_back():
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
        """End the process, whatever it is doing."""
        if self._executor is not None:
            self._executor.shutdown(wait=True, kill_workers=True)
            self._executor = None


def how_it_ended(error: BrokenProcessPool) -> str:
    """Return how a process ended, of what loky says of it."""
    named = re.search(r"exit codes of the workers are \{(\w+)\((-?\d+)\)", str(error))
    if named is None:
        return "ended"
    return f"was ended by signal {-int(named[2])}" if int(named[2]) < 0 else f"ended with status {named[2]}"


def _executor() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, initializer=_begin, initargs=(os.getpid(),), env=_ENVIRONMENT)


def _begin(parent: int) -> None:
    """Leave interrupts to the parent, and end where it ends; the whole of a process' preparation."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this process when its parent is gone: one that was killed could not tell it to."""
    while os.getppid() == parent:
        time.sleep(_PARENT_POLL_S)
    os._exit(1)


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Have processes started here ignore Ctrl-C from their start; one that comes meanwhile is delivered afterwards."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
