import numpy as np

from toolkit.models.stereo import CHANNELS
from toolkit.simulation.track_noise import TrackNoise


def test_covariance_is_that_of_drawn_walks_offsets_and_white_noise() -> None:
    noise = TrackNoise(np.array([0.1, 0.2, 0.3]), np.array([0.2, 0.1, 0.15]), np.array([0.0, 0.7, 0.1]))
    ages = np.array([0, 1, 2, 5])
    rng, draws = np.random.default_rng(0), 40_000
    steps = rng.standard_normal((draws, 3, 6)) * noise.walk_px[:, None]
    steps[..., 0] = 0.0
    errors = np.cumsum(steps, axis=2)[..., ages]
    errors += rng.standard_normal((draws, 3, 1)) * noise.offset_px[:, None]
    errors += rng.standard_normal((draws, 3, 4)) * noise.white_px[:, None]
    sample = np.einsum("dci,dcj->cij", errors, errors) / draws
    cov = noise.cov(ages)
    # The standard error of a sample covariance is at most sqrt(2 / draws) of the largest variance.
    assert np.abs(sample - cov).max() < 5.0 * np.sqrt(2.0 / draws) * cov.max()


def test_channels_are_mean_column_disparity_and_row() -> None:
    assert np.array_equal(CHANNELS @ np.array([12.0, 10.0, 7.0]), [11.0, 2.0, 7.0])
