"""MSCKF with first-estimate Jacobians and 50 long-lived landmarks in the state (Li & Mourikis 2013)."""

from filters.kalman.linearisation import AtFirstEstimates
from filters.kalman.online_output import Speaker
from filters.kalman.sliding_window import CLONES, SlidingWindowFilter, WindowSize
from toolkit.estimator import Estimator, Setup

RUNG, CHANGE = 80, "+ long-lived landmarks"


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    size = WindowSize(CLONES[setup.motion_kind], landmarks=50)
    return Speaker(SlidingWindowFilter(setup, AtFirstEstimates(), size))
