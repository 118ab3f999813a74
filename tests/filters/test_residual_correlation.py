"""Tracks have less weight where residuals along them are correlated, by as much as that costs, else full weight."""

from dataclasses import replace

import numpy as np
import pytest

from filters.kalman.frame_gate import FrameGate
from filters.kalman.multiview import TrackSightings
from filters.kalman.residual_correlation import LandmarkCorrelation, ResidualCorrelation, residuals_left
from filters.kalman.triangulation import triangulate
from toolkit.geometry import se3_exp
from toolkit.metrics import score_run
from toolkit.models import stereo
from toolkit.sequence import StereoFrame
from toolkit.settings import Noise, Settings
from toolkit.simulation import DRIVE, DRIVE_REALISTIC, simulate
from toolkit.track_noise import TrackNoise

WINDOW, TRACKS = 30, 60
SMOOTHERS = ("fixed-lag", "smart", "isam2", "batch")
ALWAYS = np.ones((WINDOW, TRACKS), dtype=bool)
FULL = Settings(noise=Noise(match_tracks=False))


@pytest.fixture(scope="module")
def drive():
    """Return four seconds of a drive whose tracks err as stated."""
    return simulate(replace(DRIVE, duration_s=4.0), 4)


@pytest.fixture(scope="module")
def walking():
    """Return a drive whose tracks walk and are matched wrong for life, stated to be white noise of half a pixel."""
    sequence = simulate(replace(DRIVE_REALISTIC, duration_s=4.0), 7)
    return replace(sequence, rig=replace(sequence.rig, cov_uv_px2=0.25 * np.eye(3)))


def tracks_of(rig, correlation, seed):
    """Return tracks seen from exact poses with errors of stated size, autoregressive of first order, and the points."""
    rng = np.random.default_rng(seed)
    poses = np.array([se3_exp(np.array([0.0, 0.0, 0.01 * k, 0.3 * k, 0.0, 0.0])) for k in range(WINDOW)])
    ahead = np.stack([rng.uniform(18, 30, TRACKS), rng.uniform(-4, 4, TRACKS), rng.uniform(-2, 2, TRACKS)], axis=1)
    errors = np.empty((TRACKS, WINDOW, 3))
    errors[:, 0] = rng.normal(size=(TRACKS, 3))
    for k in range(1, WINDOW):
        drawn = rng.normal(size=(TRACKS, 3))
        errors[:, k] = correlation * errors[:, k - 1] + np.sqrt(1.0 - correlation**2) * drawn
    exact_px = np.stack([stereo.predict(ahead, T, rig).uv_px for T in poses], axis=1)
    uvs_px = exact_px + errors @ np.linalg.cholesky(rig.cov_uv_px2).T
    seen, ages = np.ones((TRACKS, WINDOW), dtype=bool), np.tile(np.arange(WINDOW), (TRACKS, 1))
    return TrackSightings(np.arange(TRACKS), uvs_px, seen, ages), ahead, poses


def learnt(rig, correlation, seed=0):
    found = ResidualCorrelation(rig)
    found.learn(*tracks_of(rig, correlation, seed))
    return found


def learnt_by_frame(rig, correlation, seed=0, seen=ALWAYS, off_px=0.0):
    """Return what landmarks that stand where they are tell, by the tracks seen in each frame, off by (F, 1) px."""
    (track_ids, uvs_px, _, ages), points, poses = tracks_of(rig, correlation, seed)
    uvs_px, backwards = uvs_px + np.reshape(off_px, (-1, 1, 1)), np.arange(TRACKS)[::-1]
    found = LandmarkCorrelation(rig)
    for k in range(WINDOW):
        rows = backwards[seen[k, backwards]]
        frame = StereoFrame(k, track_ids[rows], uvs_px[rows, k], ages[rows, k])
        found.learn_frame(frame, track_ids, points, poses[k])
    return found


def learnt_of_pairs(rig, correlation, counts_neighbours):
    """Return what landmarks tell each of which has another beside it, whose track is off by the same pixels."""
    (track_ids, uvs_px, _, ages), points, poses = tracks_of(rig, correlation, 0)
    found = LandmarkCorrelation(rig, counts_neighbours=counts_neighbours)
    ids, points = np.concatenate([track_ids, TRACKS + track_ids]), np.tile(points, (2, 1))
    for k in range(WINDOW):
        found.learn_frame(
            StereoFrame(k, ids, np.tile(uvs_px[:, k], (2, 1)), np.tile(ages[:, k], 2)), ids, points, poses[k]
        )
    return found


