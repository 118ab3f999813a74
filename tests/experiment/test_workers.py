"""Many processes give what one gives, and what goes wrong in one of them stays there."""

import os
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.experiment.units import Outcome, Scored, run_unit
from toolkit.experiment.workers import LostUnit, results_of
from toolkit.metrics import cost
from toolkit.progress import SILENT, Progress
from toolkit.verify import arrays_of

Jobs = Callable[..., list[Any]]

_WORK = """
import os, signal, time
from pathlib import Path
from typing import NamedTuple
from toolkit.errors import DataError

class Job(NamedTuple):
    estimator: str
    seed: int

MARK = Path(__file__).with_name("mark")

def dies(unit, progress):
    if (unit.estimator, unit.seed) == ("ekf", 1):
        with MARK.open("a") as mark:
            mark.write("tried ")
        os.kill(os.getpid(), signal.SIGKILL)
    return unit.estimator, unit.seed

def dies_once(unit, progress):
    if (unit.estimator, unit.seed) == ("ekf", 1) and not MARK.exists():
        MARK.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return unit.estimator, unit.seed

def is_short_of_memory(unit, progress):
    if unit.seed == 1:
        raise MemoryError
    return unit.seed

def refuses(unit, progress):
    if unit.seed == 1:
        raise DataError("nothing to see")
    time.sleep(600)

def is_broken(unit, progress):
    raise ZeroDivisionError("a defect")

def tells_threads(unit, progress):
    return tuple(os.environ[name] for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"))

def names_its_process(unit, progress):
    time.sleep(0.02 * (unit.estimator == "ekf"))
    return os.getpid()

def leaves_a_mark(unit, progress):
    MARK.with_name(f"done {unit.seed}").touch()

def goes_on(unit, progress):
    for done in range(4):
        progress.advance(done, 4)
        while done == 2 and not MARK.exists():
            time.sleep(0.005)
    return unit.seed
"""
_COST = {metric.key for metric in cost.METRICS}


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """Return work for the processes, in a module that they can import as well."""
    (tmp_path / "work_for_tests.py").write_text(_WORK)
    monkeypatch.syspath_prepend(str(tmp_path))
    import work_for_tests

    yield work_for_tests
    del sys.modules["work_for_tests"]


@pytest.fixture
def jobs(work: ModuleType) -> Jobs:
    """Return a function that makes work as named as units are; a process needs to import next to nothing for it."""

    def make(seeds: tuple[int, ...], estimators: tuple[str, ...] = ("dead-reckoning", "ekf")) -> list[Any]:
        return [work.Job(name, seed) for seed in seeds for name in estimators]

    return make


def by_place(units: list[Any], workers: int, work: Any) -> list[Any]:
    """Return the results in the order of the units, each of which must come exactly once."""
    found = list(results_of(units, workers, work, SILENT))
    assert sorted(place for place, _ in found) == list(range(len(units)))
    return [result for _, result in sorted(found, key=lambda pair: pair[0])]


def test_processes_equal_one_process_bit_for_bit(units):
    """Several seeds and several estimators, a smoother with them: scores, trajectories and landmarks."""
    requested = units((0, 1), ("dead-reckoning", "ekf", "batch"))
    for one, other in zip(by_place(requested, 2, run_unit), by_place(requested, 1, run_unit), strict=True):
        _assert_equal(one, other)


