"""Noise that was planted is found, white noise stays white, and the parts of the fit are what they say."""

import re
from dataclasses import replace

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.experiment.recording import Recording, prepare
from toolkit.geometry import se3_exp, se3_inverse, se3_log
from toolkit.sequence import Observations, Sequence
from toolkit.settings import settings_of
from toolkit.simulation.faults import few_tracks, identity_intrinsics
from toolkit.track_errors import Fit, fit_track_noise, summary_of
from toolkit.track_errors.adjustment import adjusted, started
from toolkit.track_errors.tracklets import (
    MOST_SIGHTINGS,
    Tailed,
    TrackletResiduals,
    likelihood,
    linearised,
    middle_of_pair,
    tracklets,
)
from toolkit.track_noise import TrackNoise

WALK_PX, OFFSET_PX = 0.13, 0.7
MODEL = Tailed(TrackNoise(np.array([0.3, 0.4, 0.2]), np.array([0.1, 0.2, 0.15]), np.array([0.0, 0.6, 0.0])), 6.0)


def test_a_planted_walk_and_offset_are_found(walking_fit: Fit) -> None:
    noise = walking_fit.noise
    assert walking_fit.correlated
    # About 700 tracks of eight sightings: 2 to 4 % by chance, and white noise of 0.02 px in place of none.
    np.testing.assert_allclose(noise.walk_px, WALK_PX, rtol=0.12)
    np.testing.assert_allclose(noise.offset_px, [0.0, OFFSET_PX, 0.0], rtol=0.12)
    assert noise.white_px.max() < 0.06
    assert walking_fit.gain > 5.0 * walking_fit.gain_error
    assert "an offset of 0." in summary_of(walking_fit, np.eye(3))


def test_white_noise_comes_out_white(white_fit: Fit) -> None:
    assert not white_fit.correlated
    # c is the mean of two columns of 1 px, d their difference, v the mean of two rows; 600 tracks are good for 3 %.
    np.testing.assert_allclose(white_fit.noise.white_px, [np.sqrt(0.5), np.sqrt(2.0), np.sqrt(0.5)], rtol=0.1)
    stated_px2 = 2.0**2 * np.diag([1.0, 1.0, 0.5])
    assert "independent between sightings" in summary_of(white_fit, stated_px2)
    times = re.search(
        r"recording's own 1.41/2.83/1.41 px in c/d/v, ([\d.]+) times that", summary_of(white_fit, stated_px2)
    )
    assert times is not None
    assert float(times[1]) == pytest.approx(2.0, rel=0.05)


def test_the_settings_put_the_fitted_noise_on_the_rig_and_say_so(walking: Sequence) -> None:
    requested = settings_of({"noise": {"tracks": "fitted", "track_fit_s": 6.0}}, "test").noise
    prepared = prepare(Recording(walking, noise=requested))
    noise = prepared.sequence.rig.track_noise
    # 350 tracks.
    assert noise is not None and noise.offset_px[1] == pytest.approx(OFFSET_PX, rel=0.2)
    assert "fitted to the first 6 s" in prepared.sequence.provenance.facts[-1]
    assert prepared.card is not None and prepared.card.correlated


def test_noise_that_comes_out_white_leaves_the_recordings_own(white: Sequence) -> None:
    requested = settings_of({"noise": {"tracks": "fitted"}}, "test").noise
    prepared = prepare(Recording(white.truncated(60), noise=requested)).sequence
    assert prepared.rig.track_noise is None
    assert np.array_equal(prepared.rig.cov_uv_px2, white.rig.cov_uv_px2)
    assert "fitted to all that is used" in prepared.provenance.facts[-1]


def test_too_few_tracks_are_refused_with_what_to_do(exact: Sequence) -> None:
    requested = settings_of({"noise": {"tracks": "fitted"}}, "test").noise
    with pytest.raises(DataError, match=r"too few to fit their noise.*noise\.tracks=correlated"):
        prepare(Recording(exact.truncated(3), noise=requested))


def test_a_fit_to_less_than_two_frames_is_refused_with_the_setting_that_says_so(exact: Sequence) -> None:
    requested = settings_of({"noise": {"tracks": "fitted", "track_fit_s": 0.01}}, "test").noise
    with pytest.raises(DataError, match=r"no two frames are in its first 0\.01 s; give noise\.track_fit_s more"):
        prepare(Recording(exact, noise=requested))


def test_a_calibration_that_suits_no_motion_is_refused_in_one_line(walking: Sequence) -> None:
    with pytest.raises(DataError, match="no motion of the camera fits the tracks"):
        fit_track_noise(identity_intrinsics(walking.truncated(50)))


