"""A graph with Python factors: a solver sees the same, in stacks or one by one, and calls none that is stacked."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from filters.smoothing.levenberg_marquardt import Stopping, solve
from filters.smoothing.mixed_graph import MixedGraph
from toolkit.estimate import Estimate
from toolkit.geometry import Array
from toolkit.models.factors import L, StereoFactors, X
from toolkit.models.motion import motion_model
from toolkit.models.stacked_factors import StackedFactors, stacked
from toolkit.models.stereo import triangulate_world
from toolkit.simulation import DRIVE, simulate


def drive() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, list[StackedFactors]]:
    """Return two seconds of a drive from disturbed truth, and the stacks."""
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
    return graph, start, stacked(increments)


def test_errors_and_linearisations_are_the_graphs_own():
    graph, start, stacks = drive()
    expected = graph.linearize(start)
    step = start.zeroVectors().scale(0.0)
    for stacked_or_not in ((), stacks):
        mixed = MixedGraph(graph, stacked_or_not)
        assert mixed.has_python
        assert mixed.error(start) == pytest.approx(graph.error(start), rel=1e-10)
        linear = mixed.linear(start)
        assert linear.error(step) == pytest.approx(expected.error(step), rel=1e-10)
        found, own = linear.gradientAtZero(), expected.gradientAtZero()
        for key in start.keys():  # noqa: SIM118 - not a mapping
            np.testing.assert_allclose(found.at(key), own.at(key), atol=1e-8 * np.abs(own.at(X(0))).max())


def test_a_solve_comes_to_the_same_place_with_stacks_and_without():
    graph, start, stacks = drive()
    single, together = (solve(it, start, Stopping(1e-10, 50)) for it in (graph, MixedGraph(graph, stacks)))
    assert together.iterations == single.iterations
    assert together.error == pytest.approx(single.error, rel=1e-10)


def test_a_factor_that_is_stacked_is_never_called():
    graph, start, stacks = drive()
    called: list[int] = []

    def counted(_this: gtsam.CustomFactor, _values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        called.append(1)
        for i in range(3 if jacobians is not None else 0):
            jacobians[i] = np.zeros((6, (6, 6, 3)[i]))
        return np.zeros(6)

    for keys in stacks[0].keys:
        graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6), list(keys), counted))
    solve(MixedGraph(graph, stacks), start, Stopping(1e-3, 2))
    assert not called
    solve(MixedGraph(graph, ()), start, Stopping(1e-3, 1))
    assert called


def test_without_python_factors_there_is_none():
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6)))
    assert not MixedGraph(graph).has_python
