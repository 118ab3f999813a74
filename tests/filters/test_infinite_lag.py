"""Smoothers that are the batch: a lag longer than the recording, and one step of it where the problem is linear."""

from dataclasses import replace

import numpy as np
import pytest

from filters import batch, ekf, ekf_slam, rts
from filters.fixed_lag import FixedLag
from filters.smart import Smart
from tests.filters.conftest import BatchAtTruth, assert_covariances_agree, linear, recorded
from toolkit.geometry import se3_inverse, se3_log
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT

SCENARIOS = [replace(DRIVE, duration_s=2.0), replace(DRIVE_IMU, duration_s=2.0), replace(FLIGHT, duration_s=1.5)]


def largest_difference(one, other) -> float:
    """Return the largest component of the pose differences, in m and rad alike."""
    return float(np.abs(se3_log(se3_inverse(one.trajectory.T_world_imu) @ other.trajectory.T_world_imu)).max())


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
@pytest.mark.parametrize("kind", [FixedLag, Smart])
def test_an_infinite_lag_is_the_batch(kind, scenario):
    """Held equal: packets, prior, stated noise, the motion's and the stereo factors, the gate that lets all pass.

    Not equal: the robust losses, Huber from the gate on against Cauchy. The errors are drawn at a tenth of the
    stated noise, where Huber weighs nothing down and Cauchy at c = 2 by 1 / (1 + 0.03 / 4), less than a hundredth:
    a hundredth of corrections of millimetres. The solvers differ, too; iSAM2 leaves a variable where it was
    linearised until it has moved by 0.01, which in metres or radians, squared, is the tolerance. Smart factors stop
    a fraction of a sigma short.
    """
    recording = recorded(replace(scenario, camera=replace(scenario.camera, max_tracks=30)), 0.1, seed=3)
    setup, duration_s = recording.setup, recording.sequence.duration_s
    endless, solver, filtered = kind(setup, 10.0 * duration_s), batch.build(setup), ekf.build(setup)
    for packet in recording.sequence.packets():
        for estimator in (endless, solver, filtered):
            estimator.step(packet)
    answer, filters_answer = solver.finish(), filtered.finish()
    assert answer.converged
    assert largest_difference(endless.finish(), answer) < 1e-4
    assert largest_difference(filters_answer, answer) > 1e-3, "there was something to agree on"


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
