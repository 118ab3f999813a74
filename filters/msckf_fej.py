"""MSCKF with first-estimate Jacobians, which do not invent heading (Li & Mourikis 2013)."""

from filters.kalman.linearisation import AtFirstEstimates
from filters.kalman.online_output import Speaker
from filters.kalman.sliding_window import CLONES, SlidingWindowFilter, WindowSize
from toolkit.estimator import Estimator, Setup

RUNG, CHANGE = 70, "+ first-estimate Jacobians"


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    size = WindowSize(CLONES[setup.motion_kind])
    return Speaker(SlidingWindowFilter(setup, AtFirstEstimates(), size))
