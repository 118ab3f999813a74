"""The full smoother linearised once: the batch where the problem is linear, and the filter until then (2 s)."""

import numpy as np
import pytest

from filters import ekf_slam, rts
from tests.filters.conftest import BatchAtTruth, assert_covariances_agree, linear, recorded
from toolkit.simulation import DRIVE, FLIGHT


def answers(recording, build):
    estimator = build(recording.setup)
    return [estimator.step(packet) for packet in recording.sequence.packets()], estimator.finish()


@pytest.mark.parametrize("scenario", [linear(DRIVE, 2.0), linear(FLIGHT, 1.0)], ids=lambda s: s.name)
def test_on_a_linear_problem_it_is_the_batch_and_until_the_end_the_filter(scenario):
    recording, exact = recorded(scenario, 1e-4), recorded(scenario, 1e-7)
    causal, finished = answers(recording, rts.build)
    filtered, _ = answers(recording, ekf_slam.build)
    np.testing.assert_array_equal([one.T_world_imu for one in causal], [one.T_world_imu for one in filtered])
    seen = recording.sequence.observations.track_id
    twice = np.flatnonzero(np.bincount(seen) > 1)
    batch, batch_of_exact = BatchAtTruth(recording, twice), BatchAtTruth(exact, twice)
    smoothed, of_exact = finished.trajectory.states(), answers(exact, rts.build)[1].trajectory
    for k in range(0, len(smoothed), 7):
        mean, _ = batch.state(k)
        assert np.abs(recording.error_of(smoothed[k], k) - mean).max() < 1e-8
        assert_covariances_agree(of_exact.cov[k], batch_of_exact.state(k)[1], 1e-5)
    middle = len(smoothed) // 2
    gained = recording.error_of(smoothed[middle], middle) - recording.error_of(causal[middle], middle)
    assert np.abs(gained).max() > 1e-7, "the future had something to tell"
