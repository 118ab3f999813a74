"""The state of the IMU in every model, filter and graph: its layout, its mean and covariance, its variables.

Errors follow GTSAM: the pose [rotation, position] and the velocity are perturbed in the body frame. A motion model
integrates the measurements between two frames once, about a bias. A filter predicts from that increment (mean, F, Q), a
smoother makes its factors from the same one.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol, Self

import gtsam
import numpy as np

from toolkit.estimate import Estimate
from toolkit.geometry import Array, se3_exp, se3_inverse, se3_log
from toolkit.measurements import Motion, Prior
from toolkit.models.factors import B, EliminatedGraph, V, X, constant_bias, joint_cov, joint_prior, kind_of

ROTATION, POSITION, POSE = slice(0, 3), slice(3, 6), slice(0, 6)


@dataclass(frozen=True)
class Layout:
    """The slices of the blocks of an error state; None for a block that the state lacks. The biases are last."""

    size: int
    velocity: slice | None
    accel_bias: slice | None
    gyro_bias: slice

    @property
    def biases(self) -> slice:
        """Return the slice of all biases."""
        return slice((self.accel_bias or self.gyro_bias).start, self.size)


# Of the whole state where an IMU measures the motion, and where twists do.
IMU_LAYOUT = Layout(15, slice(6, 9), slice(9, 12), slice(12, 15))
TWIST_LAYOUT = Layout(9, None, None, slice(6, 9))


def with_velocity_turned(cov: Array, layout: Layout, rotation: Array) -> Array:
    """Return a covariance (d, d) with the velocity's error, if the state has one, rotated by (3, 3) to other axes."""
    if layout.velocity is None:
        return cov
    turn = np.eye(layout.size)
    turn[layout.velocity, layout.velocity] = rotation
    return np.asarray(turn @ cov @ turn.T)


class Prediction(NamedTuple):
    """A state predicted over one interval.

    ``T_world_imu`` (4, 4) and ``v_world`` (3,) m/s at its end; ``transition`` F (d, d) propagates an error over the
    interval and ``noise`` Q (d, d) is the covariance that the interval adds, both in the layout of the state. The
    biases stay.
    """

    T_world_imu: Array
    v_world: Array
    transition: Array
    noise: Array


@dataclass(frozen=True, eq=False)
class Belief:
    """Pose (4, 4), velocity (3,) m/s and bias (6,) [accel, gyro] with the covariance (d, d) of the layout's error."""

    layout: Layout
    T_world_imu: Array
    v_world: Array
    bias: Array
    cov: Array

    @classmethod
    def of_prior(cls, prior: Prior, layout: Layout) -> Self:
        """Return the belief at the first frame: the prior, reduced to the blocks of the layout."""
        velocity = [] if layout.velocity is None else [slice(6, 9)]
        accel_bias = [] if layout.accel_bias is None else [slice(9, 12)]
        kept = np.r_[(slice(0, 6), *velocity, *accel_bias, slice(12, 15))]
        return cls(layout, prior.T_world_imu, prior.v_world, prior.bias, prior.cov[np.ix_(kept, kept)])

    def moved(self, delta: Array, cov: Array) -> "Belief":
        """Return the belief moved by an error (d,), with a new covariance made exactly symmetric."""
        moved = self.displaced(delta, se3_exp(delta[POSE]))
        return Belief(moved.layout, moved.T_world_imu, moved.v_world, moved.bias, 0.5 * (cov + cov.T))

    def displaced(self, delta: Array, step: Array) -> "Belief":
        """Return the belief with its mean moved by an error (d,), its pose by the motion ``step`` (4, 4) instead."""
        v_world, bias = self.v_world, self.bias.copy()
        if self.layout.velocity is not None:
            v_world = v_world + self.T_world_imu[:3, :3] @ delta[self.layout.velocity]
        if self.layout.accel_bias is not None:
            bias[:3] += delta[self.layout.accel_bias]
        bias[3:] += delta[self.layout.gyro_bias]
        return Belief(self.layout, self.T_world_imu @ step, v_world, bias, self.cov)

    def error_to(self, other: "Belief") -> Array:
        """Return the error (d,) that moves the belief's mean to another's: what :meth:`moved` takes."""
        error, layout = np.zeros(self.layout.size), self.layout
        error[POSE] = se3_log(se3_inverse(self.T_world_imu) @ other.T_world_imu)
        if layout.velocity is not None:
            error[layout.velocity] = self.T_world_imu[:3, :3].T @ (other.v_world - self.v_world)
        if layout.accel_bias is not None:
            error[layout.accel_bias] = other.bias[:3] - self.bias[:3]
        error[layout.gyro_bias] = other.bias[3:] - self.bias[3:]
        return error

    def predicted(self, prediction: Prediction) -> "Belief":
        """Return the belief at the end of an interval: its mean as predicted, its covariance F P F^T + Q."""
        F, Q = prediction.transition, prediction.noise
        cov = F @ self.cov @ F.T + Q
        return replace(self, T_world_imu=prediction.T_world_imu, v_world=prediction.v_world, cov=0.5 * (cov + cov.T))

    def at(self, estimate: Estimate) -> "Belief":
        """Return the belief at the values of an estimate; values that the estimate lacks stay."""
        v_world = self.v_world if estimate.v_world is None else estimate.v_world
        bias = self.bias if estimate.bias is None else estimate.bias
        cov = self.cov if estimate.cov is None else estimate.cov
        return replace(self, T_world_imu=estimate.T_world_imu, v_world=v_world, bias=bias, cov=cov)

    def estimate(self, t_ns: int, **info: float) -> Estimate:
        """Return the belief as an Estimate; a velocity is given only where it is part of the state."""
        v_world = None if self.layout.velocity is None else self.v_world
        return Estimate(t_ns, self.T_world_imu, self.cov, v_world, self.bias, info)


