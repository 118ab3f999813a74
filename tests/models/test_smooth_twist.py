"""Motion that nobody measured: the filter's transition, the smoother's factor, and that they are one model."""

import gtsam
import numpy as np
import pytest

from toolkit.geometry import Array, se3_exp, se3_inverse, se3_log
from toolkit.measurements import TwistChangeNoise, UnmeasuredMotion
from toolkit.models.factors import B, V, X
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief
from toolkit.models.twist import SmoothTwist, smooth_factor

NOISE = TwistChangeNoise(np.array([1.0, 2.0, 3.0]), np.array([0.3, 0.5, 0.7]))
DT_S = 0.1
STEP = 1e-6


def belief(seed: int = 0) -> Belief:
    """Return a state that turns and moves on all axes, with a covariance."""
    rng = np.random.default_rng(seed)
    T_world_imu = se3_exp(rng.normal(0.0, 0.8, 6))
    root = rng.normal(0.0, 0.1, (12, 12))
    bias = np.concatenate([np.zeros(3), rng.normal(0.0, 1.0, 3)])
    return Belief(SmoothTwist.layout, T_world_imu, rng.normal(0.0, 3.0, 3), bias, root @ root.T + 0.01 * np.eye(12))


def predicted(start: Belief) -> Belief:
    increment = motion_model(NOISE, np.zeros(3)).integrate(UnmeasuredMotion(np.array([DT_S])), start.bias)
    return start.predicted(increment.predict(start))


def difference(end: Belief, other: Belief) -> Array:
    """Return the error (12,) that leads from one state to another."""
    pose = se3_log(se3_inverse(end.T_world_imu) @ other.T_world_imu)
    velocity = end.T_world_imu[:3, :3].T @ (other.v_world - end.v_world)
    return np.concatenate([pose, velocity, other.bias[3:] - end.bias[3:]])


def test_a_body_keeps_its_twist() -> None:
    start = belief()
    end = predicted(predicted(start))
    v_body = start.T_world_imu[:3, :3].T @ start.v_world
    whole = se3_exp(2.0 * DT_S * np.concatenate([-start.bias[3:], v_body]))
    np.testing.assert_allclose(end.T_world_imu, start.T_world_imu @ whole, atol=1e-12)
    np.testing.assert_allclose(end.T_world_imu[:3, :3].T @ end.v_world, v_body, atol=1e-12)
    np.testing.assert_array_equal(end.bias, start.bias)


@pytest.mark.parametrize("seed", range(3))
def test_the_transition_is_the_derivative_of_the_prediction(seed: int) -> None:
    start = belief(seed)
    end = predicted(start)
    increment = motion_model(NOISE, np.zeros(3)).integrate(UnmeasuredMotion(np.array([DT_S])), start.bias)
    numeric = np.stack(
        [
            (
                difference(end, predicted(start.moved(d, start.cov)))
                - difference(end, predicted(start.moved(-d, start.cov)))
            )
            / (2.0 * STEP)
            for d in STEP * np.eye(12)
        ],
        axis=1,
    )
    prediction = increment.predict(start)
    # central differences over 1e-6 are good to 1e-9 of values of a few units
    np.testing.assert_allclose(prediction.transition, numeric, atol=1e-7)
    np.testing.assert_allclose(increment.transition_between(start, prediction), prediction.transition, atol=1e-12)


def values_of(*beliefs: Belief) -> gtsam.Values:
    values, model = gtsam.Values(), SmoothTwist(NOISE)
    for k, one in enumerate(beliefs):
        model.insert(values, one.estimate(0), k)
    return values


def test_the_factor_has_the_derivatives_of_its_residual() -> None:
    start = belief(1)
    end = predicted(start).moved(np.random.default_rng(5).normal(0.0, 0.05, 12), start.cov)
    values, factor = values_of(start, end), smooth_factor(DT_S, NOISE, 1)
    keys = list(factor.keys())
    linear = factor.linearize(values)
    derivatives, b = linear.jacobian()
    at = 0
    for key in keys:
        size = 6 if key in (X(0), X(1)) else 3
        for i in range(size):
            off = []
            for sign in (1.0, -1.0):
                delta = gtsam.VectorValues()
                for other in keys:
                    delta.insert(other, np.zeros(6 if other in (X(0), X(1)) else 3))
                step = np.zeros(size)
                step[i] = sign * STEP
                delta.update(single(key, step))
                off.append(factor.linearize(values.retract(delta)).jacobian()[1])
            numeric = -(off[0] - off[1]) / (2.0 * STEP)
            # the residual is whitened: divided by sigmas down to 0.005
            np.testing.assert_allclose(derivatives[:, at + i], numeric, atol=2e-4, rtol=1e-6)
        at += size
    assert np.isfinite(b).all()


def single(key: int, step: Array) -> gtsam.VectorValues:
    delta = gtsam.VectorValues()
    delta.insert(key, step)
    return delta


def test_the_smoothers_factor_is_the_filters_model() -> None:
    start = belief(2)
    end = predicted(start)
    model, values = SmoothTwist(NOISE), values_of(start, end)
    graph = model.hold(start, 0)
    graph.push_back(model.integrate(UnmeasuredMotion(np.array([DT_S])), start.bias).factors(1))
    assert graph.error(values) == pytest.approx(0.0, abs=1e-18)
    marginal = gtsam.Marginals(graph, values).jointMarginalCovariance([X(1), V(1), B(1)])
    keys = (X(1), V(1), B(1))
    cov = np.block([[marginal.at(i, j) for j in keys] for i in keys])
    # variances of 1e-4 to 1e2, one linearisation point
    np.testing.assert_allclose(model.estimate_cov(cov, end.T_world_imu[:3, :3]), end.cov, atol=1e-9, rtol=1e-7)
