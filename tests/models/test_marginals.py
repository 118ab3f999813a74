"""Marginal covariances read off an eliminated graph are those GTSAM computes from scratch."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest

from toolkit.models.factors import B, V, X, joint_cov
from toolkit.models.motion import motion_model
from toolkit.simulation import FLIGHT


@pytest.fixture(scope="module")
def tree() -> gtsam.ISAM2:
    """Return a chain of three states, their velocities and biases, coupled at random."""
    rng = np.random.default_rng(0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(3):
        values.insert(X(k), gtsam.Pose3.Expmap(0.1 * rng.standard_normal(6)))
        values.insert(V(k), rng.standard_normal(3))
        values.insert(B(k), gtsam.imuBias.ConstantBias())
    sizes, unit = {X: 6, V: 3, B: 6}, gtsam.noiseModel.Unit.Create(15)
    chain = [(kind(k), size) for k in range(3) for kind, size in sizes.items()]
    for kind, size in sizes.items():
        prior = gtsam.JacobianFactor(kind(0), np.eye(size), np.zeros(size), gtsam.noiseModel.Unit.Create(size))
        graph.add(gtsam.LinearContainerFactor(prior, values))
    for (key, size), (next_key, next_size) in pairwise(chain):
        blocks = rng.standard_normal((15, size)), rng.standard_normal((15, next_size))
        coupled = gtsam.JacobianFactor(key, blocks[0], next_key, blocks[1], np.zeros(15), unit)
        graph.add(gtsam.LinearContainerFactor(coupled, values))
    isam = gtsam.ISAM2()
    isam.update(graph, values)
    return isam


def from_scratch(tree: gtsam.ISAM2, keys: list[int]) -> np.ndarray:
    """Invert the whole information matrix: nothing of the tree is used but its factors."""
    ordering = gtsam.Ordering()
    for key in [*keys, *(kind(k) for k in range(3) for kind in (X, V, B) if kind(k) not in keys)]:
        ordering.push_back(key)
    linear = tree.getFactorsUnsafe().linearize(tree.calculateBestEstimate())
    information = linear.hessian(ordering)[0]
    size = sum({"x": 6, "v": 3, "b": 6}[chr(gtsam.Symbol(k).chr())] for k in keys)
    return np.linalg.inv(information)[:size, :size]


@pytest.mark.parametrize("keys", [[X(2), V(2), B(2)], [B(0), X(1)], [V(1)], [X(2), X(0)]])
def test_joint_covariance_is_that_of_the_whole_information_matrix(tree, keys):
    expected = from_scratch(tree, keys)
    # Rounding of an inverse, relative to the largest entry.
    np.testing.assert_allclose(joint_cov(tree, keys), expected, atol=1e-9 * np.abs(expected).max())


def test_covariance_of_a_state_has_its_velocity_in_the_body_frame(tree):
    model = motion_model(FLIGHT.motion.noise, FLIGHT.gravity_world)
    keys = model.keys(1)
    R_world_imu = tree.calculateEstimatePose3(X(1)).rotation().matrix()
    in_world, in_body = joint_cov(tree, keys), model.state_cov(tree, 1, R_world_imu)
    np.testing.assert_allclose(R_world_imu @ in_body[6:9, 6:9] @ R_world_imu.T, in_world[6:9, 6:9], rtol=1e-12)
    np.testing.assert_allclose(in_body[:6, 6:9] @ R_world_imu.T, in_world[:6, 6:9], atol=1e-14)
    np.testing.assert_array_equal(in_body, in_body.T)
