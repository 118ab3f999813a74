"""The start: velocity, roll and pitch from the first second, as good as claimed, and honest where it is blind."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toolkit.datasets import load_sequence
from toolkit.datasets.io.truth import load_truth, with_truth
from toolkit.errors import DataError, EstimatorError
from toolkit.geometry import Array, about_z, interpolate_poses, so3_exp, so3_log, yaw_of
from toolkit.initialization import INFLATION, start_from_measurements, start_from_truth
from toolkit.measurements import Prior
from toolkit.motion_samples import ImuSamples
from toolkit.sequence import Observations, Sequence
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, faults, simulate
from toolkit.simulation.scenes import FreeTrajectory, RotationSpline, Scene, UniformKnots, VectorSpline

SEEDS = range(3)


def unstarted(sequence: Sequence) -> Sequence:
    return replace(sequence, prior=None)


def errors_in_body(prior: Prior, sequence: Sequence) -> Array:
    """Return the error (15,) of a prior in the tangent its covariance is given in; the heading is the gauge's."""
    truth = sequence.truth
    R_world_start, R_world_imu = prior.T_world_imu[:3, :3], truth.T_world_imu[0, :3, :3]
    turn = about_z(float(yaw_of(R_world_start @ R_world_imu.T)))
    rotation = so3_log(R_world_start.T @ turn @ R_world_imu)
    velocity = R_world_imu.T @ truth.v_world[0] - R_world_start.T @ prior.v_world
    return np.concatenate([rotation, np.zeros(3), velocity, truth.bias[0] - prior.bias])


@pytest.mark.parametrize(
    ("scenario", "tilt_rad", "speed_mps"),
    # Measured over these seeds: at most 0.009 rad and 0.06 m/s on the drive (at 12 m/s, where an accelerometer bias of
    # 0.02 m/s^2 alone tilts by 0.002 rad), 0.004 rad and 0.014 m/s in flight. Twice that is asked for.
    [(DRIVE_IMU, 0.02, 0.12), (FLIGHT, 0.01, 0.03)],
    ids=["drive", "flight"],
)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_simulated_start_is_within_three_of_its_sigmas_and_small(scenario, tilt_rad, speed_mps, seed):
    sequence = simulate(replace(scenario, duration_s=3.0), seed)
    prior = start_from_measurements(unstarted(sequence))
    errors, sigmas = errors_in_body(prior, sequence), np.sqrt(np.diag(prior.cov))
    observable = np.r_[0:3, 6:15]
    assert (np.abs(errors[observable]) < 3.0 * sigmas[observable]).all()
    assert np.linalg.norm(errors[:3]) < tilt_rad
    assert np.linalg.norm(errors[6:9]) < speed_mps


# Heading and position are the gauge; what is left of an error (15,) are two tilts, velocity and biases.
FREE = 11


def hard_flight(seed: int, shaken: float = 1.0) -> Sequence:
    """Two seconds in which a sensor turns at up to 3 rad/s and more about axes that change, as it is thrown about.

    Its gyro's bias is unknown to 0.08 rad/s. Every seed is another motion; at ``shaken`` 4 the mean specific force is
    off the vertical by tens of degrees.
    """
    rng, knots = np.random.default_rng([7, seed]), UniformKnots(-0.24, 0.08)
    t_s = -0.24 + 0.08 * np.arange(40)[:, None]

    def waves(peak_rate: float) -> Array:
        frequency, phase = rng.uniform(2.0, 6.0, (3, 3)), rng.uniform(0.0, 2.0 * np.pi, (3, 3))
        share = rng.dirichlet([3.0, 3.0, 3.0], 3).T
        return sum(share[i] * peak_rate / frequency[i] * np.sin(frequency[i] * t_s + phase[i]) for i in range(3))

    def scene(duration_s: float) -> Scene:
        position, angles = np.array([0.0, 0.0, 2.1]) + waves(1.5 * shaken), waves(3.0)
        rotation = about_z(angles[:, 2]) @ so3_exp(angles * [1.0, 1.0, 0.0]) @ level
        return Scene(FreeTrajectory(VectorSpline(knots, position), RotationSpline(knots, rotation)), points)

    level, points = FLIGHT.scene(1.0).trajectory.at(np.zeros(1)).T_world_imu[0, :3, :3], FLIGHT.scene(1.0).points
    imu = replace(FLIGHT.motion, bias_sigma=np.repeat([0.02, 0.08], 3))
    return unstarted(simulate(replace(FLIGHT, scene=scene, motion=imu, duration_s=2.0), seed))


