"""Decides whether an estimator's compiled code runs instead of its NumPy code, and records what ran.

The NumPy code is the definition. Compiled code that computes the same is in modules of its own, which import numba (the
extra ``fast``). They are imported when an estimator that has them is built, never before, and compiled then, once for
each version.
"""

import fcntl
import importlib.util
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import BinaryIO, Literal

from toolkit.errors import EstimatorError

Requested = Literal["auto", "compiled", "numpy"]
Ran = Literal["compiled", "numpy"]
_NEEDS = "needs numba, which is not installed: pip install 'vislam-toolkit[fast]', or --no-fast"


def check_possible(requested: Requested) -> None:
    """Raise EstimatorError where compiled code is required and numba is not installed."""
    if requested == "compiled" and find_spec("numba") is None:
        raise EstimatorError(f"arithmetic = compiled {_NEEDS}")


class Compilation:
    """Compiled modules for one run, as asked: where numba is installed ("auto"), in any case, or never ("numpy").

    Afterwards ``ran`` says which code ran, None where the estimator has NumPy code alone; ``log`` has remarks for the
    user; ``wall_s`` and ``cpu_s`` are the times of importing and compiling, which happen once a process and do not
    count as cost of the run.
    """

    def __init__(self, requested: Requested = "numpy") -> None:
        self._requested = requested
        self.ran: Ran | None = None
        self.log: tuple[str, ...] = ()
        self.wall_s = self.cpu_s = 0.0

    def module(self, name: str) -> ModuleType | None:
        """Return a compiled module by its dotted name, or None where NumPy is to run.

        Its constant ``COMPILED`` describes what had to be compiled; it is empty where the compiled code was found on
        disk. Raises EstimatorError where compiled code is required and not available.
        """
        return self._imported(name, _one_process_at_a_time(name)) if self._can_run() else None

    def share(self, names: Iterable[str]) -> None:
        """Import those compiled modules that no other process is importing yet, so that processes share the compiling.

        :meth:`module` then waits for the other processes. Raises as :meth:`module` does.
        """
        for name in names if self._can_run() else ():
            with _unless_another_process(name) as alone:
                if alone:
                    self._imported(name, nullcontext())

    def _can_run(self) -> bool:
        check_possible(self._requested)
        self.ran = "numpy"
        return self._requested != "numpy" and find_spec("numba") is not None

    def _imported(self, name: str, turn: AbstractContextManager[object]) -> ModuleType | None:
        """Import a module when it is this process's turn, and take down what that took."""
        first = name not in sys.modules
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            with turn:
                module = import_module(name)
        except Exception as error:
            # A numba that does not fit this Python or NumPy says so in errors of many kinds.
            why = " ".join(str(error).split())[:200]
            if self._requested == "compiled":
                raise EstimatorError(f"arithmetic = compiled: numba cannot be used here ({why})") from error
            self.log = tuple(dict.fromkeys([*self.log, f"numba cannot be used here, NumPy ran: {why}"]))
            return None
        self.ran = "compiled"
        took_s = time.process_time() - cpu
        self.wall_s, self.cpu_s = self.wall_s + time.perf_counter() - wall, self.cpu_s + took_s
        if first and module.COMPILED:
            self.log += (f"{module.COMPILED} ({took_s:.0f} s of CPU, in none of the times)",)
        return module


@contextmanager
def _one_process_at_a_time(name: str) -> Iterator[None]:
    """Have processes import a module one after another: what the first has compiled the others find on disk.

    They wait at the module's own file, so that none is left behind.
    """
    with ExitStack() as held:
        with suppress(OSError):  # no file, or a file system without locks: then they compile side by side
            fcntl.flock(held.enter_context(_file_of(name)), fcntl.LOCK_EX)
        yield


@contextmanager
def _unless_another_process(name: str) -> Iterator[bool]:
    """Say whether no other process imports a module, and have none do so meanwhile."""
    with ExitStack() as held:
        alone = True
        with suppress(OSError):
            file = held.enter_context(_file_of(name))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                alone = False
        yield alone


def _file_of(name: str) -> BinaryIO:
    spec = importlib.util.find_spec(name)
    return Path(spec.origin or "" if spec else "").open("rb")
