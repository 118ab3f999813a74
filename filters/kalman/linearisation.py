"""Where a windowed filter evaluates its Jacobians: at the latest estimates or at the first ones.

At the latest, the same landmark or pose enters different Jacobians at different values, and the filter believes
it learns its heading from that, which nothing measures. At the first estimates the unobservable directions stay
so (Huang, Mourikis & Roumeliotis 2010; Li & Mourikis 2013, "High-precision, consistent EKF-based visual-inertial
odometry", section 4).
"""

from typing import Protocol

from filters.kalman.belief import Belief
from filters.kalman.joint import JointBelief
from filters.kalman.prediction import Predictor, Step
from toolkit.geometry import Array
from toolkit.sequence import Motion


class Linearisation(Protocol):
    """Chooses the values Jacobians are taken at."""

    def transition(self, predictor: Predictor, joint: JointBelief, step: Step, motion: Motion) -> Array:
        """Return the transition (d, d) of a step."""

    def clones(self, joint: JointBelief) -> Array:
        """Return the poses (C, 4, 4) of the clones."""

    def points(self, joint: JointBelief) -> Array:
        """Return the landmarks (L, 3)."""


class AtLatestEstimates:
    """The standard EKF."""

    def transition(self, predictor: Predictor, joint: JointBelief, step: Step, motion: Motion) -> Array:
        """Return the transition of the step as it was taken."""
        return step.transition

    def clones(self, joint: JointBelief) -> Array:
        """Return the clones as estimated now."""
        return joint.clones

    def points(self, joint: JointBelief) -> Array:
        """Return the landmarks as estimated now."""
        return joint.points


class AtFirstEstimates:
    """First-estimate Jacobians."""

    def transition(self, predictor: Predictor, joint: JointBelief, step: Step, motion: Motion) -> Array:
        """Return the transition between the first estimates of both instants."""
        start: Belief = joint.first_core
        return predictor.transition_between(start, step, motion)

    def clones(self, joint: JointBelief) -> Array:
        """Return the clones as first estimated."""
        return joint.first_clones

    def points(self, joint: JointBelief) -> Array:
        """Return the landmarks as first estimated."""
        return joint.first_points


def propagate(joint: JointBelief, predictor: Predictor, at: Linearisation, motion: Motion) -> None:
    """Carry a joint belief over the motion between two frames, linearised as chosen."""
    step = predictor.step(joint.core, motion)
    joint.propagate(step, at.transition(predictor, joint, step, motion))
