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

every_scenario = pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
both_linearisations_and_weights = pytest.mark.parametrize(
    ("at", "weight"), [(AtFirstEstimates(), 1.0), (AtLatestEstimates(), 0.25)], ids=["first", "latest, weighed"]
)


def last_answer(recording, at):
    """Return the filter's last answer, the frame it is of, and how many landmarks it had to forget on the way."""
    ekf = JointEkf(recording.setup, at)
    for packet in recording.sequence.packets():
        estimate = ekf.step(packet)
        assert estimate.info["gate_accepted"] == estimate.info["gate_tested"]
    assert len(ekf.landmarks()) == len(recording.track_ids)
    assert len(ekf.joint.clones) == 0
    return estimate, packet.index, len(recording.track_ids) - len(ekf.joint.landmark_ids)


def weighing(recording, weight):
    """Return the recording with a weight of tracks."""
    sequence = recording.sequence
    return replace(recording, sequence=replace(sequence, rig=replace(sequence.rig, track_weight=weight)))


@every_scenario
@both_linearisations_and_weights
def test_its_last_mean_is_that_of_the_batch(scenario, at, weight):
    """Errors of 1e-4 of the stated noise: both correct by micrometres and agree to a hundredth of that or better."""
    recording = weighing(recorded(scenario, 1e-4), weight)
    estimate, last, forgotten = last_answer(recording, at)
    mean, _ = BatchAtTruth(recording, recording.track_ids).state(last)
    assert forgotten > 10, "tracks must have come and gone"
    # The second order is the square of a relative error of 1e-4 in positions of centimetres.
    assert np.abs(recording.error_of(estimate, last) - mean).max() < 1e-8
    assert np.abs(mean).max() > 1e-6, "there was something to agree on"


@every_scenario
@both_linearisations_and_weights
def test_its_last_covariance_is_that_of_the_batch(scenario, at, weight):
    """Errors of 1e-7 of the stated noise: depths, and with them Jacobians, are off by 1e-8 of themselves."""
    recording = weighing(recorded(scenario, 1e-7), weight)
    estimate, last, forgotten = last_answer(recording, at)
    _, cov = BatchAtTruth(recording, recording.track_ids).state(last)
    assert forgotten > 10, "tracks must have come and gone"
    assert_covariances_agree(estimate.cov, cov, 1e-6)


@pytest.mark.parametrize("scenario", SCENARIOS[::2], ids=lambda s: s.name)
def test_with_later_sightings_by_the_left_image_alone_it_is_the_batch_still(scenario):
    """A landmark begins with a pair; of every later sighting uL and v correct, in both with the same noise."""
    exact = [recorded(scenario, scale) for scale in (1e-4, 1e-7)]
    for_mean, for_cov = (replace(one, sequence=without_later_pairs(one.sequence)) for one in exact)
    estimate, last, forgotten = last_answer(for_mean, AtFirstEstimates())
    mean, _ = BatchAtTruth(for_mean, for_mean.track_ids).state(last)
    assert forgotten > 10, "tracks must have come and gone"
    assert np.abs(for_mean.error_of(estimate, last) - mean).max() < 1e-8
    estimate, last, _ = last_answer(for_cov, AtFirstEstimates())
    _, cov = BatchAtTruth(for_cov, for_cov.track_ids).state(last)
    assert_covariances_agree(estimate.cov, cov, 1e-6)
    _, cov_of_pairs = BatchAtTruth(exact[1], exact[1].track_ids).state(last)
    assert np.trace(cov) > 1.02 * np.trace(cov_of_pairs), "the right images must have told something"


def without_later_pairs(sequence):
    """Return the sequence with the right images of the first sightings of its tracks alone."""
    seen = sequence.observations
    later = np.ones(len(seen), dtype=bool)
    later[np.unique(seen.track_id, return_index=True)[1]] = False
    uv_px = seen.uv_px.copy()
    uv_px[later, 1] = np.nan
    return replace(sequence, observations=replace(seen, uv_px=uv_px))


@every_scenario
def test_a_landmark_left_out_would_show(scenario):
    """The two tests above can fail: a batch without one track in twenty is another problem."""
    recording = recorded(scenario, 1e-7)
    estimate, last, _ = last_answer(recording, AtFirstEstimates())
    _, cov = BatchAtTruth(recording, np.delete(recording.track_ids, np.s_[::20])).state(last)
    with pytest.raises(AssertionError):
        assert_covariances_agree(estimate.cov, cov, 1e-6)
