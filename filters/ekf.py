"""The report's decoupled EKF made sound: gates, landmark noise in the innovation, biases (Kang, III-C)."""

from filters.kalman.decoupled import DecoupledEkf
from filters.kalman.online_output import Speaker
from toolkit.estimator import Estimator, Setup

RUNG, CHANGE = 20, "+ gates, landmark noise in the innovation"
DEFAULT = True


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return Speaker(DecoupledEkf(setup))
