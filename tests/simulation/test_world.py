"""Landmarks, visibility and tracks."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.geometry import se3_inverse, transform
from toolkit.models.stereo import project
from toolkit.simulation import DRIVE, FLIGHT, Scenario
from toolkit.simulation.scenes import roadside
from toolkit.simulation.sensors import follow, visibility


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
def test_tracks_stay_within_their_number_and_are_visible(scenario: Scenario) -> None:
    _, _, seen = view(scenario)
    tracks = follow(seen, scenario.camera, np.random.default_rng(1))
    assert np.bincount(tracks.frame).max() <= scenario.camera.max_tracks
    assert seen[tracks.frame, tracks.landmark].all()


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=lambda s: s.name)
def test_a_track_is_one_landmark_without_gaps_and_never_comes_back(scenario: Scenario) -> None:
    _, _, seen = view(scenario)
    tracks = follow(seen, scenario.camera, np.random.default_rng(1))
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
