"""Trials side by side, each in a process of its own with one numeric thread.

A process that dies takes the run it was busy with along and nothing else: that run has failed, the trial's other
estimators go on in a new process. An interrupt is the parent's alone to handle: it ends the processes it started.
"""

import os
import signal
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from toolkit.errors import VislamError
from toolkit.experiment.trial import Outcome, Trial, run_trial

Work = Callable[[Trial], Iterator[Outcome]]

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
# A fork server imports the slow libraries once, under _ONE_THREAD and before any thread runs.
_CONTEXT = get_context("forkserver")
_PATIENCE_S = 5.0


@dataclass(frozen=True)
class _Raised:
    """An error of the work itself, as a process reports it; one that a user can meet keeps its type."""

    text: str
    expected: VislamError | None = None


@dataclass
class _Worker:
    """A process, the trial it works on, the estimators it has not answered for and the pipe it answers by."""

    trial: Trial
    process: BaseProcess
    answers: Connection
    open: deque[str] = field(default_factory=deque)

    def end(self) -> None:
        """End the process now, whatever it is doing."""
        self.process.terminate()
        self.process.join(_PATIENCE_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.answers.close()


def usable_cpus() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def outcomes_of(trials: Iterable[Trial], workers: int, work: Work = run_trial) -> Generator[Outcome, None, None]:
    """Yield the outcome of every estimator of every trial as each is there, from ``workers`` processes at a time.

    ``work`` must be a module's function, and yield one outcome for each estimator of its trial, in order. An error it
    raises ends everything: a VislamError is raised again here, any other as RuntimeError with its traceback. When
    the iteration ends, for whatever reason, no process is left.
    """
    waiting = deque(trials)
    busy: dict[Connection, _Worker] = {}
    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                worker = _start(waiting.popleft(), work)
                busy[worker.answers] = worker
            for ready in wait(list(busy)):
                worker = busy[ready]  # type: ignore[index]  # wait returns what it was given
                answer = _next_answer(worker)
                if isinstance(answer, Outcome):
                    worker.open.remove(answer.estimator)
                    yield answer
                    continue
                del busy[worker.answers]
                worker.end()
                if worker.open:
                    yield _lost(worker)
                    waiting.extendleft(_rest(worker))
    finally:
        for worker in busy.values():
            worker.end()


def _next_answer(worker: _Worker) -> Outcome | None:
    """Return what the process says next, None where it has ended; raise what it raised."""
    try:
        answer: Outcome | _Raised = worker.answers.recv()
    except (EOFError, OSError):
        worker.process.join(_PATIENCE_S)
        return None
    if isinstance(answer, _Raised):
        raise answer.expected or RuntimeError(answer.text)
    return answer


def _lost(worker: _Worker) -> Outcome:
    """Return the outcome of the run the process was busy with when it died."""
    code = worker.process.exitcode or 0
    how = f"was ended by signal {-code}" if code < 0 else f"ended with status {code}"
    return Outcome(worker.trial.seed, worker.open[0], "failed", log=(f"its process {how} before it answered",))


def _rest(worker: _Worker) -> list[Trial]:
    """Return the trial with the estimators behind the one that was lost, if there are any."""
    remaining = tuple(worker.open)[1:]
    return [replace(worker.trial, estimators=remaining)] if remaining else []


def _start(trial: Trial, work: Work) -> _Worker:
    answers, says = _CONTEXT.Pipe(duplex=False)
    process = _CONTEXT.Process(target=_run, args=(says, trial, work), daemon=True)
    try:
        with _one_thread(), _interrupts_held_back():
            _CONTEXT.set_forkserver_preload([__name__, "toolkit.initialization"])
            process.start()
    except KeyboardInterrupt:  # the one held back, perhaps: then there is a process that nobody knows of yet
        if process.pid is not None:
            process.terminate()
        raise
    says.close()  # ours: the end of the process must be the end of the pipe
    return _Worker(trial, process, answers, deque(trial.estimators))


def _run(says: Connection, trial: Trial, work: Work) -> None:
    """Work on a trial and say each outcome; the process' whole life."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        for outcome in work(trial):
            says.send(outcome)
    except BrokenPipeError:
        pass  # nobody listens any more
    except MemoryError:
        os._exit(1)
    except Exception as error:
        expected = error if isinstance(error, VislamError) else None
        says.send(_Raised("".join(traceback.format_exception(error)), expected))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Have processes started here read that numeric libraries may use one thread."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(_ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Have processes started here be deaf to Ctrl-C from birth; one that comes meanwhile is delivered afterwards."""
    resource_tracker.ensure_running()  # else it is started within, and lifts the block when it is
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