def normalised(prior: Prior, sequence: Sequence) -> float:
    """Return the error squared of a start over its covariance without the inflation, divided by its freedom."""
    up_in_body = prior.T_world_imu[2, :3]
    free = np.zeros((FREE, 15))
    free[:2, :3], free[2:, 6:] = np.linalg.svd(up_in_body[None])[2][1:], np.eye(9)
    error = free @ errors_in_body(prior, sequence)
    return float(INFLATION * error @ np.linalg.solve(free @ prior.cov @ free.T, error) / FREE)


@pytest.fixture(scope="module")
def hard() -> list[Sequence]:
    return [hard_flight(seed) for seed in range(6)]


def test_a_start_in_hard_motion_is_as_good_as_it_claims(hard: list[Sequence]):
    """Measured over 20 seeds: 1.1 of 1, at most 0.021 m/s and 0.006 rad; NEES of 66 variables scatter by 0.17."""
    assert max(np.abs(sequence.motion.gyro_radps).max() for sequence in hard) > 2.0
    priors = [start_from_measurements(sequence) for sequence in hard]
    assert 0.4 < np.mean([normalised(*both) for both in zip(priors, hard, strict=True)]) < 1.8
    errors = np.array([errors_in_body(*both) for both in zip(priors, hard, strict=True)])
    assert np.linalg.norm(errors[:, :3], axis=1).max() < 0.01
    assert np.linalg.norm(errors[:, 6:9], axis=1).max() < 0.04
    assert np.abs(errors[:, 12:]).max() < 0.005


def test_tracks_that_slide_are_left_out(hard: list[Sequence]):
    """Three of ten slide by 1 to 6 px a frame: with them in the adjustment it failed, or was off by 0.2 m/s."""
    for seed, sequence in enumerate(hard[:2]):
        prior = start_from_measurements(faults.outlier_tracks(sequence, 0.3, seed))
        assert np.linalg.norm(errors_in_body(prior, sequence)[6:9]) < 0.04
        assert normalised(prior, sequence) < 3.0


def test_a_mean_force_far_off_the_vertical_does_not_mislead():
    sequence = hard_flight(2, shaken=4.0)
    prior = start_from_measurements(sequence)
    assert np.linalg.norm(errors_in_body(prior, sequence)[:3]) < 0.02


def test_noise_stated_too_small_is_seen_in_the_tracks(hard: list[Sequence]):
    """The pixels scatter by thrice what is stated: the covariance is scaled by what the tracks show."""
    sequence = hard[0]
    fine = replace(sequence, rig=replace(sequence.rig, cov_uv_px2=sequence.rig.cov_uv_px2 / 9.0))
    reported, stated = start_from_measurements(fine), start_from_measurements(sequence)
    ratio = np.sqrt(np.diag(reported.cov) / np.diag(stated.cov))[6:9]
    # Alone the smaller noise would make these about a third; the IMU's part of them does not change.
    assert (ratio > 0.8).all()


def blinded(sequence: Sequence) -> Sequence:
    nothing = sequence.observations.select(np.zeros(len(sequence.observations), dtype=bool))
    return replace(unstarted(sequence), observations=nothing)


