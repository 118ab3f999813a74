"""Many processes give what one gives, and what goes wrong in one of them stays there."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.experiment.monte_carlo import in_order
from toolkit.experiment.trial import run_trial
from toolkit.experiment.workers import outcomes_of

_WORK = """
import os, signal, time
from toolkit.errors import DataError
from toolkit.experiment.trial import Outcome

def dies(trial):
    for name in trial.estimators:
        if name == "ekf" and trial.seed == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        yield Outcome(trial.seed, name, "ok")

def leaves(trial):
    os._exit(3)
    yield

def refuses(trial):
    if trial.seed == 1:
        raise DataError("nothing to see")
    time.sleep(60)
    yield

def is_broken(trial):
    raise ZeroDivisionError("a defect")
    yield

def tells_threads(trial):
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    for name in trial.estimators:
        yield Outcome(trial.seed, name, "ok", log=tuple(os.environ[n] for n in names))
"""
_MEASURED = ("frame_ms_mean", "frame_ms_p95", "frame_ms_max", "total_s", "cpu_s", "peak_rss_mb")


@pytest.fixture
def work(tmp_path, monkeypatch):
    """Return work for the processes, in a module that they can import as well."""
    (tmp_path / "work_for_tests.py").write_text(_WORK)
    monkeypatch.syspath_prepend(str(tmp_path))
    import work_for_tests

    yield work_for_tests
    del sys.modules["work_for_tests"]


def test_three_seeds_in_processes_equal_three_single_runs_exactly(trials):
    estimators, seeds = ("dead-reckoning", "ekf"), (0, 1, 2)
    swept = in_order(outcomes_of(trials(seeds, estimators), workers=2), estimators, seeds)
    single = in_order((o for trial in trials(seeds, estimators) for o in run_trial(trial)), estimators, seeds)
    assert len(swept) == 6
    for one, other in zip(swept, single, strict=True):
        for name in ("seed", "estimator", "status", "log", "sequence_hash"):
            assert getattr(one, name) == getattr(other, name)
        assert one.outputs.keys() == other.outputs.keys() == {"causal", "final"}
        for output, scored in one.outputs.items():
            assert _but_cost(scored) == _but_cost(other.outputs[output])
            np.testing.assert_array_equal(scored.nees_pose, other.outputs[output].nees_pose)
            np.testing.assert_array_equal(scored.position_m, other.outputs[output].position_m)
    assert len({o.sequence_hash for o in swept}) == 3


def _but_cost(scored):
    return {key: value for key, value in scored.scores.values.items() if key not in _MEASURED}


def test_a_process_that_dies_fails_its_run_and_no_other(trials, work):
    estimators = ("dead-reckoning", "ekf", "batch")
    outcomes = in_order(outcomes_of(trials((0, 1), estimators), 2, work.dies), estimators, (0, 1))
    assert [o.status for o in outcomes] == ["ok", "ok", "ok", "failed", "ok", "ok"]
    assert outcomes[3].log == ("its process was ended by signal 9 before it answered",)


def test_a_process_that_leaves_without_a_word_fails_every_run_once(trials, work):
    outcomes = list(outcomes_of(trials((0,)), 1, work.leaves))
    assert [(o.estimator, o.status) for o in outcomes] == [("dead-reckoning", "failed"), ("ekf", "failed")]
    assert outcomes[0].log == ("its process ended with status 3 before it answered",)


def test_an_error_of_the_recording_ends_everything_at_once(trials, work):
    began = time.monotonic()
    with pytest.raises(DataError, match="nothing to see"):
        list(outcomes_of(trials((0, 1)), 2, work.refuses))
    assert time.monotonic() - began < 30.0  # the other process, asleep for a minute, was not waited for


def test_a_defect_is_told_with_its_traceback(trials, work):
    with pytest.raises(RuntimeError, match="ZeroDivisionError: a defect"):
        list(outcomes_of(trials((0,)), 1, work.is_broken))


def test_every_process_has_one_numeric_thread_and_ours_is_left_alone(trials, work, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    outcomes = list(outcomes_of(trials((0,)), 1, work.tells_threads))
    assert outcomes[0].log == ("1", "1", "1")
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


# While the fork server imports, and while the trials run.
@pytest.mark.parametrize("delay_s", [0.2, 3.0])
def test_an_interrupt_is_130_in_one_line_and_leaves_neither_file_nor_process(tmp_path, delay_s):
    program = textwrap.dedent("""
        import sys, threading
        from toolkit.cli import main
        from toolkit.experiment import workers
        start = workers._start
        def told(*given):
            print("starting", flush=True)
            return start(*given)
        workers._start = told
        sys.exit(main(["compare", "drive", "--seeds", "50", "--estimators", "ekf,batch", "--out", "run"]))
    """)
    vislam = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert vislam.stdout is not None
    assert vislam.stdout.readline() == "starting\n"
    time.sleep(delay_s)
    os.killpg(vislam.pid, signal.SIGINT)  # as a terminal does: to every process of the group
    _, told = vislam.communicate(timeout=60)
    assert vislam.returncode == 130
    assert told == "vislam: error: interrupted; what was not finished is not written\n"
    assert list(Path(tmp_path).iterdir()) == []
    _assert_gone(vislam.pid)


def _assert_gone(group):
    for _ in range(100):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    raise AssertionError("a process is left")
