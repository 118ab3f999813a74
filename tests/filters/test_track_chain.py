"""Sightings chained along their tracks: against the whole covariance, and what becomes of a track that jumps."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from filters import batch
from filters.smoothing.robust_loss import Cauchy, Huber, Squares
from filters.smoothing.smart_factors import RobustCamera, Sightings, Vision
from filters.smoothing.track_chain import ChainedFactors, ChainedSightings, without_jumps
from toolkit.geometry import se3_exp, transform
from toolkit.models import stereo
from toolkit.models.factors import L, X, kind_of
from toolkit.sequence import StereoFrame
from toolkit.settings import POLICIES, Settings
from toolkit.simulation import DRIVE, simulate
from toolkit.track_noise import TrackNoise

NOISE = TrackNoise(np.array([0.1, 0.2, 0.1]), np.array([0.3, 0.2, 0.3]), np.array([0.0, 1.4, 0.0]))
RIG = replace(DRIVE.rig, track_noise=NOISE)
POSES, POINTS = 5, 6


@pytest.fixture(scope="module")
def scene():
    """Return frames, poses and points of a small scene; one track is not seen by all, and errors are of a pixel."""
    rng = np.random.default_rng(3)
    poses = se3_exp(0.05 * rng.standard_normal((POSES, 6)))
    points_cam = np.column_stack([rng.uniform(-2.0, 2.0, (POINTS, 2)), rng.uniform(8.0, 16.0, POINTS)])
    points = transform(RIG.T_imu_cam, points_cam)
    frames = []
    for k, pose in enumerate(poses):
        ids = np.array([i for i in range(POINTS) if i != 2 or k not in (1, 2)])
        uvs_px = stereo.predict(points[ids], pose, RIG).uv_px + rng.standard_normal((ids.size, 3))
        frames.append(StereoFrame(k, ids, uvs_px, np.full(ids.size, k + 3)))
    return frames, poses, points


def values_of(poses, points):
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(X(k), gtsam.Pose3(pose))
    for i, point in enumerate(points):
        values.insert(L(i), point)
    return values


LOSSES = [Squares(), Huber(1.5), Cauchy(2.0)]


@pytest.mark.parametrize("freedom", [None, 2.0])
@pytest.mark.parametrize("loss", LOSSES, ids=["squares", "huber", "cauchy"])
def test_the_linear_factors_have_the_gradient_of_the_cost(scene, loss, freedom):
    frames, poses, points = scene
    vision, values = ChainedFactors(ChainedSightings.of(frames, RIG), RIG, loss, freedom), values_of(poses, points)
    gradient = vision.linearised(values).linearize(values).gradientAtZero()
    rng, step = np.random.default_rng(0), 3e-7
    for _ in range(3):
        delta = gtsam.VectorValues()
        for key in values.keys():  # noqa: SIM118 - not a mapping
            delta.insert(key, rng.standard_normal(6 if kind_of(key) == "x" else 3))
        slope = sum(gradient.at(key) @ delta.at(key) for key in values.keys())  # noqa: SIM118 - not a mapping
        ahead, behind = (vision.error(values.retract(scaled(delta, values, s))) for s in (step, -step))
        # What is left is the kink of Huber's second derivative, in proportion to the step.
        assert (ahead - behind) / (2.0 * step) == pytest.approx(slope, rel=1e-5)


def scaled(delta, values, factor):
    result = gtsam.VectorValues()
    for key in values.keys():  # noqa: SIM118 - not a mapping
        result.insert(key, factor * delta.at(key))
    return result


def test_a_track_that_errs_throughout_counts_less_throughout_and_the_others_as_they_did(scene):
    frames, poses, points = scene
    off_px = [np.where(frame.track_ids == 4, 5.0 * k, 0.0)[:, None] for k, frame in enumerate(frames)]
    moved = [replace(frame, uvs_px=frame.uvs_px + off) for frame, off in zip(frames, off_px, strict=True)]
    before, after = (ChainedFactors(ChainedSightings.of(seen, RIG), RIG, Squares(), 2.0) for seen in (frames, moved))
    weights = [one.weights(one.innovations(values_of(poses, points))) for one in (before, after)]
    of_it = before.sightings.point == 4
    np.testing.assert_array_equal(weights[0][~of_it], weights[1][~of_it])
    assert np.ptp(weights[1][of_it]) == 0.0
    # Every track errs by some 5 sigmas a step; this one by 17 in each of two channels, so that it counts a tenth.
    assert weights[1][of_it][0] < 0.15 * weights[0][of_it][0]


def test_innovations_held_at_their_weights_are_least_squares_with_the_gradient_of_the_cost(scene):
    frames, poses, points = scene
    robust, values = ChainedFactors(ChainedSightings.of(frames, RIG), RIG, Cauchy(2.0), 2.0), values_of(poses, points)
    held = robust.with_fixed_weights(values)
    one, other = (
        vision.linearised(values).linearize(values).augmentedHessian(gtsam.Ordering(values.keys()))
        for vision in (robust, held)
    )
    # Rounding, relative to the largest entry.
    np.testing.assert_allclose(one, other, atol=1e-12 * np.abs(one).max())
    moved = values_of(poses @ se3_exp(np.full(6, 0.05)), points)
    np.testing.assert_array_equal(held.weights(held.innovations(moved)), 1.0)
    squares = np.square(held.innovations(moved)).sum()
    assert held.error(moved) == pytest.approx(0.5 * squares, rel=1e-12)


def test_smart_says_of_the_poses_what_the_chain_says_once_its_landmarks_are_eliminated(scene):
    frames, poses, points = scene
    chained, values = ChainedSightings.of(frames, RIG), values_of(poses, points)
    graph = ChainedFactors(chained, RIG, Huber(1.5)).linearised(values).linearize(values)
    ordering = gtsam.Ordering()
    for key in [*map(X, range(POSES)), *map(L, range(POINTS))]:
        ordering.push_back(key)
    information, vector = graph.hessian(ordering)
    n = 6 * POSES
    across = information[:n, n:] @ np.linalg.inv(information[n:, n:])
    ages = np.concatenate([frame.ages for frame in frames])
    seen = Sightings(chained.pose, chained.point, chained.uv_px, ages)
    vision = Vision.at(poses, points, seen, RobustCamera(RIG, 1.5))
    reduced = vision.reduced()
    # Rounding, relative to the largest entry.
    scale = np.abs(reduced.information).max()
    np.testing.assert_allclose(
        reduced.information, information[:n, :n] - across @ information[n:, :n], atol=1e-9 * scale
    )
    np.testing.assert_allclose(reduced.vector, vector[:n] - across @ vector[n:], atol=1e-9 * np.abs(vector).max())
    assert vision.loss == pytest.approx(ChainedFactors(chained, RIG, Huber(1.5)).error(values), rel=1e-9)


def test_after_a_jump_the_steps_of_a_track_count_and_a_track_that_begins_with_one_is_left_out(scene):
    frames, _, _ = scene
    chained = ChainedSightings.of(frames, RIG)
    jumped = ((chained.point == 1) & (chained.pose == 2)) | ((chained.point == 4) & (chained.pose == 0))
    left, shorter = without_jumps(chained, frames, jumped)
    assert left.track_ids.tolist() == [0, 1, 2, 3, 5]
    assert [frame.track_ids.tolist() for frame in shorter[:2]] == [[0, 1, 2, 3, 5], [0, 1, 3, 5]]
    assert left.pose[~left.counted].tolist() == [2]
    assert left.track_ids[left.point[~left.counted]].tolist() == [1]
    fresh = ChainedSightings.of(shorter, RIG)
    np.testing.assert_array_equal(left.chain.before, fresh.chain.before)
    np.testing.assert_array_equal(left.chain.carried, fresh.chain.carried)


def test_batch_is_the_gauss_newton_step_with_the_whole_covariance_of_every_track(oracle):
    """Errors of 1e-6 of the stated noise: everything is linear in effect, and nothing an outlier."""
    camera = replace(DRIVE.camera, max_tracks=20)
    scenario = replace(DRIVE, duration_s=0.8, camera=camera)
    recording = oracle.recorded(scenario, 1e-6)
    # With hardly any white noise the chain forgets next to nothing: (0.01 / 0.3)^2 of the variance.
    noise = TrackNoise(np.full(3, 0.01), np.full(3, 0.3), np.array([0.0, 1.4, 0.0]))
    sequence = replace(recording.sequence, rig=replace(recording.sequence.rig, track_noise=noise))
    recording = replace(recording, sequence=sequence)
    smoother = batch.build(replace(recording.setup, settings=Settings(outliers=POLICIES["none"])))
    for packet in sequence.packets():
        smoother.step(packet)
    finished = smoother.finish()
    truth = oracle.batch(recording, finished.landmarks.track_ids)
    for k, estimate in enumerate(finished.trajectory.states()):
        mean, cov = truth.state(k)
        assert np.abs(recording.error_of(estimate, k) - mean).max() < 0.01 * np.abs(mean).max()
        oracle.assert_covariances_agree(estimate.cov, cov, 0.01)


def test_batch_lets_mismatched_sightings_go_and_chains_their_tracks_over_them(run_estimator):
    noise = TrackNoise(np.full(3, 0.03), np.full(3, 0.13), np.array([0.0, 0.7, 0.0]))
    sequence = simulate(replace(DRIVE, duration_s=1.0, camera=replace(DRIVE.camera, max_tracks=20)), 5)
    sequence = replace(sequence, rig=replace(sequence.rig, track_noise=noise))
    seen = sequence.observations
    # One of every track, in the middle of its life.
    rows = [np.flatnonzero(seen.track_id == i) for i in np.unique(seen.track_id)]
    struck = np.isin(np.arange(len(seen)), [of_track[of_track.size // 2] for of_track in rows if of_track.size > 4])
    uv_px = seen.uv_px + 30.0 * struck[:, None] * np.array([1.0, 1.0, 1.0])
    without = run_estimator("batch", replace(sequence, observations=seen.select(~struck)))
    with_them = run_estimator("batch", replace(sequence, observations=replace(seen, uv_px=uv_px)))
    apart = with_them.final.T_world_imu[:, :3, 3] - without.final.T_world_imu[:, :3, 3]
    variances = (np.diagonal(run.final.cov, axis1=1, axis2=2)[:, :6] for run in (with_them, without))
    np.testing.assert_allclose(*variances, rtol=0.02)
    # The last solve stops where a hundredth of the cost is left to be gained.
    assert np.abs(apart).max() < 0.05 * np.sqrt(without.final.cov[:, 3:6, 3:6].max())
