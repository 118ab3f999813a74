"""MSCKF with first-estimate Jacobians and long-lived landmarks in the state (Li & Mourikis 2013)."""

from filters.kalman.linearisation import AtFirstEstimates
from filters.kalman.online_output import OnlineOutput
from filters.kalman.sliding_window import SlidingWindowFilter
from filters.kalman.thinning import Thinned
from toolkit.estimator import Estimator, Setup

CITES = ("mourikis2007msckf", "li2013high")
RUNG, CHANGE = 80, "+ long-lived landmarks in the state, in metres"
DEFAULT = True


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return Thinned(setup, OnlineOutput(SlidingWindowFilter(setup, AtFirstEstimates(), setup.settings.window.landmarks)))
