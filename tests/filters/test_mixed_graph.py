"""A graph with Python factors: a solver sees the same, together or one by one, and calls none that is on arrays."""

import gtsam
import numpy as np
import pytest

from filters.smoothing.levenberg_marquardt import Stopping, solve
from filters.smoothing.mixed_graph import MixedGraph, TwistFactors
from tests.filters.conftest import Problem
from toolkit.geometry import Array, se3_exp
from toolkit.measurements import TwistMotion, TwistNoise
from toolkit.models.factors import B, X
from toolkit.models.graph_state import GraphIncrement
from toolkit.models.twist import TwistIncrement, TwistModel, twist_factor
from toolkit.simulation import DRIVE

NOISE = TwistNoise(np.array([0.01, 0.02, 0.03]), np.array([0.1, 0.2, 0.3]), np.full(3, 1e-5))
STATES = 7


def drive() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, dict[int, GraphIncrement]]:
    problem = Problem(DRIVE)
    return problem.graph, problem.start, problem.increments


def test_errors_and_linearisations_are_the_graphs_own():
    graph, start, increments = drive()
    expected = graph.linearize(start)
    step = start.zeroVectors().scale(0.0)
    for together in ({}, increments):
        mixed = MixedGraph(graph, together)
        assert mixed.error(start) == pytest.approx(graph.error(start), rel=1e-10)
        linear = mixed.linear(start)
        assert linear.error(step) == pytest.approx(expected.error(step), rel=1e-10)
        found, own = linear.gradientAtZero(), expected.gradientAtZero()
        for key in start.keys():  # noqa: SIM118 - not a mapping
            np.testing.assert_allclose(found.at(key), own.at(key), atol=1e-8 * np.abs(own.at(X(0))).max())


def test_a_factor_that_is_on_arrays_is_never_called():
    graph, start, increments = drive()
    called: list[int] = []

    def counted(_this: gtsam.CustomFactor, _values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        called.append(1)
        for i in range(3 if jacobians is not None else 0):
            jacobians[i] = np.zeros((6, (6, 6, 3)[i]))
        return np.zeros(6)

    for k in increments:
        keys = [X(k - 1), X(k), B(k - 1)]
        graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6), keys, counted))
    solve(MixedGraph(graph, increments), start, Stopping(1e-3, 2))
    assert not called
    solve(MixedGraph(graph), start, Stopping(1e-3, 1))
    assert called


@pytest.mark.parametrize("size", [0.0, 1e-6, 1e-2, 0.7])
def test_twists_together_have_the_errors_and_linearisations_of_their_factors(size):
    """At states that are off what the steps predict by about a size (rad, m)."""
    rng, model, steps = np.random.default_rng(3), TwistModel(NOISE), dict[int, TwistIncrement]()
    values, pose = gtsam.Values(), se3_exp(rng.standard_normal(6))
    for k in range(STATES):
        if k:
            motion = TwistMotion(np.array([0.04, 0.07]), 8.0 * rng.standard_normal((2, 3)), rng.standard_normal((2, 3)))
            steps[k] = model.integrate(motion, 0.1 * rng.standard_normal(6))
            pose = pose @ steps[k].step.T_start_end
        values.insert(X(k), gtsam.Pose3(pose @ se3_exp(size * rng.standard_normal(6))))
        values.insert(B(k), 0.1 * rng.standard_normal(3))
    single = [twist_factor(increment.step, increment.gyro_bias, k) for k, increment in steps.items()]
    together = TwistFactors.of(steps)
    assert together.keys == [tuple(factor.keys()) for factor in single]
    errors = 0.5 * np.square(together.residuals(values)).sum(axis=1)
    # Twelve digits of squares that the smallest sigma makes a million times the residuals'.
    np.testing.assert_allclose(errors, [factor.error(values) for factor in single], rtol=1e-9, atol=1e-16)
    for found, factor in zip(together.linear(values), single, strict=True):
        expected = factor.linearize(values).augmentedInformation()
        np.testing.assert_allclose(found.augmentedInformation(), expected, atol=1e-9 * np.abs(expected).max())
