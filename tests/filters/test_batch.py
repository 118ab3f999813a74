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
from toolkit.measurements import StereoFrame
from toolkit.registry import find
from toolkit.simulation import DRIVE, simulate


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
    run = runner.run(name, find(name).load(), sequence, sequence.prior, progress)
    assert (run.causal is None) == (name == "batch"), "it knows no answer before the end"
    solving = [call for call in progress.calls if call[2]]
    assert len({stage for _, _, stage in solving}) == stages
    for stage in {stage for _, _, stage in solving}:
        done = [k for k, _, of in solving if of == stage]
        assert done == list(range(len(done)))
        assert all(k < total for k, total, of in solving if of == stage)
