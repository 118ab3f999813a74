"""Sliding window of cloned poses tied by tracks (Mourikis & Roumeliotis 2007)."""

from filters.kalman.linearisation import AtLatestEstimates
from filters.kalman.online_output import OnlineOutput
from filters.kalman.sliding_window import SlidingWindowFilter
from filters.kalman.thinning import Thinned
from toolkit.estimator import Estimator, Setup

CITES = ("mourikis2007msckf",)
RUNG, CHANGE = 60, "+ past poses; one update a track, at its end; usual errors, one step"


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return Thinned(setup, OnlineOutput(SlidingWindowFilter(setup, AtLatestEstimates())))
