"""What an estimator answers is of the documented types and shapes, or its run fails with a line that says so."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from toolkit import runner
from toolkit.answers import Run
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.measurements import Packet
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, simulate

FRAMES = 6
Answer = Callable[[Estimate, Packet], Any]
End = Callable[[Finished], Any]


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return simulate(replace(DRIVE, duration_s=(FRAMES - 1) / 10.0), 0)


def builder(sequence: Sequence, answer: Answer, end: End) -> Callable[[Setup], Estimator]:
    """Return what builds an estimator that knows the truth and answers in its own way."""

    class Spoiled:
        def __init__(self) -> None:
            self.sound = list[Estimate]()

        def step(self, packet: Packet) -> Any:
            T_world_imu = np.array(sequence.truth.T_world_imu[packet.index])
            self.sound.append(Estimate(packet.frame.t_ns, T_world_imu, cov=np.eye(6), info={"nis": 1.0}))
            return answer(self.sound[-1], packet)

        def finish(self) -> Any:
            return end(Finished(Trajectory.of(self.sound), Landmarks.none()))

    return lambda setup: Spoiled()


def run(sequence: Sequence, answer: Answer = lambda sound, packet: sound, end: End = lambda sound: sound) -> Run:
    return runner.run("spoiled", builder(sequence, answer, end), sequence, sequence.prior)


def test_answers_of_the_documented_shapes_pass(sequence: Sequence) -> None:
    assert run(sequence).status == "ok"
    whole = run(sequence, lambda sound, _: replace(sound, cov=np.eye(15), v_world=np.zeros(3), bias=np.zeros(6)))
    assert whole.causal.cov.shape == (FRAMES, 15, 15)
    assert run(sequence, lambda sound, _: replace(sound, t_ns=np.int64(sound.t_ns), info={"nis": np.float32(2)})).causal


ANSWERS: dict[str, Answer] = {
    "frame 0 is a tuple; step returns an": lambda sound, _: (sound.t_ns, sound.T_world_imu),
    "T_world_imu .* frame 0 has shape (3, 3); expec": lambda sound, _: replace(sound, T_world_imu=np.eye(3)),
    "T_world_imu of its answer to frame 0 is None": lambda sound, _: replace(sound, T_world_imu=None),
    "is a list; it is an": lambda sound, _: replace(sound, T_world_imu=sound.T_world_imu.tolist()),
    "has the type complex128": lambda sound, _: replace(sound, T_world_imu=sound.T_world_imu.astype(complex)),
    "t_ns of its answer to frame 0 is .* in whole ns": lambda sound, _: replace(sound, t_ns=sound.t_ns / 1e9),
    "expected (6, 6) or (9, 9) or (12, 12) or (15, 15)": lambda sound, _: replace(sound, cov=np.eye(3)),
    "frame 1 has shape (9, 9), and": lambda sound, packet: replace(sound, cov=np.eye(9 if packet.index else 6)),
    "bias of its answer to frame 0 has shape (6, 1)": lambda sound, _: replace(sound, bias=np.zeros((6, 1))),
    "info of its answer to frame 0 is a list": lambda sound, _: replace(sound, info=[1.0]),
    "has 'nis': '1'; it is a dict of numbers by name": lambda sound, _: replace(sound, info={"nis": "1"}),
}


@pytest.mark.parametrize(("why", "answer"), ANSWERS.items())
def test_a_step_that_answers_otherwise_fails_its_run_and_nothing_else(
    sequence: Sequence, why: str, answer: Answer
) -> None:
    done = run(sequence, answer)
    assert done.status == "failed"
    assert all(part in done.log[0] for part in why.split(" .* ")), done.log
    assert len(done.log) == 1  # the line says it; a traceback would be of ours


def of_trajectory(**changed: Any) -> End:
    return lambda sound: replace(sound, trajectory=replace(sound.trajectory, **changed))


ENDS: dict[str, End] = {
    "finish returned a Trajectory; it must return a Finished": lambda sound: sound.trajectory,
    "the trajectory of its finish is a list": lambda sound: replace(sound, trajectory=[]),
    "the landmarks of its finish are None": lambda sound: replace(sound, landmarks=None),
    "the log of its finish is a str": lambda sound: replace(sound, log="all is well"),
    "T_world_imu of its final trajectory has shape (4, 4); expected": of_trajectory(T_world_imu=np.eye(4)),
    "the stamps of its final trajectory are not those of frames": of_trajectory(t_ns=np.arange(FRAMES)),
    "points_world of its landmarks has shape (1, 3); expected": lambda sound: replace(
        sound, landmarks=Landmarks(np.arange(2), np.zeros((1, 3)))
    ),
}


@pytest.mark.parametrize(("why", "end"), ENDS.items())
def test_a_finish_that_answers_otherwise_fails_its_run_and_keeps_the_causal_answers(
    sequence: Sequence, why: str, end: End
) -> None:
    done = run(sequence, end=end)
    assert done.status == "failed"
    assert why in done.log[0]
    assert len(done.causal) == FRAMES


def test_who_answers_nothing_at_all_has_failed(sequence: Sequence) -> None:
    done = run(sequence, lambda sound, _: None, lambda sound: Finished(Trajectory.of([]), Landmarks.none()))
    assert done.status == "failed"
    assert "it returned no estimate for any frame" in done.log[0]


def test_an_estimator_that_ends_the_program_ends_its_run_alone(sequence: Sequence) -> None:
    def leave(sound: Estimate, packet: Packet) -> Estimate:
        raise SystemExit(3)

    assert run(sequence, leave).log[0].endswith("SystemExit: 3")