def shuffled(sequence: Sequence) -> Sequence:
    """Exchange the pixels of the tracks within each frame at random: a matcher that is broken."""
    seen, rng = sequence.observations, np.random.default_rng(0)
    order = np.lexsort((rng.uniform(size=len(seen)), seen.frame))
    return replace(sequence, observations=Observations(seen.frame, seen.track_id, seen.uv_px[order]))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda s: faults.linear_unit(s, 0.102), "stereo and accelerometer show a gravity of"),
        (shuffled, "tracks"),
        (blinded, "too few tracks"),
    ],
    ids=["accelerations in g", "shuffled tracks", "no tracks"],
)
def test_a_start_that_cannot_be_determined_is_refused_with_the_reason(
    hard: list[Sequence], spoil: Callable[[Sequence], Sequence], reason: str
):
    prior = start_from_measurements(spoil(hard[1]))
    assert "velocity unknown" in prior.source
    assert reason in prior.source
    np.testing.assert_array_equal(prior.v_world, 0.0)
    assert (np.sqrt(np.diag(prior.cov)[6:9]) >= 5.0).all()


def test_kitti00_starts_level_and_at_its_speed(real: Callable[[str], Path]):
    """The truth's world is its first IMU frame, not level: its vertical is what the specific force shows over 14 s."""
    sequence = with_truth(load_sequence("kitti00"), *load_truth(real("kitti00/gt_imu.tum")))
    prior, truth, samples = start_from_measurements(sequence), sequence.truth, sequence.motion
    inside = slice(1, -1)
    poses = interpolate_poses(truth.t_ns, truth.T_world_imu, samples.t_ns[inside])
    force = (poses[:, :3, :3] @ samples.accel_mps2[inside, :, None])[..., 0].mean(axis=0)
    v_first, v_last = (true_velocity(sequence, t_ns) for t_ns in sequence.frames_t_ns[[0, -1]])
    up = force - (v_last - v_first) / sequence.duration_s
    T_world_imu = interpolate_poses(truth.t_ns, truth.T_world_imu, sequence.frames_t_ns[:1])[0]
    up_in_body = T_world_imu[:3, :3].T @ up / np.linalg.norm(up)
    # Measured 0.0009 rad; the start claims 0.016 rad, for it cannot tell a tilt from an accelerometer bias.
    assert np.linalg.norm(np.cross(prior.T_world_imu[2, :3], up_in_body)) < 0.005
    # At 8.3 m/s the scale error of the tracks is 0.13 m/s forwards. Sideways the truth itself wanders by 0.2 m/s.
    error = T_world_imu[:3, :3].T @ v_first - prior.T_world_imu[:3, :3].T @ prior.v_world
    assert np.abs(error[0]) < 0.2
    assert np.linalg.norm(error) < 0.3


def true_velocity(sequence: Sequence, t_ns: int) -> Array:
    """Return the velocity (3,) of a quadratic through the true positions 0.35 s to each side."""
    truth = sequence.truth
    near = np.abs(truth.t_ns - t_ns) < 350_000_000
    velocity: Array = np.polyfit((truth.t_ns[near] - t_ns) / 1e9, truth.T_world_imu[near, :3, 3], 2)[1]
    return velocity


def standstill() -> Sequence:
    """Two seconds in which the flight's sensor stands where it begins, tilted as it is there."""
    flight, rng = simulate(replace(FLIGHT, duration_s=2.0), 1), np.random.default_rng(2)
    seen = flight.observations.select(flight.observations.frame == 0)
    frames = np.repeat(np.arange(flight.frame_count), len(seen))
    uv_px = np.tile(seen.uv_px, (flight.frame_count, 1)) + rng.standard_normal((frames.size, 3))
    R_world_imu = flight.truth.T_world_imu[0, :3, :3]
    count = flight.motion.t_ns.size
    accel = R_world_imu.T @ -flight.gravity_world + 0.03 * rng.standard_normal((count, 3))
    motion = ImuSamples(flight.motion.t_ns, accel, 0.0024 * rng.standard_normal((count, 3)))
    observations = Observations(frames, np.tile(seen.track_id, flight.frame_count), uv_px)
    return replace(flight, observations=observations, motion=motion, prior=None)


