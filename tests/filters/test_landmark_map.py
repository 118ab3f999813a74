"""The map of the decoupled filters: what starts, what leaves, and that nothing is kept that is not in view."""

import numpy as np
import pytest

from filters.kalman.landmark_map import LandmarkMap, TrackedMap, first_sighting
from toolkit.geometry import Array, se3_exp
from toolkit.measurements import StereoFrame
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DISPARITY_PX
from toolkit.simulation import DRIVE, simulate

RIG = DRIVE.rig
POSE = se3_exp(np.array([0.1, -0.2, 1.3, 20.0, -7.0, 2.0]))


def frame_of(ids: list[int], u_left: float = 400.0, disparity_px: float = 40.0) -> StereoFrame:
    uvs_px = np.array([[u_left + i, u_left + i - disparity_px, 150.0 + i] for i in ids]).reshape(-1, 3)
    return StereoFrame(0, np.array(ids, dtype=np.int64), uvs_px)


def test_a_first_sighting_stands_where_stereo_sees_it():
    frame = frame_of([3, 8, 9])
    started = first_sighting(frame, np.array([0, 2]), POSE, RIG)
    np.testing.assert_array_equal(started.track_ids, [3, 9])
    np.testing.assert_allclose(started.points, stereo.triangulate_world(frame.uvs_px[[0, 2]], POSE, RIG), atol=1e-12)


def test_the_covariance_of_a_first_sighting_is_the_measurements_carried_through_triangulation():
    """By numerical differences of the triangulation: an independent way to the same 3x3 matrix."""
    frame = frame_of([0, 30, 200])
    started, step = first_sighting(frame, np.arange(3), POSE, RIG), 1e-3
    for i, uv_px in enumerate(frame.uvs_px):
        columns = [
            (stereo.triangulate_world(uv_px + d, POSE, RIG) - stereo.triangulate_world(uv_px - d, POSE, RIG))
            for d in step * np.eye(3)
        ]
        jacobian = np.stack(columns, axis=1) / (2.0 * step)
        expected = jacobian @ RIG.cov_uv_px2 @ jacobian.T
        # Central differences at 40 px of disparity err by (1e-3 / 40)^2.
        np.testing.assert_allclose(started.covs[i], expected, atol=1e-7 * np.abs(expected).max())


def test_the_covariance_of_a_first_sighting_is_that_of_drawn_pixels():
    frame, rng, draws = frame_of([5], disparity_px=120.0), np.random.default_rng(6), 20_000
    started = first_sighting(frame, np.array([0]), POSE, RIG)
    uvs_px = frame.uvs_px + rng.standard_normal((draws, 3)) @ np.linalg.cholesky(RIG.cov_uv_px2).T
    errors = stereo.triangulate_world(uvs_px, POSE, RIG) - started.points
    normal = np.linalg.solve(np.linalg.cholesky(started.covs[0]), errors.T)
    # 20,000 draws: 0.01 on the diagonal, five of which are 0.05; the curvature at 120 px adds 1e-3.
    np.testing.assert_allclose(normal @ normal.T / draws, np.eye(3), atol=0.05)


def test_too_little_disparity_waits_for_a_better_view():
    far = frame_of([1], disparity_px=0.9 * LEAST_DISPARITY_PX)
    tracked = TrackedMap(RIG)
    seen, _ = tracked.seen_again(far)
    tracked.keep(seen, far, POSE)
    assert len(tracked.landmarks()) == 0
    near = frame_of([1], disparity_px=2.0 * LEAST_DISPARITY_PX)
    seen, _ = tracked.seen_again(near)
    tracked.keep(seen, near, POSE)
    np.testing.assert_array_equal(tracked.landmarks().track_ids, [1])


@pytest.mark.parametrize("disparity_px", [0.0, -5.0])
def test_a_sighting_without_disparity_starts_nothing(disparity_px):
    assert len(first_sighting(frame_of([1], disparity_px=disparity_px), np.array([0]), POSE, RIG)) == 0


