"""Where a windowed filter evaluates its Jacobians: at the latest estimates or at the first ones.

At the latest estimates, the same landmark or pose enters different Jacobians with different values; together these
reduce the variance of the heading, which no measurement observes. At first estimates the unobservable directions stay
unobservable (Huang, Mourikis & Roumeliotis 2010; Li & Mourikis 2013, "High-precision, consistent EKF-based
visual-inertial odometry", section 4).
"""

from typing import Protocol

import numpy as np

from filters.kalman.joint import JointBelief
from toolkit.geometry import Array, BoolArray
from toolkit.measurements import Motion
from toolkit.models.state import Increment, MotionModel, Prediction


class Linearisation(Protocol):
    """Chooses the linearisation points of Jacobians."""

    def transition(self, joint: JointBelief, increment: Increment, prediction: Prediction) -> Array:
        """Return the transition (d, d) of a prediction from the joint belief."""

    def clones(self, joint: JointBelief) -> Array:
        """Return the poses (C, 4, 4) of the clones."""

    def points(self, joint: JointBelief) -> Array:
        """Return the landmarks (L, 3) m."""

    def outdated(self, joint: JointBelief) -> BoolArray:
        """Say which landmarks (L,) are too far from the linearisation points of their Jacobians."""


class AtLatestEstimates:
    """Linearises at the latest estimates: the standard EKF."""

    def transition(self, joint: JointBelief, increment: Increment, prediction: Prediction) -> Array:
        """Return the transition (d, d) of the prediction."""
        return prediction.transition

    def clones(self, joint: JointBelief) -> Array:
        """Return the present estimates (C, 4, 4) of the clones."""
        return joint.clones

    def points(self, joint: JointBelief) -> Array:
        """Return the present estimates (L, 3) m of the landmarks."""
        return joint.points

    def outdated(self, joint: JointBelief) -> BoolArray:
        """Return False for each (L,): the linearisation points are the estimates."""
        return np.zeros(len(joint.points), dtype=bool)


class AtFirstEstimates:
    """First-estimate Jacobians, valid for landmarks that have moved by at most a share of their distance since."""

    def __init__(self, most_moved: float = np.inf) -> None:
        self._most_moved = most_moved

    def transition(self, joint: JointBelief, increment: Increment, prediction: Prediction) -> Array:
        """Return the transition (d, d) between the first estimates of both instants."""
        return increment.transition_between(joint.first_core, prediction)

    def clones(self, joint: JointBelief) -> Array:
        """Return the first estimates (C, 4, 4) of the clones."""
        return joint.first_clones

    def points(self, joint: JointBelief) -> Array:
        """Return the first estimates (L, 3) m of the landmarks."""
        return joint.first_points

    def outdated(self, joint: JointBelief) -> BoolArray:
        """Say which landmarks (L,) have moved by more than that share of their distance from the newest clone."""
        moved_m = np.linalg.norm(joint.points - joint.first_points, axis=1)
        distance_m = np.linalg.norm(joint.points - joint.clones[-1, :3, 3], axis=1)
        return np.asarray(moved_m > self._most_moved * distance_m)


def propagate(joint: JointBelief, model: MotionModel, at: Linearisation, motion: Motion | None) -> None:
    """Propagate a joint belief over the motion between two frames; the first frame has none (None)."""
    if motion is None:
        return
    core = joint.core
    increment = model.integrate(motion, core.bias)
    prediction = increment.predict(core)
    joint.propagate(prediction, at.transition(joint, increment, prediction))
