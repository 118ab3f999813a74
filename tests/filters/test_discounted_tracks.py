"""Sightings that count for a share in smoothers: of every cost that share, outliers where they were, old ones too."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from filters.kalman.residual_correlation import ResidualCorrelation
from filters.smoothing.discounted_tracks import (
    DiscountedTracks,
    Residuals,
    discounted,
    discounted_past,
    residuals_of,
    seen_often,
)
from filters.smoothing.graph_builder import GraphBuilder
from toolkit.estimator import Setup
from toolkit.geometry import se3_exp
from toolkit.models import stereo
from toolkit.models.factors import L, StereoFactors, X, huber_loss, linear_factor
from toolkit.sequence import StereoFrame
from toolkit.settings import POLICIES, Settings
from toolkit.simulation import DRIVE, simulate

SHARE, HUBER = 0.1, 1.5


@pytest.fixture(scope="module")
def rig():
    return simulate(DRIVE, 0).rig


def frame(track_ids, uvs_px):
    ids = np.array(track_ids)
    return StereoFrame(0, ids, np.asarray(uvs_px, dtype=float), np.zeros(ids.size, dtype=np.int64))


def factors(rig, huber, seen):
    graph = gtsam.NonlinearFactorGraph()
    for factor in StereoFactors(rig, huber_loss(huber)).of(seen, 0):
        graph.add(factor)
    return graph


@pytest.fixture
def scene(rig):
    """Return a frame of four sightings, the last by the left image alone and the third far off, and the values."""
    points = np.array([[12.0, 1.0, 0.5], [20.0, -3.0, 0.0], [15.0, 2.0, 1.0], [9.0, 0.0, 0.2]])
    uvs_px = stereo.predict(points, np.eye(4), rig).uv_px + np.array([[0.3], [-0.4], [9.0], [0.5]])
    uvs_px[3, 1] = np.nan
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    for track_id, point in enumerate(points):
        values.insert(L(track_id), point)
    return frame(range(4), uvs_px), values


@pytest.mark.parametrize("huber", [None, HUBER])
def test_every_sighting_costs_the_share_of_what_it_cost_outliers_too(rig, scene, huber):
    seen, values = scene
    whole, part = factors(rig, huber, seen), factors(*discounted(rig, huber, SHARE), seen)
    for i in range(whole.size()):
        assert part.at(i).error(values) == pytest.approx(SHARE * whole.at(i).error(values), rel=1e-9)


def test_a_whole_share_is_the_rig_itself(rig):
    assert discounted(rig, HUBER, 1.0) == (rig, HUBER)


def test_factors_made_anew_cost_what_new_ones_do_and_others_stay_as_they_were(rig, scene):
    seen, values = scene
    graph = factors(rig, HUBER, seen)
    prior = gtsam.PriorFactorPose3(
        X(0), gtsam.Pose3(se3_exp(np.full(6, 0.1))), gtsam.noiseModel.Isotropic.Sigma(6, 0.2)
    )
    graph.add(prior)
    part, threshold = discounted(rig, HUBER, SHARE)
    made, expected = StereoFactors(part, huber_loss(threshold)).remade(graph), factors(part, threshold, seen)
    assert made.size() == graph.size()
    for i in range(expected.size()):
        assert made.at(i).error(values) == pytest.approx(expected.at(i).error(values), rel=1e-12)
    assert made.at(4).error(values) == prior.error(values)


@pytest.mark.parametrize("policy", ["robust", "gate"])
def test_tracks_that_count_for_less_keep_the_loss_of_the_policy(policy, monkeypatch):
    s, settings = simulate(replace(DRIVE, duration_s=1.0), 0), Settings(outliers=POLICIES[policy])
    tracks = DiscountedTracks(Setup(s.rig, s.noise, s.prior, s.gravity_world, s.motion_kind, settings=settings))
    monkeypatch.setattr(DiscountedTracks, "share", SHARE)
    huber = settings.outliers.smoother_huber
    assert tracks.now.huber == (None if huber is None else pytest.approx(huber * SHARE**0.5))


@pytest.fixture
def past():
    """Return a marginal on two poses and three landmarks, about where they are, and these values."""
    rng, values = np.random.default_rng(3), gtsam.Values()
    for k in range(2):
        values.insert(X(k), gtsam.Pose3(se3_exp(rng.normal(size=6))))
    for i in range(3):
        values.insert(L(i), rng.normal(size=3))
    sizes = {L(0): 3, X(0): 6, L(1): 3, X(1): 6, L(2): 3}
    factor = linear_factor([(key, rng.normal(size=(21, size))) for key, size in sizes.items()], rng.normal(size=21))
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.LinearContainerFactor(factor, values))
    return graph, values


def information(graph, values):
    """Return the information of landmarks (9, 9) of a graph, with poses (9, 12), of poses (12, 12), and the step."""
    order = gtsam.Ordering()
    for key in (*map(L, range(3)), *map(X, range(2))):
        order.push_back(key)
    whole, messages = graph.linearize(values).hessian(order)
    return whole[:9, :9], whole[:9, 9:], whole[9:, 9:], np.linalg.solve(whole, messages)


def test_what_left_a_window_determines_the_share_of_landmarks_given_states_and_all_of_states(past):
    graph, values = past
    landmarks, across, states, step = information(graph, values)
    made = discounted_past(graph, values, SHARE)
    less, across_then, states_then, step_then = information(made, values)
    np.testing.assert_allclose(less, SHARE * landmarks, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(across_then, SHARE * across, rtol=1e-9, atol=1e-9)
    of_states = states - across.T @ np.linalg.solve(landmarks, across)
    np.testing.assert_allclose(
        states_then - across_then.T @ np.linalg.solve(less, across_then), of_states, rtol=1e-7, atol=1e-7
    )
    np.testing.assert_allclose(step_then, step, rtol=1e-6, atol=1e-8)


def test_what_left_a_window_counts_for_less_once_sightings_do_and_never_for_more(past, monkeypatch):
    graph, values = past
    sequence = simulate(DRIVE, 0)
    builder = GraphBuilder(
        Setup(sequence.rig, sequence.noise, sequence.prior, sequence.gravity_world, sequence.motion_kind)
    )
    landmarks, *_ = information(graph, values)
    for share, kept in ((0.5, 0.5), (0.1, 0.1), (0.3, 0.1)):
        monkeypatch.setattr(ResidualCorrelation, "share", property(lambda self, share=share: share))
        assert builder.is_outdated
        graph = builder.window_brought_up_to_date(graph, values)
        np.testing.assert_allclose(information(graph, values)[0], kept * landmarks, rtol=1e-9, atol=1e-9)


def test_pairs_are_of_one_track_in_successive_frames_and_of_no_outlier():
    tracks, frames = np.array([7, 7, 7, 9, 9, 8, 8]), np.array([0, 1, 3, 0, 1, 1, 2])
    whitened = np.arange(21.0).reshape(7, 3) / 20.0
    whitened[4] = 10.0
    residuals = Residuals(tracks, frames, np.zeros((7, 3)), whitened, np.zeros((7, 3, 6))).sound
    before, after = residuals.successive()
    np.testing.assert_array_equal(residuals.tracks, np.delete(tracks, 4))
    np.testing.assert_array_equal(before, whitened[[0, 5]])
    np.testing.assert_array_equal(after, whitened[[1, 6]])


def test_residuals_are_those_of_the_points_that_are_known(rig):
    points = {3: np.array([12.0, 1.0, 0.5]), 4: np.array([20.0, -3.0, 0.0])}
    poses = np.array([se3_exp(np.array([0.0, 0.0, 0.01 * k, 0.4 * k, 0.0, 0.0])) for k in range(2)])
    exact = [stereo.predict(np.array(list(points.values())), T, rig).uv_px for T in poses]
    off_px = np.linalg.inv(rig.whitener) @ np.array([0.5, -0.2, 0.1])
    frames = [frame([3, 4, 5], [*(uv + off_px), [0.0, 0.0, 0.0]]) for uv in exact]
    before, after = residuals_of(frames, poses, points, rig).successive()
    np.testing.assert_allclose(before, np.tile([0.5, -0.2, 0.1], (2, 1)), atol=1e-9)
    np.testing.assert_allclose(after, before, atol=1e-9)
    assert all(len(each) == 0 for each in residuals_of(frames, poses, {}, rig).successive())


def test_tracks_seen_often_have_four_sightings():
    frames = [frame([1, 2], np.zeros((2, 3)))] * 3 + [frame([2], np.zeros((1, 3)))]
    assert seen_often(frames) == {2}


@pytest.fixture(scope="module")
def clusters_err_as_one(rig):
    """Return 60 frames from one place, their poses, and points in clusters whose tracks err alike and as before."""
    rng = np.random.default_rng(0)
    corners = np.stack(np.meshgrid([10.0, 14.0, 18.0], np.linspace(-4.0, 4.0, 6), [-1.0, 1.0]), axis=-1).reshape(
        -1, 1, 3
    )
    points = (corners + rng.uniform(-0.05, 0.05, (36, 4, 3))).reshape(-1, 3)
    exact_px, frames = stereo.predict(points, np.eye(4), rig).uv_px, []
    errors = np.zeros((36, 4, 3))
    for _ in range(60):
        new = np.sqrt(0.5) * (rng.normal(size=(36, 1, 3)) + rng.normal(size=(36, 4, 3)))
        errors = 0.8 * errors + 0.6 * new
        frames.append(frame(range(len(points)), exact_px + errors.reshape(-1, 3) @ np.linalg.inv(rig.whitener).T))
    return frames, np.tile(np.eye(4), (60, 1, 1)), dict(enumerate(points))


@pytest.mark.parametrize(("noise_factor", "counts"), [(1.0, False), (10.0, True)])
def test_neighbours_count_beside_odometry_whose_white_noise_is_larger_than_what_lasts_of_its_errors(
    noise_factor, counts, clusters_err_as_one
):
    sequence = simulate(DRIVE, 0)
    noise = sequence.noise.scaled(noise_factor)
    tracks = DiscountedTracks(Setup(sequence.rig, noise, sequence.prior, sequence.gravity_world, sequence.motion_kind))
    tracks.learn_from_all(*clusters_err_as_one)
    assert tracks.share < 0.3
    assert ("neighbours have a common error" in tracks.messages[0]) == counts