def test_standing_still_is_seen_as_standing_still():
    sequence = standstill()
    prior = start_from_measurements(sequence)
    # 30 frames of 90 tracks at 1 px and some metres: a millimetre over 1.5 s.
    assert np.linalg.norm(prior.v_world) < 0.02
    up_in_body = sequence.truth.T_world_imu[0, 2, :3]
    # The accelerometer's bias, unknown to 0.05 m/s^2, is 0.005 rad; here there is none to be mistaken.
    assert np.linalg.norm(np.cross(prior.T_world_imu[2, :3], up_in_body)) < 0.005


@pytest.mark.parametrize("see", [standstill, lambda: blinded(simulate(replace(FLIGHT, duration_s=3.0), 0))])
def test_heading_and_position_are_the_gauge_and_start_at_zero(see):
    prior = start_from_measurements(see())
    np.testing.assert_allclose(prior.T_world_imu[:3, 3], 0.0, atol=1e-3)
    assert (np.linalg.eigvalsh(prior.cov) > 0.0).all()
    np.testing.assert_array_equal(prior.cov, prior.cov.T)


def test_a_recordings_own_prior_is_used_as_it_is_and_a_twist_starts_in_its_own_frame():
    sequence = simulate(replace(DRIVE, duration_s=2.0), 0)
    assert start_from_measurements(sequence) is sequence.prior
    prior = start_from_measurements(unstarted(sequence))
    np.testing.assert_array_equal(prior.T_world_imu, np.eye(4))
    np.testing.assert_array_equal(prior.bias, 0.0)
    assert "first IMU frame" in prior.source


def test_upside_down_is_a_way_to_start():
    """Specific force straight down in the sensor: the half turn has no unique axis, any will do."""
    still = standstill()
    accel = np.tile([0.0, 0.0, -9.81], (still.motion.t_ns.size, 1))
    motion = ImuSamples(still.motion.t_ns, accel, np.zeros_like(accel))
    prior = start_from_measurements(blinded(replace(still, motion=motion)))
    np.testing.assert_allclose(prior.T_world_imu[2, :3], [0.0, 0.0, -1.0], atol=1e-9)


def test_a_start_from_truth_is_the_truth_and_says_so():
    sequence = simulate(replace(FLIGHT, duration_s=2.0), 0)
    prior = start_from_truth(sequence)
    np.testing.assert_array_equal(prior.T_world_imu, sequence.truth.T_world_imu[0])
    np.testing.assert_array_equal(prior.v_world, sequence.truth.v_world[0])
    assert "truth" in prior.source
    bare = start_from_truth(replace(sequence, truth=replace(sequence.truth, v_world=None)))
    # A one-sided difference over 50 ms of a flight that accelerates by 1 m/s^2.
    np.testing.assert_allclose(bare.v_world, sequence.truth.v_world[0], atol=0.05)
    truth = sequence.truth
    late = replace(truth, t_ns=truth.t_ns[5:], T_world_imu=truth.T_world_imu[5:], v_world=None, bias=None)
    for without in (None, late):
        with pytest.raises(DataError, match="no truth at the first frame"):
            start_from_truth(replace(sequence, truth=without))


def test_an_adjustment_without_a_sound_solution_is_reported_and_not_raised(monkeypatch):
    def refuse(*_):
        raise EstimatorError("the window does not determine its states")

    monkeypatch.setattr("toolkit.initialization.solve_window", refuse)
    sequence = replace(simulate(replace(FLIGHT, duration_s=3.0), 0), prior=None)
    prior = start_from_measurements(sequence)
    assert "no sound solution" in prior.source
    assert np.isfinite(prior.cov).all()
