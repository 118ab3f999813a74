"""The runner: what it keeps, how it sets the status, what it checks, and that one estimator's failure stays its own."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np
import pytest

from toolkit import runner
from toolkit.answers import Run
from toolkit.errors import EstimatorError
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.measurements import Packet
from toolkit.progress import SILENT
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, noise_free, simulate

FRAMES = 11
Answer = Callable[[Estimate, Packet], Any]
End = Callable[[Finished], Any]


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return simulate(noise_free(replace(DRIVE, duration_s=(FRAMES - 1) / 10.0)), 0)


def run(
    sequence: Sequence, answer: Answer = lambda sound, _: sound, end: End = lambda sound: sound, progress: Any = SILENT
) -> Run:
    """Run an estimator that knows the truth and says it, each answer and the end changed in some way."""

    class Spoiled:
        def __init__(self) -> None:
            self.sound = list[Estimate]()

        def step(self, packet: Packet) -> Any:
            T_world_imu, info = np.array(sequence.truth.T_world_imu[packet.index]), {"nis": float(packet.index)}
            self.sound.append(Estimate(packet.frame.t_ns, T_world_imu, cov=np.eye(6), info=info))
            return answer(self.sound[-1], packet)

        def finish(self) -> Any:
            return end(Finished(Trajectory.of(self.sound), Landmarks.none(), log=("all is well",)))

    def build(setup: Setup) -> Estimator:
        assert setup.prior is sequence.prior
        return Spoiled()

    return runner.run("some", build, sequence, sequence.prior, progress)


def raising(error: BaseException, at: int = 0) -> Answer:
    """Return what raises an error at a frame, and at the end."""

    def answer(sound: Estimate | Finished, packet: Packet | None = None) -> Estimate:
        if packet is None or packet.index == at:
            raise error
        return sound

    return answer


def test_both_outputs_landmarks_diagnostics_and_log_are_kept(sequence):
    calls: list[tuple[int, int]] = []
    done = run(sequence, progress=SimpleNamespace(advance=lambda *counts: calls.append(counts)))
    assert calls == [(k + 1, FRAMES) for k in range(FRAMES)]
    assert (done.estimator, done.status, done.log) == ("some", "ok", ("all is well",))
    for output in ("causal", "final"):
        np.testing.assert_array_equal(done.trajectory(output).T_world_imu, sequence.truth.T_world_imu)
    np.testing.assert_array_equal(done.info["nis"], np.arange(FRAMES))


def test_who_answers_only_at_the_end_has_no_causal_output_and_who_never_does_has_failed(sequence):
    done = run(sequence, lambda sound, _: None)
    assert (done.causal, done.status, done.info) == (None, "ok", {})
    nothing = run(sequence, lambda sound, _: None, lambda _: Finished(Trajectory.of([]), Landmarks.none()))
    assert nothing.status == "failed" and "it returned no estimate for any frame" in nothing.log[0]


def test_an_error_ends_the_run_with_its_reason_and_what_was_reported_before(sequence):
    done = run(sequence, raising(ZeroDivisionError("the map is empty"), at=5))
    assert done.status == "failed"
    assert done.log[0] == "failed after 5 estimates: ZeroDivisionError: the map is empty"
    assert any("test_runner.py" in line for line in done.log[1:]), "a defect keeps its traceback"
    assert done.final is None
    np.testing.assert_array_equal(done.causal.t_ns, sequence.frames_t_ns[:5])


# As GTSAM words it: an empty line, what it found, and a paragraph of advice.
OF_GTSAM = "\nIndeterminate linear system near variable\n77 (Symbol: l7).\n\nThe most common cause is\nsomething else."


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (RuntimeError(OF_GTSAM), "RuntimeError: Indeterminate linear system near variable 77 (Symbol: l7)."),
        (ValueError(), "ValueError"),
        (np.linalg.LinAlgError("Singular"), "rounding left a matrix without a root or an inverse (LinAlgError: Sing"),
        (SystemExit(3), "SystemExit: 3"),
        (EstimatorError("the smoother's error\nis not a number"), "the smoother's error is not a number"),
    ],
)
def test_the_reason_of_a_failed_run_is_one_line_that_says_what_happened(error, reason, sequence):
    line = run(sequence, end=raising(error)).log[0]
    assert line.startswith(f"failed after {FRAMES} estimates: {reason}") and "\n" not in line


def test_a_run_is_checked_by_what_it_gave_alone(sequence):
    """Judging a run again, as from a file, gives the status and the reasons it had."""
    poses = np.tile(np.eye(4), (sequence.frame_count, 1, 1))
    poses[::2, 0, 3] = 50.0
    astray = Trajectory(sequence.frames_t_ns, poses)
    of_file = Run("astray", "ok", astray, astray, Landmarks.none(), None)
    again = runner.with_divergence(of_file, sequence)
    assert again.status == "diverged"
    assert again.log[-1].startswith("the trajectory diverged: ")
    assert runner.with_divergence(replace(of_file, causal=None), sequence).log == again.log


def test_a_solve_that_did_not_converge_is_a_failure_that_is_still_shown(sequence):
    done = run(sequence, end=lambda sound: replace(sound, converged=False))
    assert done.status == "failed"
    assert "did not converge" in done.log[0], "a failed run begins with the reason"
    assert done.log[1] == "all is well"
    assert done.final is not None


def test_a_slow_step_shows_in_the_timings(sequence, monkeypatch):
    """By a clock of its own: on a busy machine any step may take long."""
    clock = SimpleNamespace(now_s=0.0, perf_counter=lambda: clock.now_s, process_time=time.process_time)
    monkeypatch.setattr(runner, "time", clock)

    def slow(sound: Any, packet: Packet | None = None) -> Any:
        clock.now_s += 0.03 if packet is None else 0.05 if packet.index == 4 else 0.001
        return sound

    timings = run(sequence, slow, slow).timings
    np.testing.assert_allclose(timings.step_s, np.where(np.arange(FRAMES) == 4, 0.05, 0.001), rtol=1e-9)
    assert timings.finish_s == pytest.approx(0.03)
    assert timings.total_s == pytest.approx(timings.step_s.sum() + timings.finish_s)


def test_a_pause_counts_in_the_time_and_not_in_the_processors(sequence):
    timings = run(sequence, end=lambda sound: time.sleep(0.05) or sound).timings
    assert timings.finish_s >= 0.05
    assert timings.cpu_s < timings.total_s, "sleeping is no work"
    assert timings.peak_rss_mb > 10.0


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="this system cannot count a peak anew")
def test_memory_that_earlier_work_took_is_not_counted(sequence, counts_memory_anew):
    before_mb = run(sequence).timings.peak_rss_mb
    earlier = np.ones(25_000_000)
    del earlier
    # 200 MB, of which such a run takes none.
    assert run(sequence).timings.peak_rss_mb < before_mb + 100.0


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_the_user_and_the_machine_can_stop_it(sequence, error):
    with pytest.raises(error):
        run(sequence, raising(error()))


def test_an_interrupt_that_compiled_code_wraps_is_no_failure_of_the_estimator(sequence):
    def interrupted(*_: object) -> NoReturn:
        try:
            raise SystemError("unpickling returned a result with an exception set") from KeyboardInterrupt()
        except SystemError as inner:
            raise SystemError("compiled code returned a result with an exception set") from inner

    with pytest.raises(KeyboardInterrupt):
        run(sequence, interrupted)


def test_answers_of_the_documented_shapes_pass(sequence):
    whole = run(sequence, lambda sound, _: replace(sound, cov=np.eye(15), v_world=np.zeros(3), bias=np.zeros(6)))
    assert whole.causal.cov.shape == (FRAMES, 15, 15)
    assert run(sequence, lambda sound, _: replace(sound, t_ns=np.int64(sound.t_ns), info={"nis": np.float32(2)})).causal


# What a line must say, in parts, of an answer that is not as documented.
ANSWERS: dict[tuple[str, ...], Answer] = {
    ("frame 0 is a tuple; step returns an Estimate or None",): lambda sound, _: (sound.t_ns, sound.T_world_imu),
    ("T_world_imu", "frame 0 has shape (3, 3); expected"): lambda sound, _: replace(sound, T_world_imu=np.eye(3)),
    ("T_world_imu of its answer to frame 0 is None",): lambda sound, _: replace(sound, T_world_imu=None),
    ("is a list; it is an",): lambda sound, _: replace(sound, T_world_imu=sound.T_world_imu.tolist()),
    ("has the type complex128",): lambda sound, _: replace(sound, T_world_imu=sound.T_world_imu.astype(complex)),
    ("t_ns of its answer to frame 0", "in whole ns"): lambda sound, _: replace(sound, t_ns=sound.t_ns / 1e9),
    ("expected (6, 6) or (9, 9) or (12, 12) or (15, 15)",): lambda sound, _: replace(sound, cov=np.eye(3)),
    ("frame 1 has shape (9, 9), and",): lambda sound, packet: replace(sound, cov=np.eye(9 if packet.index else 6)),
    ("bias of its answer to frame 0 has shape (6, 1)",): lambda sound, _: replace(sound, bias=np.zeros((6, 1))),
    ("info of its answer to frame 0 is a list",): lambda sound, _: replace(sound, info=[1.0]),
    ("has 'nis': '1'; it is a dict of numbers by name",): lambda sound, _: replace(sound, info={"nis": "1"}),
}


@pytest.mark.parametrize(("parts", "answer"), ANSWERS.items())
def test_a_step_that_answers_otherwise_fails_its_run_and_nothing_else(sequence, parts, answer):
    done = run(sequence, answer)
    assert done.status == "failed"
    assert all(part in done.log[0] for part in parts), done.log
    assert len(done.log) == 1  # the line says it; a traceback would be of ours


def of_trajectory(**changed: Any) -> End:
    return lambda sound: replace(sound, trajectory=replace(sound.trajectory, **changed))


ONE_POINT_OF_TWO = Landmarks(np.arange(2), np.zeros((1, 3)))
ENDS: dict[str, End] = {
    "finish returned a Trajectory; it must return a Finished": lambda sound: sound.trajectory,
    "the trajectory of its finish is a list": lambda sound: replace(sound, trajectory=[]),
    "the landmarks of its finish are None": lambda sound: replace(sound, landmarks=None),
    "the log of its finish is a str": lambda sound: replace(sound, log="all is well"),
    "T_world_imu of its final trajectory has shape (4, 4); expected": of_trajectory(T_world_imu=np.eye(4)),
    "the stamps of its final trajectory are not those of frames": of_trajectory(t_ns=np.arange(FRAMES)),
    "points_world of its landmarks has shape (1, 3); expected": lambda s: replace(s, landmarks=ONE_POINT_OF_TWO),
}


@pytest.mark.parametrize(("why", "end"), ENDS.items())
def test_a_finish_that_answers_otherwise_fails_its_run_and_keeps_the_causal_answers(sequence, why, end):
    done = run(sequence, end=end)
    assert done.status == "failed"
    assert why in done.log[0]
    assert len(done.causal) == FRAMES