def test_landmarks_count_for_less_by_the_neighbours_that_err_as_one(drive):
    alone, beside = (learnt_of_pairs(drive.rig, 0.8, counts) for counts in (False, True))
    assert "neighbours" not in alone.messages[0]
    assert "neighbours have a common error" in beside.messages[0]
    assert beside.share < 0.6 * alone.share


def test_landmarks_whose_tracks_are_white_count_in_full_whatever_errs_as_one(drive):
    assert learnt_of_pairs(drive.rig, 0.0, True).share == 1.0


@pytest.mark.parametrize("seed", range(5))
def test_white_errors_count_in_full(drive, seed):
    found = learnt(drive.rig, 0.0, seed)
    assert found.share == 1.0
    assert found.messages == ()


def test_correlated_errors_count_for_as_much_as_their_mean_is_worth(drive):
    """That of an autoregression, of which the landmarks take a part: less correlation is left, never more."""
    correlation = 0.6
    lags = np.abs(np.subtract.outer(np.arange(1000), np.arange(1000)))
    worth = 1000.0 / (correlation**lags).mean() / 1000.0**2
    found = learnt(drive.rig, correlation)
    assert worth == pytest.approx((1.0 - correlation) / (1.0 + correlation), rel=0.01)
    assert worth < found.share < 1.6 * worth
    assert f"{found.correlation:.2f} from frame to frame" in found.messages[0]


def test_noise_stated_large_enough_for_correlated_errors_counts_in_full(drive):
    """Errors of a third of the stated noise, each as wrong as four others: nine times as much is told by each."""
    found = ResidualCorrelation(replace(drive.rig, cov_uv_px2=9.0 * drive.rig.cov_uv_px2))
    found.learn(*tracks_of(drive.rig, 0.6, 0))
    assert found.correlation > 0.4
    assert found.share == 1.0


def settled(found, sightings, poses):
    """Return it once all frames of some tracks have settled, and the tracks have ended."""
    for k, pose in enumerate(poses):
        found.settle(StereoFrame(k, sightings.track_ids, sightings.uvs_px[:, k], sightings.ages[:, k]), pose)
    found.settle_last()
    return found


def test_what_tracks_say_of_a_drift_takes_from_the_share_and_never_adds_to_it(drive):
    """Residuals correlated by a half are told 0.40; a drift of errors correlated by 0.9 varies seven times as much."""
    share = learnt(drive.rig, 0.5).share
    white, _, poses = tracks_of(drive.rig, 0.0, 1)
    assert settled(learnt(drive.rig, 0.5), white, poses).share == share
    alike, _, _ = tracks_of(drive.rig, 0.9, 2)
    assert settled(learnt(drive.rig, 0.5), alike, poses).share < 0.5 * share


def test_frames_of_a_run_whose_residuals_are_white_are_not_scored(drive):
    sightings, _, poses = tracks_of(drive.rig, 0.9, 2)
    assert settled(learnt(drive.rig, 0.0), sightings, poses).share == 1.0


def test_a_handful_of_residuals_that_happen_to_agree_proves_nothing(drive):
    sightings, points, poses = tracks_of(drive.rig, 0.9, 0)
    found = ResidualCorrelation(drive.rig)
    found.learn(sightings.select(np.arange(1))._replace(seen=np.arange(WINDOW)[None] < 4), points[:1], poses)
    assert found.share == 1.0


def test_what_is_left_of_residuals_is_what_the_best_points_leave(drive):
    sightings, points, poses = tracks_of(drive.rig, 0.5, 1)
    best, reliable = triangulate(sightings.uvs_px, sightings.seen, poses, drive.rig)
    assert reliable.all()
    left = residuals_left(sightings, points, poses, drive.rig)
    # The points are a few hundredths of their depth off, and what is left of second order is below a tenth of a sigma.
    np.testing.assert_allclose(left, residuals_left(sightings, best, poses, drive.rig), atol=0.1)
    assert np.abs(left).max() > 2.0


@pytest.mark.parametrize("seed", range(5))
def test_landmarks_of_the_state_with_white_errors_count_in_full(drive, seed):
    assert learnt_by_frame(drive.rig, 0.0, seed).share == 1.0


