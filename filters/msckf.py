"""Sliding window of cloned poses tied by tracks (Mourikis & Roumeliotis 2007)."""

from filters.kalman.linearisation import AtLatestEstimates
from filters.kalman.online_output import OnlineOutput
from filters.kalman.sliding_window import SlidingWindowFilter
from toolkit.estimator import Estimator, Setup

RUNG, CHANGE = 60, "+ window of past poses"


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return OnlineOutput(SlidingWindowFilter(setup, AtLatestEstimates()))
