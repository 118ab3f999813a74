"""The twist model: kinematics, Jacobian and noise of an interval, and that they are those of its GTSAM factor."""

import gtsam
import numpy as np
import pytest

from tests.models.conftest import numerical_jacobian
from toolkit.geometry import Array, se3_adjoint, se3_exp, se3_inverse, se3_log
from toolkit.measurements import TwistChangeNoise, TwistMotion, TwistNoise, UnmeasuredMotion
from toolkit.models import twist
from toolkit.models.factors import B, X
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief
from toolkit.models.twist import SmoothTwist, smooth_factor
from toolkit.simulation import DRIVE, simulate

NOISE = TwistNoise(np.array([0.05, 0.03, 0.02]), np.array([0.004, 0.002, 0.006]), np.full(3, 1e-4))
BIAS = np.array([0.01, -0.02, 0.015])


@pytest.fixture
def motion() -> TwistMotion:
    """Four uneven pieces with fast turns, so that every Lie-group term counts."""
    rng = np.random.default_rng(3)
    return TwistMotion(rng.uniform(0.05, 0.15, 4), 8.0 * rng.standard_normal((4, 3)), 2.0 * rng.standard_normal((4, 3)))


@pytest.fixture(scope="module")
def drive():
    return simulate(DRIVE, 0)


def test_pose_follows_the_exponential_of_each_twist(drive):
    """Kang, eq. 1, with GTSAM's exponential map."""
    compared = 0
    for packet in drive.packets():
        if packet.motion is None:
            continue
        expected = gtsam.Pose3()
        for dt_s, v_mps, w_radps in zip(packet.motion.dt_s, packet.motion.v_mps, packet.motion.w_radps, strict=True):
            expected = expected.compose(gtsam.Pose3.Expmap(dt_s * np.concatenate([w_radps - BIAS, v_mps])))
        step = twist.integrate(packet.motion, BIAS, drive.noise)
        # Two closed forms of the same series on steps of 1 m: the last digits.
        np.testing.assert_allclose(step.T_start_end, expected.matrix(), atol=1e-13)
        compared += 1
    assert compared == drive.frame_count - 1


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


def values_of(start: Array, end: Array, bias: Array) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(X(4), gtsam.Pose3(start))
    values.insert(X(5), gtsam.Pose3(end))
    values.insert(B(4), bias)
    return values


