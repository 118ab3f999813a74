"""Noise for files that state none: estimated from the samples, or by a documented rule. Never a per-file constant."""

import numpy as np

from toolkit.geometry import Array, IntArray
from toolkit.measurements import NS_PER_S, ImuNoise, TwistChangeNoise, TwistNoise
from toolkit.models.gating import MAD_TO_SIGMA

# Standard deviation of one tracked image coordinate (px) where a file states none: sparse KLT on rectified video.
TRACKED_PIXEL_SIGMA_PX = 0.5
# Least noise of an odometer, even where its samples look free of noise: pairing, wheel slip, lever arm.
LEAST_VELOCITY_SIGMA_MPS = 0.05
LEAST_GYRO_SIGMA_RADPS = 0.005
# Random walk of a gyro bias (rad/s^2/sqrt(Hz)) of a good MEMS unit: it moves by 2e-4 rad/s in 100 s.
GYRO_RANDOM_WALK = 2e-5
# White noise (m/s^2/sqrt(Hz), rad/s/sqrt(Hz)) and accelerometer walk (m/s^3/sqrt(Hz)) of such a unit in motion, where
# vibration and scale count for more than its data sheet: as on EuRoC's recordings (io/euroc_calibration), rounded up.
MEMS_ACCEL, MEMS_GYRO, MEMS_ACCEL_WALK = 2e-2, 1e-3, 3e-3
# Change of an unmeasured motion (m/s^2/sqrt(Hz), rad/s^2/sqrt(Hz)): a second of braking at 3 m/s^2, or of a hand that
# turns at 1 rad/s. The tracks determine the motion; a factor of three in these numbers changes the result little.
VELOCITY_CHANGE, TURN_CHANGE = 3.0, 1.0


def mems_imu() -> ImuNoise:
    """Return the noise of an IMU that states none: that of a MEMS unit on a vibrating vehicle."""
    return ImuNoise(MEMS_ACCEL, MEMS_GYRO, MEMS_ACCEL_WALK, GYRO_RANDOM_WALK)


def unmeasured_motion() -> TwistChangeNoise:
    """Return the noise of an unmeasured motion, the same for cars and hand-held cameras."""
    return TwistChangeNoise(np.full(3, VELOCITY_CHANGE), np.full(3, TURN_CHANGE))


def pixel_covariance(rows_averaged: int) -> Array:
    """Return the covariance (3, 3) px^2 of (uL, uR, v), v being the mean of one or two image rows."""
    return TRACKED_PIXEL_SIGMA_PX**2 * np.diag([1.0, 1.0, 1.0 / rows_averaged])


def white_sigma(samples: Array) -> Array:
    """Estimate the white-noise standard deviation (d,) of samples (S, d) of a smooth signal.

    The second difference of white noise has six times its variance and that of a smooth motion is small; the
    median absolute deviation ignores the few samples where it is not. Rows that are not finite are left out.
    """
    clean = samples[np.isfinite(samples).all(axis=1)]
    if len(clean) < 3:
        return np.zeros(samples.shape[1])
    second = clean[2:] - 2.0 * clean[1:-1] + clean[:-2]
    sigma: Array = MAD_TO_SIGMA * np.median(np.abs(second), axis=0) / np.sqrt(6.0)
    return sigma


def twist_noise(t_ns: IntArray, v_mps: Array, w_radps: Array) -> TwistNoise:
    """Estimate the noise of measured twists (S, 3), (S, 3) from their scatter, with a floor on each.

    A sample held over dt with standard deviation s has the continuous density s sqrt(dt).
    """
    steps_s = np.diff(t_ns) / NS_PER_S
    positive = steps_s[steps_s > 0.0]
    root_dt = np.sqrt(np.median(positive)) if positive.size else 1.0
    return TwistNoise(
        np.maximum(white_sigma(v_mps), LEAST_VELOCITY_SIGMA_MPS) * root_dt,
        np.maximum(white_sigma(w_radps), LEAST_GYRO_SIGMA_RADPS) * root_dt,
        np.full(3, GYRO_RANDOM_WALK),
    )
