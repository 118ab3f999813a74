"""The batch smoother: what it takes in, and that it is the least-squares answer of those measurements."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from filters import batch
from filters.batch import worth_smoothing
from filters.smoothing.levenberg_marquardt import Solution, solve
from toolkit import runner
from toolkit.estimate import Landmarks
from toolkit.geometry import Array, se3_inverse
from toolkit.measurements import StereoFrame
from toolkit.registry import find
from toolkit.settings import Settings, Window
from toolkit.simulation import DRIVE, FLIGHT, simulate


def error_since_the_start(poses: Array, truth: Array) -> float:
    """Return the RMSE of the position relative to the first pose: what the prior got wrong is not the smoother's."""
    relative, true = (se3_inverse(T[0]) @ T for T in (poses, truth))
    return float(np.sqrt(np.square(relative[:, :3, 3] - true[:, :3, 3]).sum(axis=1).mean()))


@pytest.mark.parametrize(
    ("scenario", "duration_s", "first_seed", "most"),
    # Measured 0.71 and 0.57; over ten seeds 0.77 and 0.62.
    [(DRIVE, 4.0, 0, 0.75), (FLIGHT, 2.0, 10, 0.65)],
    ids=["drive", "flight"],
)
def test_it_beats_the_filter_it_starts_from(scenario, duration_s, first_seed, most, run_estimator):
    """It sees the future and relinearises: less error than msckf-fej by a quarter on average over five seeds.

    Chance lets the filter win under a seed in ten, and here under one of five at most.

    The filter has the window of each scenario for which the bounds were measured: five poses of a car, twelve of a
    flight. One of seven poses is better on the road, and four seconds of it do not always tell the two apart.
    """
    settings = Settings(window=Window(lag_s=0.4 if scenario is DRIVE else 0.6))
    sequences = [simulate(replace(scenario, duration_s=duration_s), first_seed + i) for i in range(5)]
    filtered_m, smoothed_m = (
        np.array(
            [
                error_since_the_start(run_estimator(name, s, settings=settings).final.T_world_imu, s.truth.T_world_imu)
                for s in sequences
            ]
        )
        for name in ("msckf-fej", "batch")
    )
    assert (smoothed_m < filtered_m).sum() >= 4
    assert smoothed_m.mean() < most * filtered_m.mean()


def test_it_knows_no_answer_before_the_end(run_estimator):
    run = run_estimator("batch", simulate(replace(DRIVE, duration_s=2.0), 0))
    assert run.causal is None
    assert run.final is not None


@pytest.mark.parametrize("overshoots", [True, False])
def test_once_a_step_has_raised_the_error_landmarks_move_in_images_from_the_start_of_later_solves(
    overshoots, run_estimator, monkeypatch
):
    at_once: list[bool | None] = []

    def recorded(*arguments: Any) -> Solution:
        images = arguments[5]
        at_once.append(None if images is None else images.at_once)
        return solve(*arguments)._replace(overshot=overshoots and len(at_once) == 1)

    monkeypatch.setattr(batch, "solve", recorded)
    assert run_estimator("batch", simulate(replace(DRIVE, duration_s=2.0), 0)).status == "ok"
    assert at_once == [None, overshoots, overshoots]


def frame_of(sightings: dict[int, float]) -> StereoFrame:
    uvs_px = np.array([[400.0, 400.0 - disparity, 150.0] for disparity in sightings.values()]).reshape(-1, 3)
    return StereoFrame(0, np.array(list(sightings), dtype=np.int64), uvs_px)


def test_only_known_landmarks_seen_twice_and_near_once_are_smoothed():
    frames = [frame_of({1: 30.0, 2: 30.0, 3: 0.5, 4: 0.5}), frame_of({1: 30.0, 3: 0.5, 4: 5.0}), frame_of({})]
    known = Landmarks(np.array([1, 2, 3, 4]), np.zeros((4, 3)))
    np.testing.assert_array_equal(worth_smoothing(frames, known), [1, 4])
    fewer = Landmarks(np.array([2, 4]), np.zeros((2, 3)))
    np.testing.assert_array_equal(worth_smoothing(frames, fewer), [4])


class Recorded:
    """Keeps every report."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, int, str]] = []

    def advance(self, done: int, total: int, stage: str = "") -> None:
        self.calls.append((done, total, stage))


@pytest.mark.parametrize(("name", "stages"), [("batch", 3), ("isam2", 1)])
def test_every_iteration_of_the_last_solves_is_reported(name, stages):
    sequence, progress = simulate(replace(DRIVE, duration_s=2.0), 0), Recorded()
    runner.run(name, find(name).load(), sequence, sequence.prior, progress)
    solving = [call for call in progress.calls if call[2]]
    assert len({stage for _, _, stage in solving}) == stages
    for stage in {stage for _, _, stage in solving}:
        done = [k for k, _, of in solving if of == stage]
        assert done == list(range(len(done)))
        assert all(k < total for k, total, of in solving if of == stage)
