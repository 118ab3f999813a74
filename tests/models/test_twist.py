"""The twist model: kinematics and noise of an interval; that they are those of its factor is proved in test_motion."""

import gtsam
import numpy as np
import pytest

from tests.models.conftest import numerical_jacobian
from toolkit.geometry import Array, se3_inverse, se3_log
from toolkit.measurements import TwistMotion, TwistNoise
from toolkit.models import twist

NOISE = TwistNoise(np.array([0.05, 0.03, 0.02]), np.array([0.004, 0.002, 0.006]), np.full(3, 1e-4))
BIAS = np.array([0.01, -0.02, 0.015])


@pytest.fixture
def motion() -> TwistMotion:
    """Four uneven pieces with fast turns, so that every Lie-group term counts."""
    rng = np.random.default_rng(3)
    return TwistMotion(rng.uniform(0.05, 0.15, 4), 8.0 * rng.standard_normal((4, 3)), 2.0 * rng.standard_normal((4, 3)))


def test_covariance_carries_each_samples_noise_to_the_end(motion):
    """J Q J^T with the whole Jacobian of the end in all samples, found numerically."""
    step = twist.integrate(motion, BIAS, NOISE)

    def moved(delta: Array) -> Array:
        w, v = np.split(delta.reshape(-1, 6), 2, axis=1)
        noisy = TwistMotion(motion.dt_s, motion.v_mps + v, motion.w_radps + w)
        return se3_log(se3_inverse(step.T_start_end) @ twist.integrate(noisy, BIAS, NOISE).T_start_end)

    jacobian = numerical_jacobian(moved, 24)
    density_squared = np.concatenate([NOISE.gyro_noise_density, NOISE.velocity_noise_density]) ** 2
    of_samples = np.concatenate([density_squared / dt_s for dt_s in motion.dt_s])
    expected = (jacobian * of_samples) @ jacobian.T
    np.testing.assert_allclose(step.cov, expected, atol=1e-9 * np.abs(expected).max())


def test_a_step_is_that_of_gtsams_exponential_map(motion):
    """Kang, eq. 1."""
    expected = gtsam.Pose3()
    for dt_s, v_mps, w_radps in zip(motion.dt_s, motion.v_mps, motion.w_radps, strict=True):
        expected = expected.compose(gtsam.Pose3.Expmap(dt_s * np.concatenate([w_radps - BIAS, v_mps])))
    np.testing.assert_allclose(twist.integrate(motion, BIAS, NOISE).T_start_end, expected.matrix(), atol=1e-13)
