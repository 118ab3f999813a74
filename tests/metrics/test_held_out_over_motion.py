"""Whether vision has helped is told from withheld tracks alone: an estimate that does harm by it is named."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from toolkit.estimate import Run
from toolkit.geometry import Array, se3_exp, se3_inverse, se3_log
from toolkit.metrics import Evaluation, Scores, reprojection
from toolkit.metrics.reprojection import ERROR, RATIO
from toolkit.motion_samples import TwistSamples
from toolkit.sequence import Sequence

PERIOD_S = 0.1


@pytest.fixture
def recording(make_sequence: Callable[..., Sequence], drive: Callable[[int], Array]) -> Sequence:
    """20 s with 240 withheld tracks and half a pixel of noise, whose twists scatter by 0.1 m/s and 0.005 rad/s."""
    poses = drive(200)
    sequence = make_sequence(poses, track_count=2400, pixel_sigma=0.5)
    twists = se3_log(se3_inverse(poses[:-1]) @ poses[1:]) / PERIOD_S
    twists += np.random.default_rng(1).normal(0.0, np.repeat([0.005, 0.1], 3), twists.shape)
    values = np.concatenate([twists, twists[-1:]])
    return replace(sequence, motion=TwistSamples(sequence.frames_t_ns, values[:, 3:], values[:, :3]))


def scored(recording: Sequence, run: Run) -> Scores:
    return reprojection.score(Evaluation(run, "causal", recording))


def test_an_estimate_better_than_the_motion_is_below_one_and_nothing_is_reported(recording, make_run) -> None:
    scores = scored(recording, make_run(recording.frames_t_ns, recording.truth.T_world_imu))
    assert scores.values[RATIO] < 0.9
    assert RATIO not in scores.notes


def test_the_motion_alone_is_exactly_itself(recording, make_run) -> None:
    poses = recording.truth.T_world_imu
    motion = reprojection._motion_alone(make_run(recording.frames_t_ns, poses).causal, recording).causal
    scores = scored(recording, make_run(recording.frames_t_ns, motion.T_world_imu))
    assert (scores.values[RATIO], scores.values[ERROR]) == (1.0, 0.0)
    assert RATIO not in scores.notes


def test_an_estimate_that_leaps_for_three_seconds_is_reported_with_the_time(recording, make_run) -> None:
    poses = recording.truth.T_world_imu.copy()
    leaps = np.zeros((200, 6))
    leaps[98:128, 3] = np.random.default_rng(2).normal(0.0, 2.0, 30)
    scores = scored(recording, make_run(recording.frames_t_ns, poses @ se3_exp(leaps)))
    assert scores.values[RATIO] < 1.5  # three seconds of twenty hardly show in the whole
    assert "worse than dead reckoning" in scores.notes[RATIO]
    assert " times at 10-12 s" in scores.notes[RATIO]


def test_an_estimate_that_is_worse_all_along_is_reported_with_its_standard_error(recording, make_run, perturb) -> None:
    poses = perturb(recording.truth.T_world_imu, 0.02, seed=3)
    scores = scored(recording, make_run(recording.frames_t_ns, poses))
    assert scores.values[RATIO] > 2.0
    assert f"{scores.values[RATIO]:.2f} +- " in scores.notes[RATIO]


def test_no_ratio_is_made_up_where_there_is_nothing_to_compare_with(recording, make_run, make_sequence, drive) -> None:
    few = recording.truncated(15)
    scores = scored(few, make_run(few.frames_t_ns, recording.truth.T_world_imu[:15]))
    assert scores.values[RATIO] is None and "withheld tracks have 3 views" in scores.notes[RATIO]
    imu = make_sequence(drive(60), motion="imu")
    assert "no velocity" in scored(imu, make_run(imu.frames_t_ns, imu.truth.T_world_imu)).notes[RATIO]
