"""The twist model: kinematics, Jacobian and noise of an interval, and that they are those of its GTSAM factor."""

import gtsam
import numpy as np
import pytest

from tests.models.conftest import numerical_jacobian
from toolkit.geometry import Array, se3_adjoint, se3_inverse, se3_log
from toolkit.measurements import TwistMotion, TwistNoise
from toolkit.models import twist
from toolkit.models.factors import B, X
from toolkit.simulation import DRIVE, simulate

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


def test_step_and_factor_are_gtsams_and_the_filters_on_every_interval_of_the_drive():
    """Kang, eq. 1, by GTSAM's exponential map; zero residual at the prediction, the filter's transition and noise."""
    drive = simulate(DRIVE, 0)
    start, compared = drive.truth.T_world_imu[0], 0
    for packet in drive.packets():
        if packet.motion is None:
            continue
        expected = gtsam.Pose3()
        for dt_s, v_mps, w_radps in zip(packet.motion.dt_s, packet.motion.v_mps, packet.motion.w_radps, strict=True):
            expected = expected.compose(gtsam.Pose3.Expmap(dt_s * np.concatenate([w_radps - BIAS, v_mps])))
        step = twist.integrate(packet.motion, BIAS, drive.noise)
        # Two closed forms of the same series on steps of 1 m: the last digits.
        np.testing.assert_allclose(step.T_start_end, expected.matrix(), atol=1e-13)
        factor, end, values = twist.twist_factor(step, BIAS, 5), start @ step.T_start_end, gtsam.Values()
        for key, value in ((X(4), gtsam.Pose3(start)), (X(5), gtsam.Pose3(end)), (B(4), BIAS)):
            values.insert(key, value)
        jacobian = np.linalg.solve(factor.noiseModel().R(), factor.linearize(values).jacobian()[0])
        d_start, d_end, d_bias = np.split(jacobian, [6, 12], axis=1)
        np.testing.assert_allclose(factor.unwhitenedError(values), 0.0, atol=1e-9)
        # Adjoints hold positions up to the drive's extent of 300 m; in them 1e-9 is twelve digits.
        transition = se3_adjoint(se3_inverse(step.T_start_end))
        np.testing.assert_allclose(-np.linalg.solve(d_end, d_start), transition, atol=1e-9)
        np.testing.assert_allclose(-np.linalg.solve(d_end, d_bias), step.d_step_d_bias, atol=1e-9)
        np.testing.assert_allclose(factor.noiseModel().covariance(), step.cov, rtol=1e-9, atol=1e-9 * step.cov.max())
        start, compared = end, compared + 1
    assert compared == drive.frame_count - 1
