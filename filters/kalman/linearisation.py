"""Where a windowed filter evaluates its Jacobians: at the latest estimates or at the first ones.

At the latest, the same landmark or pose enters different Jacobians at different values; together they reduce the
variance of the heading, which nothing measures. At the first estimates the unobservable directions stay
so (Huang, Mourikis & Roumeliotis 2010; Li & Mourikis 2013, "High-precision, consistent EKF-based visual-inertial
odometry", section 4).
"""

from typing import Protocol

import numpy as np

from filters.kalman.joint import JointBelief
from toolkit.geometry import Array, BoolArray
from toolkit.measured_motion import Motion
from toolkit.models.motion import Increment
from toolkit.models.state import Prediction


class Linearisation(Protocol):
    """Chooses the values Jacobians are taken at."""

    def transition(self, joint: JointBelief, increment: Increment, prediction: Prediction) -> Array:
        """Return the transition (d, d) of a prediction from the joint belief."""

    def clones(self, joint: JointBelief) -> Array:
        """Return the poses (C, 4, 4) of the clones."""

    def points(self, joint: JointBelief) -> Array:
        """Return the landmarks (L, 3)."""

    def outdated(self, joint: JointBelief) -> BoolArray:
        """Say which landmarks (L,) are no longer where the Jacobians take them to be."""


class AtLatestEstimates:
    """The standard EKF."""

    def transition(self, joint: JointBelief, increment: Increment, prediction: Prediction) -> Array:
        """Return the transition (d, d) as it was predicted."""
        return prediction.transition

    def clones(self, joint: JointBelief) -> Array:
        """Return the poses (C, 4, 4) of the clones as estimated now."""
        return joint.clones

    def points(self, joint: JointBelief) -> Array:
        """Return the landmarks (L, 3) as estimated now."""
        return joint.points

    def outdated(self, joint: JointBelief) -> BoolArray:
        """Return none: each is where it is estimated."""
        return np.zeros(len(joint.points), dtype=bool)


class AtFirstEstimates:
    """First-estimate Jacobians, of landmarks that have moved since by no more than a share of their distance."""

    def __init__(self, most_moved: float = np.inf) -> None:
        self._most_moved = most_moved

    def transition(self, joint: JointBelief, increment: Increment, prediction: Prediction) -> Array:
        """Return the transition (d, d) between the first estimates of both instants."""
        return increment.transition_between(joint.first_core, prediction)

    def clones(self, joint: JointBelief) -> Array:
        """Return the poses (C, 4, 4) of the clones as first estimated."""
        return joint.first_clones

    def points(self, joint: JointBelief) -> Array:
        """Return the landmarks (L, 3) as first estimated."""
        return joint.first_points

    def outdated(self, joint: JointBelief) -> BoolArray:
        """Say which have moved since they were first estimated by more than that of the way from the newest clone."""
        moved_m = np.linalg.norm(joint.points - joint.first_points, axis=1)
        distance_m = np.linalg.norm(joint.points - joint.clones[-1, :3, 3], axis=1)
        return np.asarray(moved_m > self._most_moved * distance_m)


class Integrator(Protocol):
    """Integrates what was measured between two frames; every motion model does."""

    def integrate(self, motion: Motion, bias: Array) -> Increment:
        """Integrate the motion between two frames about a bias (6,) [accel m/s^2, gyro rad/s]."""


def propagate(joint: JointBelief, model: Integrator, at: Linearisation, motion: Motion | None) -> None:
    """Carry a joint belief over the motion between two frames, linearised as chosen; before the first there is none."""
    if motion is None:
        return
    core = joint.core
    increment = model.integrate(motion, core.bias)
    prediction = increment.predict(core)
    joint.propagate(prediction, at.transition(joint, increment, prediction))
