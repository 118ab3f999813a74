"""What a filter believes about the IMU: a mean on the manifold and a covariance in its tangent space.

Errors follow GTSAM: the pose [rotation, position] and the velocity are perturbed in the body frame.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from toolkit.estimate import Estimate
from toolkit.geometry import Array, se3_exp
from toolkit.sequence import Prior

ROTATION, POSITION, POSE = slice(0, 3), slice(3, 6), slice(0, 6)


@dataclass(frozen=True)
class Layout:
    """Where the blocks of an error state stand; a block that the state lacks is None."""

    size: int
    velocity: slice | None
    accel_bias: slice | None
    gyro_bias: slice


TWIST_LAYOUT = Layout(9, None, None, slice(6, 9))
IMU_LAYOUT = Layout(15, slice(6, 9), slice(9, 12), slice(12, 15))


@dataclass(frozen=True, eq=False)
class Belief:
    """Pose (4, 4), velocity (3,) m/s and bias (6,) [accel, gyro] with the covariance (d, d) of the layout's error."""

    layout: Layout
    T_world_imu: Array
    v_world: Array
    bias: Array
    cov: Array

    def moved(self, delta: Array, cov: Array) -> "Belief":
        """Return the belief moved by an error (d,), with a new covariance made exactly symmetric."""
        v_world, bias = self.v_world, self.bias.copy()
        if self.layout.velocity is not None:
            v_world = v_world + self.T_world_imu[:3, :3] @ delta[self.layout.velocity]
        if self.layout.accel_bias is not None:
            bias[:3] += delta[self.layout.accel_bias]
        bias[3:] += delta[self.layout.gyro_bias]
        T_world_imu = self.T_world_imu @ se3_exp(delta[POSE])
        return replace(self, T_world_imu=T_world_imu, v_world=v_world, bias=bias, cov=0.5 * (cov + cov.T))

    def at(self, estimate: Estimate) -> "Belief":
        """Return the belief that an estimate says; what the estimate lacks stays."""
        v_world = self.v_world if estimate.v_world is None else estimate.v_world
        bias = self.bias if estimate.bias is None else estimate.bias
        cov = self.cov if estimate.cov is None else estimate.cov
        return replace(self, T_world_imu=estimate.T_world_imu, v_world=v_world, bias=bias, cov=cov)

    def estimate(self, t_ns: int, **info: float) -> Estimate:
        """Say the belief as an Estimate; a velocity is given only where it is part of the state."""
        v_world = None if self.layout.velocity is None else self.v_world
        return Estimate(t_ns, self.T_world_imu, self.cov, v_world, self.bias, info)


def initial_belief(prior: Prior, motion_kind: Literal["twist", "imu"]) -> Belief:
    """Return the belief at the first frame: the prior, cut to the blocks the motion model has."""
    if motion_kind == "imu":
        return Belief(IMU_LAYOUT, prior.T_world_imu, prior.v_world, prior.bias, prior.cov)
    kept = np.r_[0:6, 12:15]
    return Belief(TWIST_LAYOUT, prior.T_world_imu, prior.v_world, prior.bias, prior.cov[np.ix_(kept, kept)])
