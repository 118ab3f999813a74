"""MSCKF with first-estimate Jacobians and long-lived landmarks in the state (Li & Mourikis 2013)."""

from filters import msckf
from filters.kalman.joint import AtFirstEstimates, linearisation
from toolkit.estimator import Estimator, Setup

CITES = ("mourikis2007msckf", "li2013high")
RUNG, CHANGE = 80, "+ long-lived landmarks in the state, in metres"
DEFAULT = True
OPTIONS = {"linearisation": ("first", "latest")}
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
    return msckf.estimator(setup, at, setup.settings.window.landmarks)