def test_so_few_tracks_a_frame_that_the_motion_takes_them_up_are_refused(
    walking: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("toolkit.track_errors.fit.FEWEST_TRACKS", 30)
    with pytest.raises(DataError, match=r"usable sightings a frame .* are too few"):
        fit_track_noise(few_tracks(walking, 9))


def test_the_sightings_that_are_too_few_are_counted_without_those_by_the_left_image_alone(walking: Sequence) -> None:
    seen = walking.observations
    uv_px = seen.uv_px.copy()
    uv_px[np.random.default_rng(1).random(len(seen)) < 0.5, 1] = np.nan
    sequence = replace(walking, observations=Observations(seen.frame, seen.track_id, uv_px))
    used = [group.frames.size for group in tracklets(sequence)]
    with pytest.raises(DataError, match=r"usable sightings a frame") as refused:
        fit_track_noise(sequence)
    counted = re.search(r"([\d.]+) usable", str(refused.value))
    assert counted is not None
    assert float(counted[1]) == pytest.approx(sum(used) / sequence.frame_count, rel=0.05)
    assert float(counted[1]) < 0.25 * len(sequence.visible) / sequence.frame_count


def test_withheld_tracks_are_not_looked_at(walking: Sequence) -> None:
    seen = np.concatenate([group.track_id for group in tracklets(walking)])
    assert np.isin(seen, walking.visible.track_id).all()
    assert not np.isin(seen, walking.held_out.track_id).any()


def test_tracklets_are_the_first_sightings_up_to_a_gap(exact: Sequence) -> None:
    seen = exact.observations
    lost = (seen.frame == 9) & (seen.track_id % 2 == 0)
    for group in tracklets(replace(exact, observations=seen.select(~lost))):
        assert group.sightings <= MOST_SIGHTINGS
        even = group.track_id % 2 == 0
        assert not ((group.frames == 9).any(axis=1) & even).any()


def test_of_long_recordings_stretches_are_used(exact: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("toolkit.track_errors.tracklets.MOST_FRAMES", 60)
    monkeypatch.setattr("toolkit.track_errors.tracklets.STRETCH_FRAMES", 20)
    begun = np.concatenate([group.first_frame for group in tracklets(exact)])
    assert (begun % 40 < 20).all()
    assert np.unique(begun // 40).size == 3


def test_derivatives_are_those_of_the_residuals(exact: Sequence) -> None:
    rng = np.random.default_rng(0)
    group = tracklets(exact)[4].select(slice(0, 5))
    poses = started(exact, (group,)).T_world_middle
    group = group.moved(rng.standard_normal((5, 3)))
    at, step = linearised(group, poses, exact.rig), 1e-6
    for axis in range(3):
        further = linearised(group.moved(step * np.eye(3)[axis]), poses, exact.rig).residual_px
        # A central difference would do no better: the second derivative times the step is 1e-7.
        np.testing.assert_allclose((at.residual_px - further) / step, at.d_landmark[..., axis], atol=1e-5)
    frame, sighting = int(group.first_frame[0] + 2), 2
    for axis in range(6):
        turned = poses.copy()
        turned[frame] = turned[frame] @ se3_exp(step * np.eye(6)[axis])
        # A landmark is given in its first frame, which stays.
        further = linearised(group.select(slice(0, 1)), turned, exact.rig).residual_px
        change = (at.residual_px[0, sighting] - further[0, sighting]) / step
        np.testing.assert_allclose(change, at.d_pose[0, sighting, :, axis], rtol=1e-3, atol=1e-2)


def test_the_gradient_is_that_of_the_likelihood(walking: Sequence) -> None:
    state = started(walking, (tracklets(walking)[5].select(slice(0, 20)),))
    group = TrackletResiduals.of(linearised(state.tracks[0], state.T_world_middle, walking.rig), 1.0)
    at, step = likelihood(group, MODEL), 1e-6
    parts = np.stack([MODEL.noise.white_px, MODEL.noise.walk_px, MODEL.noise.offset_px])
    for part, channel in [(0, 0), (0, 1), (1, 1), (1, 2), (2, 1)]:
        further = parts**2
        further[part, channel] += step
        change = likelihood(group, Tailed(TrackNoise(*np.sqrt(further)), 6.0)).each.sum() - at.each.sum()
        assert change / step == pytest.approx(at.by_variance[part, channel], rel=1e-3)
    change = likelihood(group, Tailed(MODEL.noise, 6.0 + step)).each.sum() - at.each.sum()
    assert change / step == pytest.approx(at.by_degrees, rel=1e-3)


def test_adjusted_poses_are_the_true_ones_where_tracks_are_exact(exact: Sequence) -> None:
    assert exact.truth is not None
    state = adjusted(started(exact, tracklets(exact)), MODEL, exact, 4)
    true_poses = exact.truth.T_world_imu @ exact.rig.T_imu_cam @ middle_of_pair(exact.rig)
    error = se3_log(se3_inverse(se3_inverse(true_poses[0]) @ true_poses) @ state.T_world_middle)
    # Exact to the last step of Gauss-Newton, and to the ties to motions found from two views.
    assert np.abs(error).max() < 1e-4
    # Six unknowns a frame of about 2.5 equations from each of 85 tracks.
    assert 0.93 < state.freedom < 0.98
