"""MSCKF with first-estimate Jacobians and long-lived landmarks in the state (Li & Mourikis 2013)."""

from collections.abc import Callable
from functools import partial

from filters import msckf
from filters.kalman.coordinates import CloneAnchoredBelief
from filters.kalman.joint import AtFirstEstimates, JointBelief, linearisation
from toolkit.estimator import Estimator, Setup
from toolkit.models.state import Belief
from toolkit.settings import Scalar

CITES = ("mourikis2007msckf", "li2013high")
RUNG, CHANGE = 80, "+ long-lived landmarks in the state, in metres"
DEFAULT = True
OPTIONS = {"linearisation": ("first", "latest"), "landmarks": ("metres", "anchored inverse depth")}
INGREDIENTS = (
    "landmark uncertainty",
    "biases",
    "cross-covariances",
    "consistent linearisation",
    "past poses",
    "long-lived landmarks",
)
WITHOUT = {"biases": {"noise.biases": "fixed"}, "consistent linearisation": {"linearisation": "latest"}}


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    at = linearisation(setup, AtFirstEstimates())
    anchored = partial(CloneAnchoredBelief, T_imu_cam=setup.rig.T_imu_cam, at=at)
    beliefs: dict[Scalar, Callable[[Belief], JointBelief]] = {"metres": JointBelief, "anchored inverse depth": anchored}
    return msckf.estimator(setup, at, setup.settings.window.landmarks, setup.choice("landmarks", beliefs))