def _assert_equal(one: Outcome, other: Outcome) -> None:
    for name in ("seed", "estimator", "status", "sequence_hash", "final_is_causal"):
        assert getattr(one, name) == getattr(other, name)
    # Which process compiles first depends on what was compiled before.
    assert [[line for line in side.log if "was compiled" not in line] for side in (one, other)] == [[], []]
    assert one.outputs.keys() == other.outputs.keys() != set()
    assert [*map(_but_cost, one.outputs.values())] == [*map(_but_cost, other.outputs.values())]
    for mine, theirs in zip(_answers(one), _answers(other), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def _answers(outcome: Outcome) -> Iterator[np.ndarray]:
    """Yield every array of scores, trajectories and landmarks."""
    for scored in outcome.outputs.values():
        yield from arrays_of(scored)
    yield from arrays_of((outcome.run.causal, outcome.run.final, outcome.run.landmarks))


def _but_cost(scored: Scored) -> dict[str, float | None]:
    return {key: value for key, value in scored.scores.values.items() if key not in _COST}


def test_a_process_that_dies_twice_loses_its_unit_and_no_other(jobs, work, tmp_path):
    results = by_place(jobs((0, 1), ("dead-reckoning", "ekf", "batch")), 2, work.dies)
    assert results[4] == LostUnit("its process was ended by signal 9 before it answered")
    del results[4]
    assert results == [(name, 0) for name in ("dead-reckoning", "ekf", "batch")] + [("dead-reckoning", 1), ("batch", 1)]
    assert (tmp_path / "mark").read_text() == "tried tried "


def test_a_process_that_dies_once_loses_nothing(jobs, work):
    results = by_place(jobs((0, 1)), 2, work.dies_once)
    assert results == [(name, seed) for seed in (0, 1) for name in ("dead-reckoning", "ekf")]


def test_a_unit_without_memory_is_lost_alone(jobs, work):
    kept, lost = by_place(jobs((0, 1), ("ekf",)), 2, work.is_short_of_memory)
    assert (kept, type(lost)) == (0, LostUnit)


def test_an_error_of_the_recording_ends_everything_at_once(jobs, work):
    began = time.monotonic()
    with pytest.raises(DataError, match="nothing to see"):
        list(results_of(jobs((0, 1), ("ekf",)), 2, work.refuses, SILENT))
    assert time.monotonic() - began < 300.0  # the other process, asleep for ten minutes, was not waited for


def test_a_defect_is_reported_with_the_traceback_of_its_process(jobs, work):
    with pytest.raises(ZeroDivisionError, match="a defect") as raised:
        list(results_of(jobs((0,)), 2, work.is_broken, SILENT))
    assert "in is_broken" in str(raised.value.__cause__)


def test_every_process_has_one_numeric_thread_and_ours_is_left_alone(jobs, work, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    assert by_place(jobs((0,)), 2, work.tells_threads) == [("1", "1", "1")] * 2
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


def test_a_process_that_has_a_recording_ready_gets_what_needs_it_while_others_have_other_work(jobs, work):
    """Two processes, six seeds: only at the end may both have worked on one seed."""
    requested = jobs(tuple(range(6)), ("batch", "ekf", "riekf"))
    found = dict(results_of(requested, 2, work.names_its_process, SILENT, lambda job: job.seed))
    processes = [{found[place] for place, job in enumerate(requested) if job.seed == seed} for seed in range(6)]
    assert sorted(map(len, processes))[:5] == [1] * 5


def test_processes_go_on_while_the_reader_of_their_results_is_busy(jobs, work, tmp_path):
    coming = results_of(jobs(tuple(range(20)), ("ekf",)), 2, work.leaves_a_mark, SILENT)
    next(coming)
    _wait_until(lambda: len(list(tmp_path.glob("done *"))) == 20)
    assert len(list(coming)) == 19


@pytest.mark.parametrize("workers", [1, 2])
def test_progress_is_that_of_all_units_and_never_goes_back(jobs, work, workers):
    received: list[tuple[int, int]] = []

    class Listening:
        def advance(self, done: int, total: int, stage: str = "") -> None:
            received.append((done, total))
            if done:
                work.MARK.touch()  # no unit ends before it was heard of

    requested = jobs((0, 1), ("ekf",))
    assert sorted(result for _, result in results_of(requested, workers, work.goes_on, Listening())) == [0, 1]
    shares = [done / total for done, total in received]
    assert shares == sorted(shares)
    assert len({total for _, total in received}) == 1
    assert any(0.0 < share < 0.5 for share in shares)
    assert shares[-1] == 1.0 or workers == 1


def test_a_stage_before_the_first_frame_is_no_half_of_a_run_and_a_second_solve_undoes_nothing() -> None:
    """As while an estimator compiles; a stage after the frames is a smoother's solve, the second half."""
    received: list[tuple[int, int, str]] = []

    class Listening:
        def advance(self, done: int, total: int, stage: str = "") -> None:
            received.append((done, total, stage))

    def works(_unit: int, progress: Progress) -> None:
        progress.advance(0, 1, "compiling")
        progress.advance(1, 2)
        progress.advance(0, 9, "solving")
        progress.advance(9, 9, "solving")
        progress.advance(0, 9, "solving anew")

    list(results_of([0], 1, works, Listening()))
    assert received[:3] == [(0, 100, "compiling"), (25, 100, ""), (50, 100, "solving, iteration 1")]
    assert received[3:] == [(100, 100, "solving, iteration 10"), (100, 100, "solving anew, iteration 1")]


def test_no_process_outlives_one_that_is_killed(tmp_path, starts_group):
    program = textwrap.dedent("""
        import time
        from toolkit.experiment.workers import Workers
        from toolkit.progress import SILENT
        workers = Workers(2)
        list(workers.results([1, 2], lambda unit, progress: unit, SILENT))
        print("started", flush=True)
        time.sleep(600)
    """)
    parent = starts_group(("-c", program), tmp_path, {"TMPDIR": str(tmp_path)})
    assert parent.stdout.readline() == "started\n"
    parent.kill()
    parent.wait()
    _assert_gone(parent.pid)


def _assert_gone(group: int) -> None:
    def gone() -> bool:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        return False

    _wait_until(gone)


def _wait_until(reached: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 300.0  # generous: a machine under load is no reason to fail
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.01)
