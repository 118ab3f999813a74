"""The design effect of tracks' scores: 1 of white noise, whatever their length, and else what a drift's variance is."""

import numpy as np
import pytest

from filters.kalman.track_scores import TrackScores
from filters.kalman.triangulation import triangulate
from toolkit.geometry import se3_exp, se3_inverse, transform
from toolkit.models import stereo
from toolkit.sequence import StereoFrame
from toolkit.simulation import DRIVE, simulate

TRACKS = 400


@pytest.fixture(scope="module")
def rig():
    return simulate(DRIVE, 0).rig


def poses_of(count):
    return np.array([se3_exp(np.array([0.0, 0.0, 0.01 * k, 0.3 * k, 0.0, 0.0])) for k in range(count)])


def seen_px(rig, poses, errors):
    """Return sightings (F, W, 3) px of points ahead, off by whitened errors (F, W, 3)."""
    rng = np.random.default_rng(5)
    count = len(errors)
    ahead = np.stack([rng.uniform(25, 40, count), rng.uniform(-4, 4, count), rng.uniform(-2, 2, count)], axis=1)
    exact_px = np.stack([stereo.predict(transform(se3_inverse(T), ahead), np.eye(4), rig).uv_px for T in poses], axis=1)
    return exact_px + errors @ np.linalg.cholesky(rig.cov_uv_px2).T


def scored(rig, uvs_px, poses):
    """Return the design effect of tracks (F, W, 3) px seen in every frame, fed a frame at a time."""
    scores = TrackScores(rig)
    for k, T in enumerate(poses):
        ids, uvs = np.arange(len(uvs_px)), uvs_px[:, k]
        scores.add(StereoFrame(k, ids, uvs, np.full(len(ids), k)), T)
    scores.finish()
    return scores.design_effect


def white(seed, frames):
    return np.random.default_rng(seed).normal(size=(TRACKS, frames, 3))


@pytest.mark.parametrize("frames", [4, 10, 30])
def test_white_errors_come_to_one_for_tracks_of_any_length(rig, frames):
    """One draw of 400 tracks, of which the near ones tell most, scatters by 0.06; the mean of eight by 0.02."""
    poses = poses_of(frames)
    effects = [scored(rig, seen_px(rig, poses, white(seed, frames)), poses) for seed in range(8)]
    assert np.mean(effects) == pytest.approx(1.0, abs=0.06)


def test_it_is_the_middle_of_the_sandwich_about_a_drift(rig):
    """By finite differences of the residuals, track by track, with dense projections."""
    frames = 8
    poses = poses_of(frames)
    uvs_px = seen_px(rig, poses, white(1, frames))[:30]
    points, reliable = triangulate(uvs_px, np.ones(uvs_px.shape[:2], dtype=bool), poses, rig)
    assert reliable.all()
    whitener = np.linalg.inv(np.linalg.cholesky(rig.cov_uv_px2))

    def predicted(point, drift):
        moved = [T @ se3_exp((k - (frames - 1) / 2) * drift) for k, T in enumerate(poses)]
        in_imu = np.array([transform(se3_inverse(T), point) for T in moved])
        return (stereo.images(in_imu, rig)[0] @ whitener.T).ravel()

    information, squares = np.zeros((6, 6)), np.zeros((6, 6))
    for uv_px, point in zip(uvs_px, points, strict=True):
        residual = (uv_px @ whitener.T).ravel() - predicted(point, np.zeros(6))
        to_drift = derivative(lambda x, point=point: predicted(point, x), 6, 1e-6)
        to_point = derivative(lambda x, point=point: predicted(point + x, np.zeros(6)), 3, 1e-5)
        freed = to_drift - to_point @ np.linalg.lstsq(to_point, to_drift, rcond=None)[0]
        information += freed.T @ freed
        squares += np.outer(freed.T @ residual, freed.T @ residual)
    expected = np.trace(np.linalg.solve(information, squares)) / 6.0
    assert scored(rig, uvs_px, poses) == pytest.approx(expected, rel=1e-4)


def derivative(of, count, step):
    moves = step * np.eye(count)
    return np.array([(of(x) - of(-x)) / (2 * step) for x in moves]).T


def test_a_random_walk_counts_the_less_the_longer_its_tracks_are(rig):
    """What a walk of half a sigma a frame says of a drift grows with the square of the frames."""
    effects = []
    for frames in (5, 10, 20):
        steps = 0.5 * np.random.default_rng(frames).normal(size=(TRACKS, frames, 3))
        poses = poses_of(frames)
        effects.append(scored(rig, seen_px(rig, poses, steps.cumsum(axis=1)), poses))
    assert effects[1] / effects[0] == pytest.approx(4.0, rel=0.4)
    assert effects[2] / effects[1] == pytest.approx(4.0, rel=0.4)


def test_errors_of_twice_the_stated_size_count_four_times(rig):
    poses = poses_of(10)
    small = scored(rig, seen_px(rig, poses, 0.5 * white(2, 10)), poses)
    assert scored(rig, seen_px(rig, poses, white(2, 10)), poses) == pytest.approx(4.0 * small, rel=0.02)


def test_outliers_by_the_stated_noise_say_nothing(rig):
    poses = poses_of(12)
    uvs_px = seen_px(rig, poses, white(3, 12))
    before = scored(rig, uvs_px, poses)
    uvs_px[::10, 5] += 60.0
    assert scored(rig, uvs_px, poses) == pytest.approx(before, rel=0.1)


def test_a_track_is_scored_when_it_is_lost(rig):
    poses = poses_of(12)
    uvs_px, scores = seen_px(rig, poses, white(4, 12)), TrackScores(rig)
    for k, T in enumerate(poses):
        kept = np.arange(TRACKS)[: 30 if k >= 6 else TRACKS]
        scores.add(StereoFrame(k, kept, uvs_px[kept, k], np.full(kept.size, k)), T)
        assert (scores.design_effect is None) == (k < 6)
    assert scores.design_effect == pytest.approx(1.0, abs=0.2)
    assert scores.sightings == 30 * 12


@pytest.mark.parametrize(("at_once", "says"), [(19, False), (20, True)])
def test_few_tracks_at_once_say_nothing_however_many_follow(rig, at_once, says):
    poses, scores = poses_of(12), TrackScores(rig)
    for turn in range(5):
        uvs_px = seen_px(rig, poses, white(turn, 12)[:at_once])
        for k, T in enumerate(poses):
            scores.add(StereoFrame(k, turn * 100 + np.arange(at_once), uvs_px[:, k], np.full(at_once, k)), T)
    assert (scores.design_effect is not None) == says


def test_a_track_without_end_is_scored_in_parts_and_forgotten(rig):
    poses = poses_of(40)[np.zeros(400, dtype=int)]
    uvs_px = seen_px(rig, poses[:1], np.zeros((30, 1, 3)))[:, 0]
    rng, scores, sizes = np.random.default_rng(0), TrackScores(rig), []
    for k, T in enumerate(poses):
        errors = rng.normal(size=(30, 3)) @ np.linalg.cholesky(rig.cov_uv_px2).T
        scores.add(StereoFrame(k, np.arange(30), uvs_px + errors, np.full(30, k)), T)
        sizes.append(scores.sightings)
    assert max(sizes) <= (30 + 40) * 64, "30 in view, and fewer than 40 that wait to be scored together"
    assert scores.design_effect == pytest.approx(1.0, abs=0.3)
