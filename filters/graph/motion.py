"""The motion of a sequence as a factor graph: prior, one step a frame, initial values and how to read the result.

Two kinds: a measured twist with a gyro bias (3,) at every frame, or raw IMU samples with velocity and both
biases. A smoother uses either without knowing which.
"""

from collections.abc import Iterator
from typing import Protocol

import gtsam
import numpy as np

from toolkit.estimate import Estimate
from toolkit.estimator import Setup
from toolkit.geometry import Array
from toolkit.models import factors, imu, twist
from toolkit.models.factors import B, V, X
from toolkit.sequence import ImuMotion, ImuNoise, Motion, Prior, TwistMotion, TwistNoise


class MotionGraph(Protocol):
    """Makes the factors and values of one kind of motion."""

    def prior(self) -> Iterator[gtsam.NonlinearFactor]:
        """Yield what holds the first state."""

    def step(self, motion: Motion, bias: Array, k: int) -> Iterator[gtsam.NonlinearFactor]:
        """Yield what ties state k - 1 to state k, integrated about a bias (6,)."""

    def insert(self, values: gtsam.Values, estimate: Estimate, k: int) -> None:
        """Add state k at an estimate."""

    def read(self, values: gtsam.Values, k: int, t_ns: int) -> Estimate:
        """Return state k."""


def motion_graph(setup: Setup) -> MotionGraph:
    """Return the maker for the kind of motion and the noise of a setup."""
    if isinstance(setup.noise, TwistNoise):
        return _TwistGraph(setup.noise, setup.prior)
    return _ImuGraph(setup.noise, setup.prior, setup.gravity_world)


def _pose_prior(prior: Prior) -> gtsam.NonlinearFactor:
    noise = gtsam.noiseModel.Gaussian.Covariance(prior.cov[:6, :6])
    return gtsam.PriorFactorPose3(X(0), gtsam.Pose3(prior.T_world_imu), noise)


class _TwistGraph:
    def __init__(self, noise: TwistNoise, prior: Prior) -> None:
        self._noise, self._prior = noise, prior

    def prior(self) -> Iterator[gtsam.NonlinearFactor]:
        yield _pose_prior(self._prior)
        noise = gtsam.noiseModel.Gaussian.Covariance(self._prior.cov[12:, 12:])
        yield gtsam.PriorFactorVector(B(0), self._prior.bias[3:], noise)

    def step(self, motion: Motion, bias: Array, k: int) -> Iterator[gtsam.NonlinearFactor]:
        assert isinstance(motion, TwistMotion)
        step = twist.integrate(motion, bias[3:], self._noise)
        yield factors.twist_factor(step, bias[3:], k)
        yield factors.gyro_bias_walk_factor(self._noise, step.dt_s, k)

    def insert(self, values: gtsam.Values, estimate: Estimate, k: int) -> None:
        assert estimate.bias is not None
        values.insert(X(k), gtsam.Pose3(estimate.T_world_imu))
        values.insert(B(k), estimate.bias[3:])

    def read(self, values: gtsam.Values, k: int, t_ns: int) -> Estimate:
        bias = np.concatenate([np.zeros(3), values.atVector(B(k))])
        return Estimate(t_ns, values.atPose3(X(k)).matrix(), bias=bias)


class _ImuGraph:
    def __init__(self, noise: ImuNoise, prior: Prior, gravity_world: Array) -> None:
        self._params = imu.preintegration_params(noise, gravity_world)
        self._prior = prior

    def prior(self) -> Iterator[gtsam.NonlinearFactor]:
        """Hold pose, velocity and biases jointly: the start's correlations say as much as its variances."""
        start = gtsam.Values()
        start.insert(X(0), gtsam.Pose3(self._prior.T_world_imu))
        start.insert(V(0), self._prior.v_world)
        start.insert(B(0), _constant_bias(self._prior.bias))
        to_world = np.eye(15)
        to_world[6:9, 6:9] = self._prior.T_world_imu[:3, :3]
        root = np.linalg.inv(np.linalg.cholesky(to_world @ self._prior.cov @ to_world.T))
        blocks = (X(0), root[:, :6], V(0), root[:, 6:9], B(0), root[:, 9:])
        whitened = gtsam.JacobianFactor(*blocks, np.zeros(15), gtsam.noiseModel.Unit.Create(15))
        yield gtsam.LinearContainerFactor(whitened, start)

    def step(self, motion: Motion, bias: Array, k: int) -> Iterator[gtsam.NonlinearFactor]:
        assert isinstance(motion, ImuMotion)
        yield factors.imu_factor(imu.preintegrate(motion, bias, self._params), k)

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
