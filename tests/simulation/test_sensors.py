"""Exact measurements integrate to the truth; noisy ones have the noise they state. Tolerances: five sigma."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.geometry import Array, se3_exp, se3_inverse, se3_log, so3_exp
from toolkit.measurements import NS_PER_S, ImuMotion, ImuNoise, TwistMotion
from toolkit.models import stereo
from toolkit.motion_samples import ImuSamples, TwistSamples
from toolkit.sequence import Sequence, Truth
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, Scenario, noise_free, simulate
from toolkit.simulation.sensors import Imu


def truth_of(sequence: Sequence) -> Truth:
    assert sequence.truth is not None
    return sequence.truth


def imu_motion(scenario: Scenario, rate_hz: float) -> Scenario:
    assert isinstance(scenario.motion, Imu)
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
    assert truth.v_world is not None
    poses, v = truth.T_world_imu, truth.v_world
    for packet in sequence.packets():
        if packet.index == 0:
            continue
        assert isinstance(packet.motion, ImuMotion)
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


def test_an_imu_at_rest_on_average_feels_the_reaction_to_gravity() -> None:
    sequence = simulate(noise_free(replace(FLIGHT, duration_s=60.0)), 0)
    assert isinstance(sequence.motion, ImuSamples)
    truth = truth_of(sequence)
    after_frames = np.searchsorted(sequence.motion.t_ns, truth.t_ns)
    f_world = np.einsum("nij,nj->ni", truth.T_world_imu[:, :3, :3], sequence.motion.accel_mps2[after_frames])
    # The mean acceleration is (v_end - v_start) / 60 s, below 0.05 m/s^2.
    np.testing.assert_allclose(f_world.mean(axis=0), -sequence.gravity_world, atol=0.05)


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


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=lambda s: s.name)
def test_pixel_noise_has_the_covariance_of_the_rig(scenario: Scenario) -> None:
    noisy, exact = simulate(scenario, 3).observations, simulate(noise_free(scenario), 3).observations
    np.testing.assert_array_equal(noisy.track_id, exact.track_id)
    cov = np.cov((noisy.uv_px - exact.uv_px).T)
    # The variance of an estimated (co)variance of n samples is at most 2 sigma^4 / n.
    np.testing.assert_allclose(cov, scenario.rig.cov_uv_px2, atol=5.0 * np.sqrt(2.0 / len(noisy)))


def test_twist_noise_has_its_density_and_a_constant_small_bias() -> None:
    noisy, exact = (simulate(s, 4) for s in (DRIVE, noise_free(DRIVE)))
    assert isinstance(noisy.motion, TwistSamples)
    assert noisy.motion.t_ns.size == noisy.frame_count
    error = noisy.motion.values - exact.motion.values
    bias = truth_of(noisy).bias
    assert bias is not None
    error[:, 3:] -= bias[:, 3:]
    n = error.size / 2
    assert abs(error[:, :3].std() / 0.05 - 1.0) < 5.0 / np.sqrt(2.0 * n)
    assert abs(error[:, 3:].std() / 0.005 - 1.0) < 5.0 / np.sqrt(2.0 * n)
    # 60 s of walk at 1e-5 rad/s^2/sqrt(Hz) is 8e-5 rad/s; the audit calls 3e-3 rad/s a fault.
    assert np.ptp(bias[:, 3:], axis=0).max() < 5e-4
    assert np.abs(bias[:, 3:]).max() < 1.5e-3


@pytest.mark.parametrize("scenario", [FLIGHT, DRIVE_IMU], ids=lambda s: s.name)
def test_imu_noise_and_bias_walk_have_their_densities(scenario: Scenario) -> None:
    assert isinstance(scenario.motion, Imu)
    rate_hz, noise = scenario.motion.rate_hz, scenario.motion.noise
    at_rate = imu_motion(noise_free(scenario), rate_hz)
    error = simulate(scenario, 5).motion.values - simulate(at_rate, 5).motion.values
    # Neighbouring differences see the white noise twice and next to nothing of the walk.
    white = np.diff(error, axis=0) / np.sqrt(2.0 * rate_hz)
    density = np.array([white[:, :3].std(), white[:, 3:].std()])
    # Differences are correlated: their variance is known as if from two thirds of the samples.
    tolerance = 5.0 / np.sqrt(2.0 * 3.0 * len(error) * 2.0 / 3.0)
    np.testing.assert_allclose(density, [noise.accel_noise_density, noise.gyro_noise_density], rtol=tolerance)


def test_the_bias_walks_at_its_density() -> None:
    assert isinstance(FLIGHT.motion, Imu)
    noise: ImuNoise = FLIGHT.motion.noise
    steps = []
    for seed in range(4):
        bias = truth_of(simulate(replace(FLIGHT, duration_s=30.0), seed)).bias
        assert bias is not None
        steps.append(np.diff(bias, axis=0))
    step = np.concatenate(steps)
    density = np.array([step[:, :3].std(), step[:, 3:].std()]) * np.sqrt(FLIGHT.camera.rate_hz)
    expected = [noise.accel_random_walk, noise.gyro_random_walk]
    np.testing.assert_allclose(density, expected, rtol=5.0 / np.sqrt(step.size))


def test_the_prior_errs_as_its_covariance_says() -> None:
    errors = []
    for seed in range(200):
        sequence = simulate(replace(FLIGHT, duration_s=0.1), seed)
        truth, prior = truth_of(sequence), sequence.prior
        assert prior is not None
        assert truth.v_world is not None
        assert truth.bias is not None
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


def test_twists_span_exactly_the_frames() -> None:
    sequence = simulate(replace(DRIVE, duration_s=2.0), 0)
    t_ns, frames = sequence.motion.t_ns, sequence.frames_t_ns
    assert t_ns[0] == frames[0]
    assert t_ns[-1] == frames[-1] == frames[0] + 2 * NS_PER_S


@pytest.mark.parametrize("scenario", [DRIVE_IMU, FLIGHT], ids=lambda s: s.name)
def test_imu_samples_stand_in_the_middle_of_their_intervals_and_span_the_frames(scenario: Scenario) -> None:
    sequence = simulate(replace(scenario, duration_s=2.0), 0)
    t_ns, frames = sequence.motion.t_ns, sequence.frames_t_ns
    assert isinstance(scenario.motion, Imu)
    half_ns = round(0.5 * NS_PER_S / scenario.motion.rate_hz)
    assert t_ns[0] == frames[0] - half_ns
    assert t_ns[-1] == frames[-1] + half_ns
    assert frames[-1] == frames[0] + 2 * NS_PER_S
