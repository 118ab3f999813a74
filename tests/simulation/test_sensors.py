"""Exact measurements integrate to the truth; noisy ones have the noise they state. Tolerances: five sigma."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.geometry import Array, se3_exp, se3_inverse, se3_log, so3_exp, transform
from toolkit.measurements import NS_PER_S, ImuMotion, TwistMotion
from toolkit.models import stereo
from toolkit.models.stereo import project
from toolkit.sequence import Sequence, Truth
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, Scenario, noise_free, simulate
from toolkit.simulation.scenes import roadside
from toolkit.simulation.sensors import follow, visibility


def truth_of(sequence: Sequence) -> Truth:
    return sequence.truth


def imu_motion(scenario: Scenario, rate_hz: float) -> Scenario:
    return replace(scenario, motion=replace(scenario.motion, rate_hz=rate_hz))


def integrate_midpoint(motion: ImuMotion, state: tuple[Array, Array, Array], gravity: Array) -> tuple[Array, ...]:
    """Carry (rotation, position, velocity) with the mid-interval specific force turned by half the step."""
    rotation, p, v = state
    for dt_s, accel, gyro in zip(motion.dt_s, motion.accel_mps2, motion.gyro_radps, strict=True):
        a = rotation @ so3_exp(0.5 * dt_s * gyro) @ accel + gravity
        rotation, p, v = rotation @ so3_exp(dt_s * gyro), p + dt_s * v + 0.5 * dt_s**2 * a, v + dt_s * a
    return rotation, p, v


def largest_step_errors(sequence: Sequence) -> Array:
    """Return the largest errors (rad, m, m/s) of one frame's integration from the true state."""
    truth, errors = truth_of(sequence), []
    poses, v = truth.T_world_imu, truth.v_world
    for packet in sequence.packets():
        if packet.index == 0:
            continue
        start = (poses[packet.index - 1, :3, :3], poses[packet.index - 1, :3, 3], v[packet.index - 1])
        rotation, p, v_end = integrate_midpoint(packet.motion, start, sequence.gravity_world)
        expected = poses[packet.index]
        turn = np.linalg.norm(rotation - expected[:3, :3]) / np.sqrt(2.0)
        errors.append([turn, np.linalg.norm(p - expected[:3, 3]), np.linalg.norm(v_end - v[packet.index])])
    return np.asarray(np.max(errors, axis=0))


def test_exact_twists_integrate_exactly() -> None:
    sequence = simulate(noise_free(replace(DRIVE, duration_s=10.0)), 0)
    poses = truth_of(sequence).T_world_imu
    T = poses[0]
    for packet in sequence.packets():
        if isinstance(packet.motion, TwistMotion):
            dt_s = packet.motion.dt_s[0]
            T = T @ se3_exp(dt_s * np.concatenate([packet.motion.w_radps[0], packet.motion.v_mps[0]]))
    np.testing.assert_allclose(T, poses[-1], atol=1e-11)


@pytest.mark.parametrize("scenario", [FLIGHT, DRIVE_IMU], ids=lambda s: s.name)
def test_exact_imu_integrates_to_the_truth(scenario: Scenario) -> None:
    """At 1 kHz a frame's integration errs by less than 1e-7 in every quantity."""
    errors = largest_step_errors(simulate(noise_free(replace(scenario, duration_s=3.0)), 0))
    assert (errors < 1e-7).all()


def test_the_error_of_exact_imu_falls_with_the_square_of_the_interval() -> None:
    """So the samples are exact and only the integration rule errs."""
    exact = noise_free(replace(FLIGHT, duration_s=3.0))
    slow, fast = (largest_step_errors(simulate(imu_motion(exact, rate), 0)) for rate in (100.0, 200.0))
    np.testing.assert_allclose(slow / fast, 4.0, rtol=0.1)


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=lambda s: s.name)
def test_exact_sightings_of_a_track_meet_in_one_point(scenario: Scenario) -> None:
    sequence = simulate(noise_free(replace(scenario, duration_s=4.0)), 0)
    seen, poses = sequence.observations, truth_of(sequence).T_world_imu
    points = stereo.triangulate_world(seen.uv_px, poses[seen.frame], sequence.rig)
    first = np.unique(seen.track_id, return_index=True)[1]
    landmark = points[first][seen.track_id]
    np.testing.assert_allclose(points, landmark, atol=1e-9)
    expected = stereo.predict(landmark, poses[seen.frame], sequence.rig).uv_px
    np.testing.assert_allclose(seen.uv_px, expected, atol=1e-8)


def test_the_prior_errs_as_its_covariance_says() -> None:
    errors = []
    for seed in range(200):
        sequence = simulate(replace(FLIGHT, duration_s=0.1), seed)
        truth, prior = truth_of(sequence), sequence.prior
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


@pytest.mark.parametrize("scenario", [DRIVE_IMU, FLIGHT], ids=lambda s: s.name)
def test_imu_samples_stand_in_the_middle_of_their_intervals_and_span_the_frames(scenario: Scenario) -> None:
    sequence = simulate(replace(scenario, duration_s=2.0), 0)
    t_ns, frames = sequence.motion.t_ns, sequence.frames_t_ns
    half_ns = round(0.5 * NS_PER_S / scenario.motion.rate_hz)
    assert t_ns[0] == frames[0] - half_ns
    assert t_ns[-1] == frames[-1] + half_ns
    assert frames[-1] == frames[0] + 2 * NS_PER_S


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
