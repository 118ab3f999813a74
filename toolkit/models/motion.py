"""The motion of the IMU between two frames, for filters and smoothers; no other file asks for the kind of motion.

A motion model integrates the measurements between two frames once, about a bias. A filter predicts from that increment
(mean, F, Q), a smoother makes its factors from the same one. Each implementation is a file:
:mod:`toolkit.models.twist`, :mod:`toolkit.models.imu` and, where nothing was measured,
:mod:`toolkit.models.smooth_twist`.
"""

from collections.abc import Mapping
from typing import Protocol

import gtsam

from toolkit.estimate import Estimate
from toolkit.geometry import Array
from toolkit.measurements import Motion, MotionNoise, Prior, TwistChangeNoise, TwistNoise
from toolkit.models.factors import EliminatedGraph, joint_cov
from toolkit.models.imu import ImuModel
from toolkit.models.smooth_twist import SmoothTwist
from toolkit.models.state import Belief, Layout, Prediction
from toolkit.models.twist import TwistModel


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


class MotionModel(Protocol):
    """The state that a kind of motion needs, and its prediction."""

    @property
    def layout(self) -> Layout:
        """Return the layout of the error state."""

    def initial_belief(self, prior: Prior) -> Belief:
        """Return the belief at the first frame."""

    def integrate(self, motion: Motion, bias: Array) -> Increment:
        """Integrate the motion between two frames about a bias (6,) [accel m/s^2, gyro rad/s]."""

    @property
    def variable_sizes(self) -> Mapping[str, int]:
        """Return the dimensions of a state's variables by the letters of their keys, in the error state's order."""

    def latest(self, tree: gtsam.ISAM2, keys: list[int]) -> gtsam.Values:
        """Return the latest values of some states' variables, without copying all others from the tree."""

    def insert(self, values: gtsam.Values, estimate: Estimate, k: int) -> None:
        """Add state k at an estimate."""

    def read(self, values: gtsam.Values, k: int, t_ns: int) -> Estimate:
        """Return state k, without a covariance."""

    def hold(self, belief: Belief, k: int) -> gtsam.NonlinearFactorGraph:
        """Return the prior on state k at a belief: one linear factor on all its variables."""

    def estimate_cov(self, cov: Array, R_world_imu: Array) -> Array:
        """Return a covariance (d, d) in GTSAM's tangent spaces in the form that an Estimate has.

        GTSAM's velocity is a vector in the world; an Estimate's velocity error is in the body frame. ``R_world_imu``
        (3, 3) is the state's own attitude.
        """


def state_keys(model: MotionModel, k: int) -> list[int]:
    """Return the keys of state k in a graph, in the order of the error state: pose, (velocity,) bias."""
    return [gtsam.symbol(kind, k) for kind in model.variable_sizes]


def motion_model(noise: MotionNoise, gravity_world: Array) -> MotionModel:
    """Return the model for the kind of motion whose noise this is; ``gravity_world`` (3,) m/s^2."""
    if isinstance(noise, TwistNoise):
        return TwistModel(noise)
    if isinstance(noise, TwistChangeNoise):
        return SmoothTwist(noise)
    return ImuModel(noise, gravity_world)


def state_cov(model: MotionModel, tree: EliminatedGraph, k: int, R_world_imu: Array) -> Array:
    """Return the covariance (d, d) of state k, whose attitude is given, in the order and on the side of an Estimate.

    Raises RuntimeError, as GTSAM does, where the graph does not determine it.
    """
    return model.estimate_cov(joint_cov(tree, state_keys(model, k)), R_world_imu)


def predicted(belief: Belief, model: MotionModel, motion: Motion | None) -> Belief:
    """Return the belief predicted over a measured motion; unchanged if there is none, at the first frame."""
    if motion is None:
        return belief
    return belief.predicted(model.integrate(motion, belief.bias).predict(belief))
