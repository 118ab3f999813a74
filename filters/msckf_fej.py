"""MSCKF with first-estimate Jacobians, which keep the heading unobservable (Li & Mourikis 2013)."""

from filters import msckf
from filters.kalman.joint import AtFirstEstimates
from toolkit.estimator import Estimator, Setup

CITES = ("mourikis2007msckf", "li2013high")
RUNG, CHANGE = 70, "+ first-estimate Jacobians"
INGREDIENTS = ("landmark uncertainty", "biases", "cross-covariances", "consistent linearisation", "past poses")
WITHOUT = {"biases": {"noise.biases": "fixed"}}


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return msckf.estimator(setup, AtFirstEstimates())