def unwhitened(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> Array:
    """Return the Jacobian (6, 15) in start, end and bias."""
    whitened, _ = factor.linearize(values).jacobian()
    jacobian: Array = np.linalg.solve(factor.noiseModel().R(), whitened)
    return jacobian


def test_factor_equals_the_filters_prediction_on_every_interval_of_the_drive(drive):
    """Zero residual at the prediction, and there the filter's transition and noise (see test_imu)."""
    start, compared = drive.truth.T_world_imu[0], 0
    for packet in drive.packets():
        if packet.motion is None:
            continue
        step = twist.integrate(packet.motion, BIAS, drive.noise)
        factor, end = twist.twist_factor(step, BIAS, 5), start @ step.T_start_end
        values = values_of(start, end, BIAS)
        d_start, d_end, d_bias = np.split(unwhitened(factor, values), [6, 12], axis=1)
        np.testing.assert_allclose(factor.unwhitenedError(values), 0.0, atol=1e-9)
        # Adjoints hold positions up to the drive's extent of 300 m; in them 1e-9 is twelve digits.
        transition = se3_adjoint(se3_inverse(step.T_start_end))
        np.testing.assert_allclose(-np.linalg.solve(d_end, d_start), transition, atol=1e-9)
        np.testing.assert_allclose(-np.linalg.solve(d_end, d_bias), step.d_step_d_bias, atol=1e-9)
        np.testing.assert_allclose(factor.noiseModel().covariance(), step.cov, rtol=1e-9, atol=1e-9 * step.cov.max())
        start, compared = end, compared + 1
    assert compared == drive.frame_count - 1


@pytest.mark.parametrize("size", [0.0, 1e-4, 0.05, 0.5])
def test_factor_jacobians_are_derivatives_away_from_the_prediction(motion, size):
    rng = np.random.default_rng(11)
    step = twist.integrate(motion, BIAS, NOISE)
    start = se3_exp(rng.standard_normal(6))
    end = start @ step.T_start_end @ se3_exp(size * rng.standard_normal(6))
    bias = BIAS + 0.1 * size * rng.standard_normal(3)
    factor = twist.twist_factor(step, BIAS, 5)

    def residual(delta: Array) -> Array:
        moved = values_of(start @ se3_exp(delta[:6]), end @ se3_exp(delta[6:12]), bias + delta[12:])
        return np.asarray(factor.unwhitenedError(moved))

    found = unwhitened(factor, values_of(start, end, bias))
    numerical = numerical_jacobian(residual, 15)
    np.testing.assert_allclose(found[:, :12], numerical[:, :12], atol=1e-8)
    # The factor leaves out the derivative of exp at the step's change c: J_r(c) = 1 - ad(c) / 2 + ...
    change = step.d_step_d_bias @ (bias - BIAS)
    left_out = np.linalg.norm(change) * np.abs(step.d_step_d_bias).max()
    np.testing.assert_allclose(found[:, 12:], numerical[:, 12:], atol=1e-8 + left_out)


def test_noise_over_a_bridge_is_scaled_and_the_step_is_not(motion: TwistMotion) -> None:
    """Factors of linear and angular noise (3, 2): the covariance is that of a noise stated so much larger."""
    scale = np.tile([3.0, 2.0], (len(motion.dt_s), 1))
    bridged = twist.integrate(TwistMotion(motion.dt_s, motion.v_mps, motion.w_radps, scale), BIAS, NOISE)
    larger = TwistNoise(3.0 * NOISE.velocity_noise_density, 2.0 * NOISE.gyro_noise_density, NOISE.gyro_random_walk)
    expected = twist.integrate(motion, BIAS, larger)
    np.testing.assert_allclose(bridged.cov, expected.cov, rtol=1e-12)
    np.testing.assert_array_equal(bridged.T_start_end, expected.T_start_end)


CHANGE_NOISE = TwistChangeNoise(np.array([1.0, 2.0, 3.0]), np.array([0.3, 0.5, 0.7]))
DT_S = 0.1


def belief(seed: int = 0) -> Belief:
    """Return a state that turns and moves on all axes, with a covariance."""
    rng = np.random.default_rng(seed)
    T_world_imu = se3_exp(rng.normal(0.0, 0.8, 6))
    root = rng.normal(0.0, 0.1, (12, 12))
    bias = np.concatenate([np.zeros(3), rng.normal(0.0, 1.0, 3)])
    return Belief(SmoothTwist.layout, T_world_imu, rng.normal(0.0, 3.0, 3), bias, root @ root.T + 0.01 * np.eye(12))


def predicted(start: Belief) -> Belief:
    increment = motion_model(CHANGE_NOISE, np.zeros(3)).integrate(UnmeasuredMotion(np.array([DT_S])), start.bias)
    return start.predicted(increment.predict(start))


def test_a_body_keeps_its_twist() -> None:
    start = belief()
    end = predicted(predicted(start))
    v_body = start.T_world_imu[:3, :3].T @ start.v_world
    whole = se3_exp(2.0 * DT_S * np.concatenate([-start.bias[3:], v_body]))
    np.testing.assert_allclose(end.T_world_imu, start.T_world_imu @ whole, atol=1e-12)
    np.testing.assert_allclose(end.T_world_imu[:3, :3].T @ end.v_world, v_body, atol=1e-12)
    np.testing.assert_array_equal(end.bias, start.bias)


def test_the_factor_has_the_derivatives_of_its_residual() -> None:
    start = belief(1)
    end = predicted(start).moved(np.random.default_rng(5).normal(0.0, 0.05, 12), start.cov)
    values, factor, model = gtsam.Values(), smooth_factor(DT_S, CHANGE_NOISE, 1), SmoothTwist(CHANGE_NOISE)
    for k, one in enumerate((start, end)):
        model.insert(values, one.estimate(0), k)

    def residual(step: Array) -> Array:
        delta = gtsam.VectorValues()
        for key, part in zip(factor.keys(), np.split(step, [6, 9, 12, 18, 21]), strict=True):
            delta.insert(key, part)
        return factor.linearize(values.retract(delta)).jacobian()[1]

    derivatives, _ = factor.linearize(values).jacobian()
    # The residual is whitened: divided by sigmas down to 0.005.
    np.testing.assert_allclose(derivatives, -numerical_jacobian(residual, 24), atol=1e-6)
