"""Joint marginal covariances of a few variables, read off an eliminated graph (Kaess & Dellaert 2009).

Only the path from the variables to the root of the Bayes tree is touched: for states that were eliminated last
that is next to nothing, however long the graph.
"""

import numpy as np

from toolkit.geometry import Array
from toolkit.models.factors import EliminatedGraph, joint_cov, kind_of
from toolkit.models.imu import IMU_LAYOUT


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