def test_lost_landmarks_leave_the_state():
    """What is matched is at most what the last frame showed, however long the drive."""
    sequence = simulate(DRIVE, 0)
    tracked, before = TrackedMap(RIG), np.empty(0, dtype=np.int64)
    for packet, pose in zip(sequence.packets(), sequence.truth.T_world_imu, strict=True):
        seen, uvs_px = tracked.seen_again(packet.frame)
        assert set(seen.track_ids) <= set(before) & set(packet.frame.track_ids)
        assert len(seen) == len(uvs_px)
        tracked.keep(seen, packet.frame, pose)
        before = packet.frame.track_ids
    everyone = tracked.landmarks()
    assert np.isin(everyone.track_ids, sequence.visible.track_id).all()
    assert len(everyone) > 10 * before.size


def test_an_id_that_comes_back_is_a_new_landmark():
    tracked = TrackedMap(RIG)
    for frame in (frame_of([1, 2]), frame_of([2])):
        seen, _ = tracked.seen_again(frame)
        tracked.keep(seen, frame, POSE)
    returned = frame_of([1, 2], u_left=500.0)
    seen, _ = tracked.seen_again(returned)
    np.testing.assert_array_equal(seen.track_ids, [2])
    tracked.keep(seen, returned, POSE)
    expected = stereo.triangulate_world(returned.uvs_px[:1], POSE, RIG)
    np.testing.assert_allclose(tracked.landmarks().points_world[0], expected[0], atol=1e-12)


def moved(landmarks: LandmarkMap, by_m: Array) -> LandmarkMap:
    return landmarks.corrected(np.ones(len(landmarks), dtype=bool), landmarks.points + by_m, landmarks.covs)


def test_the_archive_keeps_every_id_once_with_its_last_value():
    tracked = TrackedMap(RIG)
    first, second = frame_of([4, 7]), frame_of([7])
    seen, _ = tracked.seen_again(first)
    tracked.keep(seen, first, POSE)
    seen, _ = tracked.seen_again(second)
    tracked.keep(moved(seen, np.array([1.0, 0.0, 0.0])), second, POSE)
    nothing = frame_of([])
    seen, _ = tracked.seen_again(nothing)
    tracked.keep(seen, nothing, POSE)
    # Returns to be archived a second time.
    seen, _ = tracked.seen_again(first)
    tracked.keep(moved(seen, np.zeros(3)), first, POSE)
    landmarks = tracked.landmarks()
    np.testing.assert_array_equal(landmarks.track_ids, [4, 7])
    np.testing.assert_allclose(landmarks.points_world, stereo.triangulate_world(first.uvs_px, POSE, RIG), atol=1e-12)


def test_the_last_value_of_a_lost_landmark_is_the_corrected_one():
    tracked = TrackedMap(RIG)
    frame = frame_of([4, 7])
    seen, _ = tracked.seen_again(frame)
    tracked.keep(seen, frame, POSE)
    seen, _ = tracked.seen_again(frame)
    shift_m = np.array([0.5, -0.25, 1.0])
    tracked.keep(moved(seen, shift_m), frame, POSE)
    tracked.seen_again(frame_of([]))
    expected = stereo.triangulate_world(frame.uvs_px, POSE, RIG) + shift_m
    np.testing.assert_allclose(tracked.landmarks().points_world, expected, atol=1e-12)


def test_matching_finds_exactly_the_common_ids():
    ids = np.array([2, 5, 9, 40])
    known = LandmarkMap(ids, np.zeros((4, 3)), np.zeros((4, 3, 3)))
    wanted = np.array([0, 5, 6, 40, 41])
    slots, rows = known.match(wanted)
    np.testing.assert_array_equal(ids[slots], [5, 40])
    np.testing.assert_array_equal(wanted[rows], [5, 40])
    for nothing in (LandmarkMap.empty().match(wanted), known.match(np.empty(0, dtype=np.int64))):
        assert all(len(part) == 0 for part in nothing)
