"""The runner: what it keeps, how it sets the status, and that one estimator's failure stays its own."""

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from toolkit import runner
from toolkit.answers import Run
from toolkit.errors import DataError, EstimatorError
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.measurements import Packet
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, noise_free, simulate

FRAMES = 11


class Perfect:
    """Knows the truth and says it; the estimators below each spoil one thing."""

    def __init__(self, poses: np.ndarray) -> None:
        self.poses, self.reported = poses, []

    def step(self, packet: Packet) -> Estimate | None:
        self.reported.append(Estimate(packet.frame.t_ns, self.poses[packet.index], info={"nis": float(packet.index)}))
        return self.reported[-1]

    def finish(self) -> Finished:
        return Finished(Trajectory.of(self.reported), Landmarks.none(), log=("all is well",))


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return simulate(noise_free(replace(DRIVE, duration_s=(FRAMES - 1) / 10.0)), 0)


class Received:
    def __init__(self) -> None:
        self.calls = []

    def advance(self, done: int, total: int) -> None:
        self.calls.append((done, total))


def run(kind: type[Perfect], sequence: Sequence, progress: Received | None = None) -> Run:
    def build(setup: Setup) -> Estimator:
        assert setup.prior is sequence.prior
        return kind(sequence.truth.T_world_imu)

    return runner.run("some", build, sequence, sequence.prior, progress or Received())


def test_both_outputs_landmarks_diagnostics_and_log_are_kept(sequence):
    done = run(Perfect, sequence)
    assert (done.estimator, done.status, done.log) == ("some", "ok", ("all is well",))
    for output in ("causal", "final"):
        np.testing.assert_array_equal(done.trajectory(output).T_world_imu, sequence.truth.T_world_imu)
    np.testing.assert_array_equal(done.info["nis"], np.arange(FRAMES))


def test_progress_hears_every_frame(sequence):
    received = Received()
    run(Perfect, sequence, received)
    assert received.calls == [(k + 1, FRAMES) for k in range(FRAMES)]


class AtTheEnd(Perfect):
    def step(self, packet: Packet) -> Estimate | None:
        super().step(packet)
        return None


def test_who_answers_only_at_the_end_has_no_causal_output(sequence):
    done = run(AtTheEnd, sequence)
    assert done.causal is None
    assert done.status == "ok"
    assert done.info == {}


class Breaks(Perfect):
    def step(self, packet: Packet) -> Estimate | None:
        if packet.index == 5:
            raise ZeroDivisionError("the map is empty")
        return super().step(packet)


def test_an_error_ends_the_run_with_its_reason_and_what_was_reported_before(sequence):
    done = run(Breaks, sequence)
    assert done.status == "failed"
    assert done.log[0] == "failed after 5 estimates: ZeroDivisionError: the map is empty"
    assert any("test_runner.py" in line for line in done.log[1:]), "a defect keeps its traceback"
    assert done.final is None
    np.testing.assert_array_equal(done.causal.t_ns, sequence.frames_t_ns[:5])


class CannotGoOn(Perfect):
    def finish(self) -> Finished:
        raise EstimatorError("the smoother's error is not a number")


def test_an_estimator_that_cannot_go_on_says_why_in_one_line(sequence):
    done = run(CannotGoOn, sequence)
    assert done.status == "failed"
    assert done.log == (f"failed after {FRAMES} estimates: the smoother's error is not a number",)


# As GTSAM words it: an empty line, what it found, and a paragraph of advice.
OF_GTSAM = "\nIndeterminate linear system near variable\n77 (Symbol: l7).\n\nThe most common cause is\nsomething else."


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (RuntimeError(OF_GTSAM), "RuntimeError: Indeterminate linear system near variable 77 (Symbol: l7)."),
        (EstimatorError("no\nway"), "no way"),
        (ValueError(), "ValueError"),
        (
            np.linalg.LinAlgError("Singular matrix"),
            "rounding left a matrix without a root or an inverse (LinAlgError: Singular matrix); the usual cause is a "
            "stated noise far below the errors of the measurements: set a larger one "
            "(noise.pixel_sigma_px, noise.motion_scale)",
        ),
    ],
)
def test_the_reason_of_a_failed_run_is_one_line_that_says_what_happened(error, reason, sequence):
    class Ends(Perfect):
        def finish(self) -> Finished:
            raise error

    assert run(Ends, sequence).log[0] == f"failed after {FRAMES} estimates: {reason}"


