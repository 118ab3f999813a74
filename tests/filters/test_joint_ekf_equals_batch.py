"""On a problem that is linear in effect, forgetting what is out of view loses nothing: the joint EKF is the batch.

The models are not linear, but over errors that are small enough they are. The stated noise stays as it is and the
drawn errors are scaled down, so every gate is open and every Jacobian is that at the truth but for that share. The
batch keeps all poses and landmarks; the filter marginalises both as it goes.
"""

from dataclasses import replace

import numpy as np
import pytest

from filters.ekf_slam import JointEkf
from filters.kalman.joint import AtFirstEstimates, AtLatestEstimates
from tests.filters.conftest import BatchAtTruth, assert_covariances_agree, linear, recorded
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT

SCENARIOS = [linear(DRIVE, 2.0), linear(DRIVE_IMU, 2.0), linear(FLIGHT, 1.0)]


def last_answer(recording, at):
    """Return the filter's last answer and the frame it is of."""
    ekf = JointEkf(recording.setup, at)
    for packet in recording.sequence.packets():
        estimate = ekf.step(packet)
        assert estimate.info["gate_accepted"] == estimate.info["gate_tested"]
    assert len(ekf.landmarks()) == len(recording.track_ids)
    assert len(ekf.joint.clones) == 0
    assert len(recording.track_ids) - len(ekf.joint.landmark_ids) > 10, "tracks must have come and gone"
    return estimate, packet.index


def weighing(recording, weight):
    """Return the recording with a weight of tracks."""
    sequence = recording.sequence
    return replace(recording, sequence=replace(sequence, rig=replace(sequence.rig, track_weight=weight)))


def without_later_pairs(recording, _weight):
    """Return the recording with the right images of the first sightings of its tracks alone."""
    seen = recording.sequence.observations
    later = np.ones(len(seen), dtype=bool)
    later[np.unique(seen.track_id, return_index=True)[1]] = False
    uv_px = seen.uv_px.copy()
    uv_px[later, 1] = np.nan
    return replace(recording, sequence=replace(recording.sequence, observations=replace(seen, uv_px=uv_px)))


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
@pytest.mark.parametrize(
    ("at", "changed", "weight"),
    [
        (AtFirstEstimates(), weighing, 1.0),
        (AtLatestEstimates(), weighing, 0.25),
        (AtFirstEstimates(), without_later_pairs, 1.0),
    ],
    ids=["first", "latest, weighed", "by the left image"],
)
def test_its_last_answer_is_that_of_the_batch(scenario, at, changed, weight):
    """Errors of 1e-4 of the stated noise: both correct by micrometres and agree to a hundredth of that or better.

    Of 1e-7 for the covariance: depths, and with them Jacobians, are off by 1e-8 of themselves.
    """
    for_mean, for_cov = (changed(recorded(scenario, scale), weight) for scale in (1e-4, 1e-7))
    estimate, last = last_answer(for_mean, at)
    mean, _ = BatchAtTruth(for_mean, for_mean.track_ids).state(last)
    # The second order is the square of a relative error of 1e-4 in positions of centimetres.
    assert np.abs(for_mean.error_of(estimate, last) - mean).max() < 1e-8
    assert np.abs(mean).max() > 1e-6, "there was something to agree on"
    estimate, last = last_answer(for_cov, at)
    _, cov = BatchAtTruth(for_cov, for_cov.track_ids).state(last)
    assert_covariances_agree(estimate.cov, cov, 1e-6)
    _, of_fewer = BatchAtTruth(for_cov, np.delete(for_cov.track_ids, np.s_[::20])).state(last)
    with pytest.raises(AssertionError):  # without one track in twenty it would be another problem
        assert_covariances_agree(estimate.cov, of_fewer, 1e-6)
