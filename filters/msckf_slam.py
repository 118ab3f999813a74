"""MSCKF with first-estimate Jacobians and long-lived landmarks in the state (Li & Mourikis 2013)."""

from filters import msckf
from filters.kalman.joint import AtFirstEstimates
from toolkit.estimator import Estimator, Setup

CITES = ("mourikis2007msckf", "li2013high")
RUNG, CHANGE = 80, "+ long-lived landmarks in the state, in metres"
DEFAULT = True


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return msckf.estimator(setup, AtFirstEstimates(), setup.settings.window.landmarks)
