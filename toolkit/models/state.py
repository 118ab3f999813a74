"""The state of the IMU in every model, filter and graph: its layout, its mean and covariance, its variables.

Errors follow GTSAM: the pose [rotation, position] and the velocity are perturbed in the body frame. A motion model
integrates the measurements between two frames once, about a bias. A filter predicts from that increment (mean, F, Q), a
smoother makes its factors from the same one.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, Self

import numpy as np

from toolkit.estimate import Estimate
from toolkit.geometry import Array, IntArray, se3_exp, se3_inverse, se3_log
from toolkit.measurements import Motion, Prior

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
    biases stay. Several predictions are stacked in one.
    """

    T_world_imu: Array
    v_world: Array
    transition: Array
    noise: Array


@dataclass(frozen=True, eq=False)
class Belief:
    """Pose (4, 4), velocity (3,) m/s and bias (6,) [accel, gyro] with the covariance (d, d) of the layout's error.

    Several beliefs are stacked in one whose arrays have one axis more in front.
    """

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

    def __getitem__(self, rows: int | IntArray | slice) -> "Belief":
        return Belief(self.layout, self.T_world_imu[rows], self.v_world[rows], self.bias[rows], self.cov[rows])

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
        """Return the error (..., d) that moves the belief's mean to another's: what :meth:`moved` takes."""
        error, layout = np.zeros((*self.bias.shape[:-1], self.layout.size)), self.layout
        error[..., POSE] = se3_log(se3_inverse(self.T_world_imu) @ other.T_world_imu)
        if layout.velocity is not None:
            error[..., layout.velocity] = self._in_body(other.v_world - self.v_world)
        if layout.accel_bias is not None:
            error[..., layout.accel_bias] = other.bias[..., :3] - self.bias[..., :3]
        error[..., layout.gyro_bias] = other.bias[..., 3:] - self.bias[..., 3:]
        return error

    def _in_body(self, v_world: Array) -> Array:
        return np.asarray((self.T_world_imu[..., :3, :3].mT @ v_world[..., None])[..., 0])

    def predicted(self, prediction: Prediction) -> "Belief":
        """Return the belief at the end of an interval: its mean as predicted, its covariance F P F^T + Q."""
        F, Q = prediction.transition, prediction.noise
        cov = F @ self.cov @ F.mT + Q
        return replace(self, T_world_imu=prediction.T_world_imu, v_world=prediction.v_world, cov=0.5 * (cov + cov.mT))

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


class Predictor(Protocol):
    """What a filter needs of a motion model: the state that a kind of motion needs, and its prediction."""

    def initial_belief(self, prior: Prior) -> Belief:
        """Return the belief at the first frame: the prior, reduced to the blocks of the layout."""

    def integrate(self, motion: Motion, bias: Array) -> Increment:
        """Integrate the motion between two frames about a bias (6,) [accel m/s^2, gyro rad/s]."""


def predicted(belief: Belief, model: Predictor, motion: Motion | None) -> Belief:
    """Return the belief predicted over a measured motion; unchanged if there is none, at the first frame."""
    if motion is None:
        return belief
    return belief.predicted(model.integrate(motion, belief.bias).predict(belief))
