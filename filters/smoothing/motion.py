"""The motion of a sequence as a factor graph: what holds a state, one step a frame, values and how to read them.

Two kinds: a measured twist with a gyro bias (3,) at every frame, or raw IMU samples with velocity and both
biases. A smoother uses either without knowing which.
"""

from collections.abc import Iterator
from itertools import chain
from typing import Any, Protocol

import gtsam
import numpy as np

from filters.kalman.belief import Belief
from toolkit.estimate import Estimate
from toolkit.estimator import Setup
from toolkit.geometry import Array
from toolkit.models import factors, imu, twist
from toolkit.models.factors import B, V, X
from toolkit.sequence import ImuMotion, ImuNoise, Motion, TwistMotion, TwistNoise


class MotionGraph(Protocol):
    """Makes the factors and values of one kind of motion."""

    def hold(self, belief: Belief, k: int) -> Iterator[gtsam.NonlinearFactor]:
        """Yield what holds state k at a belief."""

    def step(self, motion: Motion, bias: Array, k: int) -> Iterator[gtsam.NonlinearFactor]:
        """Yield what ties state k - 1 to state k, integrated about a bias (6,)."""

    def keys(self, k: int) -> list[int]:
        """Return the keys of state k in the order of an Estimate's covariance: pose, (velocity,) bias."""

    def insert(self, values: gtsam.Values, estimate: Estimate, k: int) -> None:
        """Add state k at an estimate."""

    def read(self, values: gtsam.Values, k: int, t_ns: int) -> Estimate:
        """Return state k."""


def motion_graph(setup: Setup) -> MotionGraph:
    """Return the maker for the kind of motion and the noise of a setup."""
    if isinstance(setup.noise, TwistNoise):
        return _TwistGraph(setup.noise)
    return _ImuGraph(setup.noise, setup.gravity_world)


class _TwistGraph:
    def __init__(self, noise: TwistNoise) -> None:
        self._noise = noise

    def hold(self, belief: Belief, k: int) -> Iterator[gtsam.NonlinearFactor]:
        at = gtsam.Values()
        at.insert(X(k), gtsam.Pose3(belief.T_world_imu))
        at.insert(B(k), belief.bias[3:])
        root = _root_information(belief.cov)
        yield _linear(at, {X(k): root[:, :6], B(k): root[:, 6:]})

    def step(self, motion: Motion, bias: Array, k: int) -> Iterator[gtsam.NonlinearFactor]:
        assert isinstance(motion, TwistMotion)
        step = twist.integrate(motion, bias[3:], self._noise)
        yield factors.twist_factor(step, bias[3:], k)
        yield factors.gyro_bias_walk_factor(self._noise, step.dt_s, k)

    def keys(self, k: int) -> list[int]:
        return [X(k), B(k)]

    def insert(self, values: gtsam.Values, estimate: Estimate, k: int) -> None:
        assert estimate.bias is not None
        values.insert(X(k), gtsam.Pose3(estimate.T_world_imu))
        values.insert(B(k), estimate.bias[3:])

    def read(self, values: gtsam.Values, k: int, t_ns: int) -> Estimate:
        bias = np.concatenate([np.zeros(3), values.atVector(B(k))])
        return Estimate(t_ns, values.atPose3(X(k)).matrix(), bias=bias)


class _ImuGraph:
    def __init__(self, noise: ImuNoise, gravity_world: Array) -> None:
        self._params = imu.preintegration_params(noise, gravity_world)

    def hold(self, belief: Belief, k: int) -> Iterator[gtsam.NonlinearFactor]:
        at = gtsam.Values()
        at.insert(X(k), gtsam.Pose3(belief.T_world_imu))
        at.insert(V(k), belief.v_world)
        at.insert(B(k), _constant_bias(belief.bias))
        to_world = np.eye(15)
        to_world[6:9, 6:9] = belief.T_world_imu[:3, :3]
        root = _root_information(to_world @ belief.cov @ to_world.T)
        yield _linear(at, {X(k): root[:, :6], V(k): root[:, 6:9], B(k): root[:, 9:]})

    def step(self, motion: Motion, bias: Array, k: int) -> Iterator[gtsam.NonlinearFactor]:
        assert isinstance(motion, ImuMotion)
        yield factors.imu_factor(imu.preintegrate(motion, bias, self._params), k)

    def keys(self, k: int) -> list[int]:
        return [X(k), V(k), B(k)]

    def insert(self, values: gtsam.Values, estimate: Estimate, k: int) -> None:
        assert estimate.bias is not None and estimate.v_world is not None
        values.insert(X(k), gtsam.Pose3(estimate.T_world_imu))
        values.insert(V(k), estimate.v_world)
        values.insert(B(k), _constant_bias(estimate.bias))

    def read(self, values: gtsam.Values, k: int, t_ns: int) -> Estimate:
        pose, velocity, bias = values.atPose3(X(k)), values.atVector(V(k)), values.atConstantBias(B(k))
        return Estimate(t_ns, pose.matrix(), v_world=velocity, bias=bias.vector())


def _constant_bias(bias: Array) -> gtsam.imuBias.ConstantBias:
    return gtsam.imuBias.ConstantBias(bias[:3], bias[3:])


def _root_information(cov: Array) -> Array:
    """Return a square root of the inverse of a covariance (d, d)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))


def _linear(at: gtsam.Values, blocks: dict[int, Array]) -> gtsam.NonlinearFactor:
    """Hold several variables jointly: what their errors have in common says as much as their variances."""
    size = len(next(iter(blocks.values())))
    arguments: Any = [*chain.from_iterable(blocks.items()), np.zeros(size), gtsam.noiseModel.Unit.Create(size)]
    whitened = gtsam.JacobianFactor(*arguments)
    return gtsam.LinearContainerFactor(whitened, at)
