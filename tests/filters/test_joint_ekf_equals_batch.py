"""On a problem that is linear in effect, forgetting what is out of view loses nothing: the filter is the batch.

The models are not linear, but over errors that are small enough they are. The stated noise stays as it is and the
drawn errors are scaled down, so every gate is open and every Jacobian is that at the truth but for that share. The
batch keeps all poses and landmarks; a joint EKF, and a window of one state alone, marginalises both as it goes.
"""

from dataclasses import replace

import numpy as np
import pytest

from filters import fixed_lag, sliding_window
from filters.ekf_slam import JointEkf
from filters.kalman.joint import AtFirstEstimates, AtLatestEstimates
from tests.filters.conftest import BatchAtTruth, assert_covariances_agree, linear, recorded
from toolkit.settings import Settings, Window
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT

SCENARIOS = [linear(DRIVE, 2.0), linear(DRIVE_IMU, 2.0), linear(FLIGHT, 1.0)]


def as_it_is(sequence):
    return sequence


def weighed(sequence):
    return replace(sequence, rig=replace(sequence.rig, track_weight=0.25))


def without_later_pairs(sequence):
    """Return the recording with the right images of the first sightings of its tracks alone."""
    later, uv_px = np.ones(len(sequence.observations), dtype=bool), sequence.observations.uv_px.copy()
    later[np.unique(sequence.observations.track_id, return_index=True)[1]] = False
    uv_px[later, 1] = np.nan
    return replace(sequence, observations=replace(sequence.observations, uv_px=uv_px))


# How an estimator is built, its options, what is made of the recording, and how well covariances agree.
CASES = {
    "first": (lambda setup: JointEkf(setup, AtFirstEstimates()), {}, as_it_is, 1e-6),
    "latest, weighed": (lambda setup: JointEkf(setup, AtLatestEstimates()), {}, weighed, 1e-6),
    "by the left image": (lambda setup: JointEkf(setup, AtFirstEstimates()), {}, without_later_pairs, 1e-6),
    "fixed-lag": (fixed_lag.build, {}, as_it_is, 1e-5),
    **{
        f"sliding-window, {kind}": (sliding_window.build, {"marginals": kind}, as_it_is, 1e-5)
        for kind in sliding_window.OPTIONS["marginals"]
    },
}


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
@pytest.mark.parametrize("case", CASES)
def test_its_last_answer_is_that_of_the_batch(scenario, case):
    """Errors of 1e-4 of the stated noise: both correct by micrometres and agree to a hundredth of that or better.

    Of 1e-7 for the covariance: depths, and with them Jacobians, are off by 1e-8 of themselves.
    """
    build, options, changed, agreement = CASES[case]

    def answered(noise_scale):
        recording = recorded(scenario, noise_scale)
        recording = replace(recording, sequence=changed(recording.sequence))
        setup = replace(recording.setup, settings=Settings(window=Window(most_states=1)), options=options)
        estimator = build(setup)
        answers = [estimator.step(packet) for packet in recording.sequence.packets()]
        assert all(one.info.get("gate_accepted") == one.info.get("gate_tested") for one in answers)
        return recording, answers[-1], len(answers) - 1

    recording, answer, last = answered(1e-4)
    seen = recording.sequence.visible
    assert np.setdiff1d(seen.track_id, seen.track_id[seen.frame == last]).size > 10, "tracks must have come and gone"
    mean, _ = BatchAtTruth(recording, recording.track_ids).state(last)
    # The second order is the square of a relative error of 1e-4 in positions of centimetres.
    assert np.abs(recording.error_of(answer, last) - mean).max() < 1e-8
    assert np.abs(mean).max() > 1e-6, "there was something to agree on"
    exact, answer, _ = answered(1e-7)
    assert_covariances_agree(answer.cov, BatchAtTruth(exact, exact.track_ids).state(last)[1], agreement)
    _, of_fewer = BatchAtTruth(exact, np.delete(exact.track_ids, np.s_[::20])).state(last)
    with pytest.raises(AssertionError):  # without one track in twenty it would be another problem
        assert_covariances_agree(answer.cov, of_fewer, agreement)
