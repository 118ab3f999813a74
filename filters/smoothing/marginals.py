"""Joint marginal covariances of a few variables, read off an eliminated graph (Kaess & Dellaert 2009).

Only the path from the variables to the root of the Bayes tree is touched: for states that were eliminated last
that is next to nothing, however long the graph.
"""

from typing import Protocol

import gtsam
import numpy as np

from filters.kalman.belief import IMU_LAYOUT
from toolkit.geometry import Array
from toolkit.models.factors import kind_of


class EliminatedGraph(Protocol):
    """What knows its marginals: gtsam's ISAM2, GaussianBayesTree or Marginals."""

    def jointMarginalCovariance(self, keys: list[int]) -> gtsam.JointMarginal:  # noqa: N802 - GTSAM's name
        """Return the joint marginal of some variables."""


def joint_cov(tree: EliminatedGraph, keys: list[int]) -> Array:
    """Return the joint covariance (d, d) of variables, in the order of the keys and in GTSAM's tangent spaces.

    Raises RuntimeError, as GTSAM does, where the graph does not determine them.
    """
    marginal = tree.jointMarginalCovariance(keys)
    cov = np.block([[marginal.at(i, j) for j in keys] for i in keys])
    return np.asarray(0.5 * (cov + cov.T))


def state_cov(tree: EliminatedGraph, keys: list[int], R_world_imu: Array) -> Array:
    """Return the covariance of the keys of one state [pose, (velocity,) bias] in the order and side of an Estimate."""
    if len(keys) == len("XVB") and kind_of(keys[1]) != "v":
        raise ValueError("a state of three keys is pose, velocity, bias, in this order")
    return in_estimate_order(joint_cov(tree, keys), R_world_imu)


def in_estimate_order(cov: Array, R_world_imu: Array) -> Array:
    """Return the covariance (d, d) of a state's variables in GTSAM's tangent spaces as that of an Estimate.

    A velocity is a vector in the world to GTSAM and an error in the body frame to an Estimate; ``R_world_imu``
    (3, 3) is the state's own attitude.
    """
    if len(cov) == IMU_LAYOUT.size:
        to_body = np.eye(len(cov))
        to_body[IMU_LAYOUT.velocity, IMU_LAYOUT.velocity] = R_world_imu.T
        cov = to_body @ cov @ to_body.T
    return np.asarray(0.5 * (cov + cov.T))