def test_landmarks_of_the_state_count_for_as_much_as_the_mean_of_their_errors_is_worth(drive):
    correlation = 0.6
    found = learnt_by_frame(drive.rig, correlation)
    assert found.share == pytest.approx((1.0 - correlation) / (1.0 + correlation), rel=0.15)
    assert "tracks of landmarks in the state were given" in found.messages[0]


def test_landmarks_whose_residuals_are_hardly_correlated_count_in_full(drive):
    """A filter leaves residuals of white landmarks correlated by up to 0.07; tracks that walk by more than half."""
    assert learnt_by_frame(drive.rig, 0.1).share == 1.0
    assert learnt_by_frame(drive.rig, 0.25).share < 0.8


def test_residuals_of_landmarks_are_paired_in_successive_frames(drive):
    every_other = np.add.outer(np.arange(WINDOW), np.arange(TRACKS)) % 2 == 0
    assert learnt_by_frame(drive.rig, 0.9, seen=every_other).correlation == 0.0


def test_outliers_among_landmarks_say_nothing_of_the_others(drive):
    sound = np.arange(TRACKS) % 3 > 0
    planted = learnt_by_frame(drive.rig, 0.6, off_px=np.where(sound, 0.0, 20.0))
    alone = learnt_by_frame(drive.rig, 0.6, seen=np.tile(sound, (WINDOW, 1)))
    assert planted.share == alone.share < 1.0


def test_a_share_scales_what_is_accepted_and_not_what_is_tested():
    nis, dof = np.array([1.0, 3.0, 40.0]), 3
    for huber in (None, 1.5):
        whole, part = FrameGate(0.95, huber), FrameGate(0.95, huber, 0.2)
        passed = [gate.accepts(nis, dof) for gate in (whole, part)]
        np.testing.assert_array_equal(*passed)
        assert whole.info() == part.info()
        np.testing.assert_allclose(part.weights(nis, dof, passed[1]), 0.2 * whole.weights(nis, dof, passed[0]))


@pytest.mark.parametrize("name", ["ekf-slam", "msckf", "msckf-fej", "msckf-slam", *SMOOTHERS])
def test_a_drive_whose_noise_is_as_stated_is_answered_as_without_to_the_bit(name, drive, run_estimator):
    with_it, without = run_estimator(name, drive), run_estimator(name, drive, settings=FULL)
    np.testing.assert_array_equal(with_it.final.T_world_imu, without.final.T_world_imu)
    assert not tells(with_it)


@pytest.mark.parametrize("name", SMOOTHERS)
def test_a_smoother_is_the_nearer_to_honest_for_it(name, walking, run_estimator):
    """Over six draws the NEES of smart is 0.38 to 0.85 of what it is in full, that of fixed-lag 0.38 to 0.74."""
    run, full = run_estimator(name, walking), run_estimator(name, walking, settings=FULL)
    assert tells(run)
    assert not tells(full)
    found, believed = (score_run(each, "final", walking, only=["nees_pose_mean"]).values for each in (run, full))
    assert found["nees_pose_mean"] < 0.8 * believed["nees_pose_mean"]


@pytest.mark.parametrize("name", ["ekf-slam", "msckf-fej", "msckf-slam"])
def test_tracks_that_walk_are_found_and_claimed_to_tell_less(name, walking, run_estimator):
    run, full = run_estimator(name, walking), run_estimator(name, walking, settings=FULL)
    assert tells(run)
    assert not tells(full)
    metrics = ("nees_pose_mean", "ate_none_m", "ate_se3_m")
    found, believed = (score_run(each, "final", walking, only=metrics).values for each in (run, full))
    for metric in metrics:
        assert found[metric] < 0.9 * believed[metric]


def test_where_noise_of_tracks_is_stated_they_count_as_it_says(walking, run_estimator):
    stated = replace(
        walking,
        rig=replace(walking.rig, track_noise=TrackNoise(np.full(3, 0.03), np.full(3, 0.13), np.array([0.0, 0.7, 0.0]))),
    )
    runs = [run_estimator("msckf-slam", stated, settings=each) for each in (Settings(), FULL)]
    np.testing.assert_array_equal(runs[0].causal.T_world_imu, runs[1].causal.T_world_imu)


def tells(run):
    """Say whether the log of a run says that tracks do not count in full."""
    return any("are correlated" in line and "of their information in the end" in line for line in run.log)