def test_a_run_is_checked_by_what_it_gave_alone(sequence):
    """Judging a run again, as from a file, gives the status and the reasons it had."""
    poses = np.tile(np.eye(4), (sequence.frame_count, 1, 1))
    poses[::2, 0, 3] = 50.0
    astray = Trajectory(sequence.frames_t_ns, poses)
    run = Run("astray", "ok", astray, astray, Landmarks.none(), None)
    again = runner.with_divergence(run, sequence)
    assert again.status == "diverged"
    assert again.log[-1].startswith("the trajectory diverged: ")
    assert runner.with_divergence(replace(run, causal=None), sequence).log == again.log


class Unconverged(Perfect):
    def finish(self) -> Finished:
        return replace(super().finish(), converged=False)


def test_a_solve_that_did_not_converge_is_a_failure_that_is_still_shown(sequence):
    done = run(Unconverged, sequence)
    assert done.status == "failed"
    assert "did not converge" in done.log[0], "a failed run begins with the reason"
    assert done.log[1] == "all is well"
    assert done.final is not None


class Slow(Perfect):
    passed_s = 0.0

    def step(self, packet: Packet) -> Estimate | None:
        Slow.passed_s += 0.05 if packet.index == 4 else 0.001
        return super().step(packet)

    def finish(self) -> Finished:
        Slow.passed_s += 0.03
        return super().finish()


def test_a_slow_step_shows_in_the_timings(sequence, monkeypatch):
    """By a clock of its own: on a busy machine any step may take long."""
    clock = SimpleNamespace(perf_counter=lambda: Slow.passed_s, process_time=time.process_time)
    monkeypatch.setattr(runner, "time", clock)
    timings = run(Slow, sequence).timings
    np.testing.assert_allclose(timings.step_s, np.where(np.arange(FRAMES) == 4, 0.05, 0.001), rtol=1e-9)
    assert timings.finish_s == pytest.approx(0.03)
    assert timings.total_s == pytest.approx(timings.step_s.sum() + timings.finish_s)


class Sleeping(Perfect):
    def finish(self) -> Finished:
        time.sleep(0.05)
        return super().finish()


def test_a_pause_counts_in_the_time_and_not_in_the_processors(sequence):
    timings = run(Sleeping, sequence).timings
    assert timings.finish_s >= 0.05
    assert timings.cpu_s < timings.total_s, "sleeping is no work"
    assert timings.peak_rss_mb > 10.0


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="this system cannot count a peak anew")
def test_memory_that_earlier_work_took_is_not_counted(sequence, counts_memory_anew):
    before_mb = run(Perfect, sequence).timings.peak_rss_mb
    earlier = np.ones(25_000_000)
    del earlier
    # 200 MB, of which such a run takes none.
    assert run(Perfect, sequence).timings.peak_rss_mb < before_mb + 100.0


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_the_user_and_the_machine_can_stop_it(sequence, error):
    class Stopped(Perfect):
        def step(self, packet: Packet) -> Estimate | None:
            raise error

    with pytest.raises(error):
        run(Stopped, sequence)


def test_an_interrupt_that_compiled_code_wraps_is_no_failure_of_the_estimator(sequence):
    class Interrupted(Perfect):
        def step(self, packet: Packet) -> Estimate | None:
            try:
                raise SystemError("unpickling returned a result with an exception set") from KeyboardInterrupt()
            except SystemError as inner:
                raise SystemError("compiled code returned a result with an exception set") from inner

    with pytest.raises(KeyboardInterrupt):
        run(Interrupted, sequence)


def test_a_sequence_that_cannot_be_run_is_the_datas_fault_not_the_estimators(sequence):
    backwards = replace(sequence, frames_t_ns=sequence.frames_t_ns[::-1])
    with pytest.raises(DataError, match="not after the one before"):
        run(Perfect, backwards)
