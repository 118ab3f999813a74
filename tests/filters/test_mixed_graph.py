"""A graph with Python factors: a solver sees the same, together or one by one, and calls none that is on arrays."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from filters.smoothing.levenberg_marquardt import Stopping, solve
from filters.smoothing.mixed_graph import MixedGraph, TwistFactors
from toolkit.estimate import Estimate
from toolkit.geometry import Array, se3_exp
from toolkit.measurements import TwistMotion, TwistNoise
from toolkit.models.factors import B, L, StereoFactors, X
from toolkit.models.graph_state import GraphIncrement
from toolkit.models.motion import motion_model
from toolkit.models.stereo import triangulate_world
from toolkit.models.twist import TwistIncrement, TwistModel, twist_factor
from toolkit.simulation import DRIVE, simulate

NOISE = TwistNoise(np.array([0.01, 0.02, 0.03]), np.array([0.1, 0.2, 0.3]), np.full(3, 1e-5))
STATES = 7


def drive() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, dict[int, GraphIncrement]]:
    """Return two seconds of a drive from disturbed truth, and the increments."""
    sequence = simulate(replace(DRIVE, duration_s=2.0), 2)
    model, rng = motion_model(sequence.noise, sequence.gravity_world), np.random.default_rng(5)
    graph, start = model.hold(model.initial_belief(sequence.prior), 0), gtsam.Values()
    increments = {}
    for k, packet in enumerate(sequence.packets()):
        at = gtsam.Pose3(sequence.truth.T_world_imu[k]).retract(0.02 * rng.standard_normal(6)).matrix()
        model.insert(start, Estimate(packet.frame.t_ns, at, bias=np.zeros(6)), k)
        if packet.motion is not None:
            increments[k] = model.integrate(packet.motion, np.zeros(6))
            graph.push_back(increments[k].factors(k))
        for factor in StereoFactors(sequence.rig).of(packet.frame, k):
            graph.add(factor)
        points = triangulate_world(packet.frame.uvs_px, at, sequence.rig)
        for track_id, point in zip(packet.frame.track_ids.tolist(), points, strict=True):
            if not start.exists(L(track_id)):
                start.insert(L(track_id), point)
    return graph, start, increments


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