class Increment(Protocol):
    """The measured motion between two frames, integrated about a bias."""

    def predict(self, start: Belief) -> Prediction:
        """Predict a state, whose bias is the increment's, over the interval."""

    def transition_between(self, start: Belief, end: Prediction) -> Array:
        """Return the transition (d, d) linearised at other states than those of the prediction.

        It leads from the mean of ``start`` to that of ``end``: with the first estimates of both instants, errors of the
        unobservable heading and position stay unobservable (Li & Mourikis 2013, section 4).
        """

    def factors(self, k: int) -> gtsam.NonlinearFactorGraph:
        """Return the factors between states k - 1 and k in a graph."""


class MotionModel(ABC):
    """The state that a kind of motion needs, its prediction, and its variables in a graph.

    State k is the pose X(k), the velocity V(k) in the world if the layout has one, and the bias B(k): GTSAM's
    ConstantBias, or the gyro's (3,) alone.
    """

    layout: Layout

    @abstractmethod
    def integrate(self, motion: Motion, bias: Array) -> Increment:
        """Integrate the motion between two frames about a bias (6,) [accel m/s^2, gyro rad/s]."""

    def initial_belief(self, prior: Prior) -> Belief:
        """Return the belief at the first frame: the prior, reduced to the blocks of the layout."""
        return Belief.of_prior(prior, self.layout)

    @cached_property
    def variable_sizes(self) -> dict[str, int]:
        """Return the dimensions of a state's variables by the letters of their keys, in the error state's order."""
        velocity = {} if self.layout.velocity is None else {"v": 3}
        return {"x": 6, **velocity, "b": self.layout.biases.stop - self.layout.biases.start}

    def keys(self, k: int) -> list[int]:
        """Return the keys of state k, in the order of the error state: pose, (velocity,) bias."""
        return [gtsam.symbol(kind, k) for kind in self.variable_sizes]

    def insert(self, values: gtsam.Values, estimate: Estimate, k: int) -> None:
        """Add state k at an estimate."""
        assert estimate.bias is not None
        values.insert(X(k), gtsam.Pose3(estimate.T_world_imu))
        if self.layout.velocity is not None:
            assert estimate.v_world is not None
            values.insert(V(k), estimate.v_world)
        values.insert(B(k), estimate.bias[3:] if self.layout.accel_bias is None else constant_bias(estimate.bias))

    def read(self, values: gtsam.Values, k: int, t_ns: int) -> Estimate:
        """Return state k, without a covariance; an accelerometer bias that it lacks is zero."""
        if self.layout.accel_bias is None:
            bias = np.concatenate([np.zeros(3), values.atVector(B(k))])
        else:
            bias = values.atConstantBias(B(k)).vector()
        v_world = None if self.layout.velocity is None else values.atVector(V(k))
        return Estimate(t_ns, values.atPose3(X(k)).matrix(), v_world=v_world, bias=bias)

    def latest(self, tree: gtsam.ISAM2, keys: list[int]) -> gtsam.Values:
        """Return the latest values of some states' variables, without copying all others from the tree."""
        of_vector, of_bias = tree.calculateEstimateVector, tree.calculateEstimateConstantBias
        bias = of_vector if self.layout.accel_bias is None else of_bias
        readers, values = {"x": tree.calculateEstimatePose3, "v": of_vector, "b": bias}, gtsam.Values()
        for key in keys:
            values.insert(key, readers[kind_of(key)](key))
        return values

    def hold(self, belief: Belief, k: int) -> gtsam.NonlinearFactorGraph:
        """Return the prior on state k at a belief: one linear factor on all its variables."""
        at = gtsam.Values()
        self.insert(at, belief.estimate(0), k)
        cov = with_velocity_turned(belief.cov, self.layout, belief.T_world_imu[:3, :3])
        return joint_prior(at, self.keys(k), cov)

    def estimate_cov(self, cov: Array, R_world_imu: Array) -> Array:
        """Return a covariance (d, d) in GTSAM's tangent spaces in the form that an Estimate has, exactly symmetric.

        GTSAM's velocity is a vector in the world; an Estimate's velocity error is in the body frame. ``R_world_imu``
        (3, 3) is the state's own attitude.
        """
        cov = with_velocity_turned(cov, self.layout, R_world_imu.T)
        return 0.5 * (cov + cov.T)

    def state_cov(self, tree: EliminatedGraph, k: int, R_world_imu: Array) -> Array:
        """Return the covariance (d, d) of state k, whose attitude is given, in the form of an Estimate.

        Raises RuntimeError, as GTSAM does, where the graph does not determine it.
        """
        return self.estimate_cov(joint_cov(tree, self.keys(k)), R_world_imu)
