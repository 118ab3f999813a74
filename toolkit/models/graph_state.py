"""A motion model with its states as variables in a graph, and the measured motion between them as factors."""

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Protocol

import gtsam
import numpy as np

from toolkit.estimate import Estimate
from toolkit.geometry import Array
from toolkit.measurements import Motion, Prior
from toolkit.models.factors import B, EliminatedGraph, V, X, constant_bias, joint_cov, joint_prior
from toolkit.models.state import Belief, Increment, Layout, Prediction, with_velocity_turned


class GraphIncrement(Increment, Protocol):
    """The measured motion between two frames, for filters and for graphs."""

    def factors(self, k: int) -> gtsam.NonlinearFactorGraph:
        """Return the factors between states k - 1 and k in a graph."""


class MotionModel(ABC):
    """The state that a kind of motion needs, its prediction, and its variables in a graph.

    State k is the pose X(k), the velocity V(k) in the world if the layout has one, and the bias B(k): GTSAM's
    ConstantBias, or the gyro's (3,) alone.
    """

    layout: Layout

    @abstractmethod
    def integrate(self, motion: Motion, bias: Array) -> GraphIncrement:
        """Integrate the motion between two frames about a bias (6,) [accel m/s^2, gyro rad/s]."""

    def predict_each(self, motions: list[Motion], starts: Belief) -> Prediction:
        """Predict S >= 1 states, stacked in a belief, over an interval each; the prediction is stacked likewise."""
        each = [self.integrate(motion, starts.bias[k]).predict(starts[k]) for k, motion in enumerate(motions)]
        return Prediction(*(np.stack(part) for part in zip(*each, strict=True)))

    def initial_belief(self, prior: Prior) -> Belief:
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
