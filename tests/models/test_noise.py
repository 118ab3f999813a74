"""Noise that a file does not state is found in its samples, or set by a rule."""

import numpy as np
import pytest

from toolkit.models.noise import LEAST_GYRO_SIGMA_RADPS, LEAST_VELOCITY_SIGMA_MPS, twist_noise, white_sigma

SIGMAS = np.array([0.5, 0.3, 0.1])
COUNT = 12_000


@pytest.fixture
def drive() -> np.ndarray:
    """Velocities (2000, 3) at 10 Hz of a car that speeds up, slows down and sways, with white noise."""
    t_s = 0.1 * np.arange(COUNT)
    smooth = np.stack([8.0 + 4.0 * np.sin(0.3 * t_s), 0.3 * np.sin(0.9 * t_s), 0.1 * np.cos(t_s)], axis=1)
    return smooth + SIGMAS * np.random.default_rng(1).standard_normal((COUNT, 3))


def test_white_noise_on_a_smooth_motion_is_recovered_outliers_or_not(drive):
    # The median of 12,000 absolute values has a standard error of 1.1 %, 1.7 % where neighbours correlate as here.
    np.testing.assert_allclose(white_sigma(drive), SIGMAS, rtol=0.05)
    rng = np.random.default_rng(2)
    drive[rng.choice(COUNT, COUNT // 50, replace=False)] += 30.0  # 2 % of the samples spoil 6 % of the differences
    np.testing.assert_allclose(white_sigma(drive), SIGMAS, rtol=0.15)


@pytest.mark.parametrize("dt_s", [0.05, 0.1])
def test_the_density_of_a_held_sample_is_its_sigma_times_root_dt_whatever_the_gaps(drive, dt_s):
    t_ns = (1e9 * dt_s * np.arange(COUNT)).astype(np.int64)
    t_ns[1000:] += 60_000_000_000
    t_ns[500] = t_ns[499]
    noise = twist_noise(t_ns, drive, 0.1 * drive)
    np.testing.assert_allclose(noise.velocity_noise_density, SIGMAS * np.sqrt(dt_s), rtol=0.05)
    np.testing.assert_allclose(noise.gyro_noise_density, 0.1 * SIGMAS * np.sqrt(dt_s), rtol=0.05)


def test_no_odometer_is_taken_for_perfect():
    t_ns = (1e8 * np.arange(100)).astype(np.int64)
    noise = twist_noise(t_ns, np.zeros((100, 3)), np.zeros((100, 3)))
    np.testing.assert_allclose(noise.velocity_noise_density, LEAST_VELOCITY_SIGMA_MPS * np.sqrt(0.1))
    np.testing.assert_allclose(noise.gyro_noise_density, LEAST_GYRO_SIGMA_RADPS * np.sqrt(0.1))
    assert (noise.gyro_random_walk > 0.0).all()
