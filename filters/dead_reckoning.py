"""Prediction alone: the measured motion integrated from the start, vision unused (Kang, III-A, eqs. 1-2)."""

from filters.kalman.belief import initial_belief
from filters.kalman.online_output import Speaker
from filters.kalman.prediction import predicted, predictor
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Estimator, Setup
from toolkit.sequence import Packet

RUNG, CHANGE = 0, "the measured motion alone"
DEFAULT = True


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return Speaker(DeadReckoning(setup))


class DeadReckoning:
    """Integrates the motion; its error grows with time and nothing ever corrects it."""

    def __init__(self, setup: Setup) -> None:
        self._predictor = predictor(setup)
        self._belief = initial_belief(setup.prior, setup.motion_kind)

    def step(self, packet: Packet) -> Estimate:
        """Integrate the motion up to the packet's frame."""
        if packet.motion is not None:
            self._belief = predicted(self._belief, self._predictor.step(self._belief, packet.motion))
        return self._belief.estimate(packet.frame.t_ns)

    def landmarks(self) -> Landmarks:
        """Return no landmarks."""
        return Landmarks.none()
