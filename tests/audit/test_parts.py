"""The camera's own motion, and the statistics the verdicts rest on."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit.intervals import interval_means
from toolkit.audit.one_step import errors_are_independent
from toolkit.audit.robust import LEVEL, Scalar, chance_bound, slope
from toolkit.geometry import se3_inverse, se3_log
from toolkit.jackknife import jackknife_cov
from toolkit.measurements import NS_PER_S
from toolkit.models.camera_motion import camera_motion
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, FLIGHT, Scenario, noise_free, simulate


def true_camera_twist(sequence: Sequence) -> np.ndarray:
    assert sequence.truth is not None
    T_world_cam = sequence.truth.T_world_imu @ sequence.rig.T_imu_cam
    dt_s = np.diff(sequence.frames_t_ns)[:, None] / NS_PER_S
    return se3_log(se3_inverse(T_world_cam[:-1]) @ T_world_cam[1:]) / dt_s


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=lambda s: s.name)
def test_camera_motion_is_exact_on_exact_tracks(scenario: Scenario) -> None:
    sequence = simulate(replace(noise_free(scenario), duration_s=10.0), seed=0)
    camera, truth = camera_motion(sequence), true_camera_twist(sequence)
    assert camera.known.all()
    # Six iterations from rest: 1e-5 rad/s and 1e-4 m/s of what they started from.
    np.testing.assert_allclose(camera.w_radps, truth[:, :3], atol=1e-4)
    np.testing.assert_allclose(camera.v_mps, truth[:, 3:], atol=1e-3)


def test_camera_motion_is_unknown_without_tracks() -> None:
    sequence = simulate(replace(DRIVE, duration_s=3.0), seed=0)
    few = sequence.observations.select(sequence.observations.frame < 10)
    camera = camera_motion(replace(sequence, observations=few))
    assert camera.known[:9].all()
    assert not camera.known[9:].any()
    assert np.isfinite(camera.v_mps).all()


def test_slope_through_an_instrument_ignores_the_noise_of_the_regressor() -> None:
    rng = np.random.default_rng(5)
    signal = rng.standard_normal((4000, 3))
    regressor = signal + rng.standard_normal(signal.shape)
    response = 0.7 * signal + 0.1 * rng.standard_normal(signal.shape)
    through = slope(signal, regressor, response)
    direct = slope(regressor, regressor, response)
    assert abs(through.value - 0.7) < 5.0 * through.error
    assert direct.value < 0.5  # half of it lost to the noise: why the instrument is there


def test_interval_means_integrate_straight_lines_exactly() -> None:
    t_ns = np.array([0, 3, 4, 9, 12]) * NS_PER_S
    values = np.stack([2.0 * t_ns / NS_PER_S, np.ones(5)], axis=1)
    frames_t_ns = np.array([1, 2, 8, 11]) * NS_PER_S
    np.testing.assert_allclose(interval_means(t_ns, values, frames_t_ns), [[3, 1], [10, 1], [19, 1]], rtol=1e-12)


@pytest.mark.parametrize("stretches", [3, 5, 10])
def test_what_is_beyond_the_bound_of_chance_is_so_as_rarely_as_it_says(stretches: int) -> None:
    """Means of 30 intervals whose errors last as long as a stretch, and scatter as much as real odometry's or less."""
    rng, beyond = np.random.default_rng(stretches), 0
    for _ in range(2000):
        shared = np.repeat(rng.normal(0.0, 0.7, (stretches, 1)), 30 // stretches, axis=0)
        rows = shared + rng.standard_normal((len(shared), 1))
        error = np.sqrt(jackknife_cov(lambda some: some.mean(axis=0), rows, stretches=stretches)[:1, 0])
        formal = np.full(1, rows.std() / np.sqrt(len(rows)))
        beyond += bool(abs(rows.mean()) > chance_bound(error, formal, float(stretches))[0])
    assert beyond <= 2000 * LEVEL + 3.0 * np.sqrt(2000 * LEVEL)  # three standard deviations of a count of two


def test_errors_are_independent_only_where_five_standard_errors_leave_no_other_correlation() -> None:
    """The correlation is -1/2 for independent errors, and above -1/4 where a random walk has twice their variance."""
    assert errors_are_independent(Scalar(-0.45, 0.039))
    assert not errors_are_independent(Scalar(-0.45, 0.041))
    assert not errors_are_independent(Scalar(-0.2, 0.001))
    assert not errors_are_independent(None)
