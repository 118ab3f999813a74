"""On a problem that is linear in effect, forgetting what is out of view loses nothing: the filter is the batch.

The models are not linear, but over errors that are small enough they are. The stated noise stays as it is and the
drawn errors are scaled down, so every gate is open and every Jacobian is that at the truth but for that share. The
batch keeps all poses and landmarks. A joint EKF, and a window of one state alone, marginalises both as it goes, an
MSCKF eliminates the landmarks of each track, and `rts` takes the batch's step at the end.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from filters import ekf_slam, fixed_lag, rts, sliding_window
from filters.ekf_slam import JointEkf
from filters.kalman.coordinates import CloneAnchoredBelief
from filters.kalman.joint import AtFirstEstimates, AtLatestEstimates, JointBelief
from filters.msckf import Msckf
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


def seen_twice(sightings):
    """Return the tracks that tie two poses together."""
    track_ids, counts = np.unique(sightings.track_id, return_counts=True)
    return track_ids[counts > 1]


# With room for every track, each sighting is used once however long the run; with none, while the window fills. In view
# of the newest pose, tracks have corrected nothing that is kept, and the answer is that of the batch all the same.
SIZES = {
    "in view": (9, 0, 7),
    "one window": (9, 0, 10),
    "every landmark kept": (4, 10**6, 21),
    "every landmark anchored": (4, 10**6, 21),
}


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=lambda s: s.name)
@pytest.mark.parametrize(("at", "weight"), [(AtFirstEstimates(), 1.0), (AtLatestEstimates(), 0.25)])
@pytest.mark.parametrize("size", SIZES)
def test_the_filters_answer_is_that_of_the_batch_of_its_tracks(scenario, at, size, weight):
    """Errors of 1e-6 of the stated noise: the gates are open and second orders out of sight."""
    clones, landmarks, frames = SIZES[size]
    recording = recorded(linear(scenario, (frames - 1) / scenario.camera.rate_hz), 1e-6)
    rig = replace(recording.sequence.rig, track_weight=weight)
    recording = replace(recording, sequence=replace(recording.sequence, rig=rig))
    # A pose leaves in the frame in which it is older than the window.
    lag_s = (clones - 0.5) / scenario.camera.rate_hz
    settings = Settings(window=Window(lag_s=lag_s))
    anchored = partial(CloneAnchoredBelief, T_imu_cam=rig.T_imu_cam, at=at)
    belief = anchored if size == "every landmark anchored" else JointBelief
    msckf = Msckf(replace(recording.setup, settings=settings), at, landmarks, belief=belief)
    for packet in recording.sequence.packets():
        estimate = msckf.step(packet)
        assert estimate.info["gate_accepted"] == estimate.info["gate_tested"]
    used = seen_twice(recording.sequence.visible)
    assert len(used) > 20
    assert size != "in view" or len(msckf.landmarks().track_ids) < len(used) / 2
    mean, cov = BatchAtTruth(recording, used).state(packet.index)
    # The corrections are a millionth of centimetres; the second order is a millionth of that.
    assert np.abs(recording.error_of(estimate, packet.index) - mean).max() < 1e-3 * np.abs(mean).max()
    assert_covariances_agree(estimate.cov, cov, 1e-6)


def answers(recording, build):
    estimator = build(recording.setup)
    return [estimator.step(packet) for packet in recording.sequence.packets()], estimator.finish()


@pytest.mark.parametrize("scenario", [linear(DRIVE, 2.0), linear(FLIGHT, 1.0)], ids=lambda s: s.name)
def test_on_a_linear_problem_it_is_the_batch_and_until_the_end_the_filter(scenario):
    recording, exact = recorded(scenario, 1e-4), recorded(scenario, 1e-7)
    causal, finished = answers(recording, rts.build)
    filtered, _ = answers(recording, ekf_slam.build)
    np.testing.assert_array_equal([one.T_world_imu for one in causal], [one.T_world_imu for one in filtered])
    twice = seen_twice(recording.sequence.observations)
    batch, batch_of_exact = BatchAtTruth(recording, twice), BatchAtTruth(exact, twice)
    smoothed, of_exact = finished.trajectory.states(), answers(exact, rts.build)[1].trajectory
    for k in range(0, len(smoothed), 7):
        mean, _ = batch.state(k)
        assert np.abs(recording.error_of(smoothed[k], k) - mean).max() < 1e-8
        assert_covariances_agree(of_exact.cov[k], batch_of_exact.state(k)[1], 1e-5)
    middle = len(smoothed) // 2
    gained = recording.error_of(smoothed[middle], middle) - recording.error_of(causal[middle], middle)
    assert np.abs(gained).max() > 1e-7, "the future had something to tell"
