"""What sensors see and how noisy they are, as stated; exact ones lead estimators to the truth (tests/contracts)."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.geometry import se3_inverse, se3_log, transform
from toolkit.models.stereo import project
from toolkit.simulation import DRIVE, FLIGHT, Scenario, simulate
from toolkit.simulation.scenes import roadside
from toolkit.simulation.sensors import follow, visibility


def test_the_prior_errs_as_its_covariance_says() -> None:
    errors = []
    for seed in range(200):
        sequence = simulate(replace(FLIGHT, duration_s=0.1), seed)
        truth, prior = sequence.truth, sequence.prior
        pose = se3_log(se3_inverse(prior.T_world_imu) @ truth.T_world_imu[0])
        v = prior.T_world_imu[:3, :3].T @ (truth.v_world[0] - prior.v_world)
        error = np.concatenate([pose, v, truth.bias[0] - prior.bias])
        errors.append(error @ np.linalg.solve(prior.cov, error))
    # The mean of 200 chi-square values with 15 degrees of freedom.
    assert abs(np.mean(errors) - 15.0) < 5.0 * np.sqrt(30.0 / 200)


def test_outliers_are_as_many_as_requested_and_stay_in_the_image() -> None:
    struck = replace(DRIVE, camera=replace(DRIVE.camera, outlier_rate=0.1))
    clean, dirty = simulate(DRIVE, 6).observations.uv_px, simulate(struck, 6).observations.uv_px
    moved_px = np.linalg.norm((dirty - clean)[:, [0, 2]], axis=1)
    hit = moved_px > 0.0
    assert abs(hit.mean() - 0.1) < 5.0 * np.sqrt(0.09 / hit.size)
    assert (moved_px[hit] > 4.99).all()
    assert (moved_px[hit] < 30.01).all()
    width, height = DRIVE.camera.size_px
    assert (dirty >= 0.0).all()
    assert (dirty <= [width - 1, width - 1, height - 1]).all()


def view(scenario: Scenario) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return poses (K, 4, 4), landmarks (M, 3) and their visibility (K, M) over 10 s."""
    scene = scenario.scene(10.0)
    poses = scene.trajectory.at(np.arange(0.0, 10.0, 1.0 / scenario.camera.rate_hz)).T_world_imu
    return poses, scene.points, visibility(scene.points, poses, scenario.rig, scenario.camera)


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=lambda s: s.name)
def test_visible_is_in_both_images_and_in_the_depth_range_and_nothing_else(scenario: Scenario) -> None:
    poses, points, seen = view(scenario)
    camera, rig = scenario.camera, scenario.rig
    for T_world_imu, row in zip(poses[::17], seen[::17], strict=True):
        points_cam = transform(se3_inverse(T_world_imu @ rig.T_imu_cam), points)
        u_left, u_right, v = project(points_cam, rig).T
        width, height = camera.size_px
        expected = (points_cam[:, 2] >= camera.depth_m[0]) & (points_cam[:, 2] <= camera.depth_m[1])
        for coordinate, size in ((u_left, width), (u_right, width), (v, height)):
            expected &= (coordinate >= camera.border_px) & (coordinate <= size - 1 - camera.border_px)
        np.testing.assert_array_equal(row, expected)
        assert row.sum() > 40


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=lambda s: s.name)
def test_a_track_is_one_visible_landmark_without_gaps_and_never_comes_back(scenario: Scenario) -> None:
    _, _, seen = view(scenario)
    tracks = follow(seen, scenario.camera, np.random.default_rng(1))
    assert np.bincount(tracks.frame).max() <= scenario.camera.max_tracks
    assert seen[tracks.frame, tracks.landmark].all()
    order = np.lexsort((tracks.frame, tracks.track_id))
    track_id, frame, landmark = tracks.track_id[order], tracks.frame[order], tracks.landmark[order]
    same = np.diff(track_id) == 0
    assert (np.diff(frame)[same] == 1).all()
    assert (np.diff(landmark)[same] == 0).all()
    first_frame = frame[np.flatnonzero(np.r_[True, ~same])]
    assert (np.diff(first_frame) >= 0).all(), "ids are given in order of time"


def test_tracks_end_by_chance_as_often_as_requested() -> None:
    seen = np.ones((400, 150), dtype=bool)  # nothing ever leaves the view
    camera = replace(FLIGHT.camera, loss_per_frame=0.04)
    tracks = follow(seen, camera, np.random.default_rng(5))
    continued = 399 * camera.max_tracks
    ended = tracks.track_id.max() + 1 - camera.max_tracks
    # Binomial: five standard deviations.
    assert abs(ended / continued - 0.04) < 5.0 * np.sqrt(0.04 * 0.96 / continued)


def test_no_landmark_stands_in_the_way_however_long_the_road_is() -> None:
    """Distances of all points to all poses would take 30 GB."""
    path = np.tile(np.eye(4), (20_000, 1, 1))
    path[:, 0, 3], path[:, 1, 3] = np.arange(20_000.0), 30.0 * np.sin(np.arange(20_000.0) / 40.0)
    points = roadside(path, 5, np.random.default_rng(0))
    some = points[::997]
    nearest_m = np.sqrt(((some[:, None, :2] - path[None, :, :2, 3]) ** 2).sum(axis=-1).min(axis=1))
    assert nearest_m.min() >= 3.0
    assert len(points) > 90_000
