"""Prediction alone: the measured motion integrated from the start, vision unused (Kang, III-A, eqs. 1-2)."""

from filters.kalman.online_output import Filter, OnlineOutput
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Estimator, Setup
from toolkit.measurements import Packet
from toolkit.models.state import predicted

CITES = ("kang_vislam",)
RUNG, CHANGE = 0, "the measured motion alone"
DEFAULT = True


def build(setup: Setup) -> Estimator:
    return OnlineOutput(DeadReckoning(setup))


class DeadReckoning(Filter):
    """Integrates the measured motion; its error grows with time, because no measurement corrects it."""

    def __init__(self, setup: Setup) -> None:
        self._motion = setup.motion
        self._belief = self._motion.initial_belief(setup.prior)

    def step(self, packet: Packet) -> Estimate:
        self._belief = predicted(self._belief, self._motion, packet.motion)
        return self._belief.estimate(packet.frame.t_ns)

    def landmarks(self) -> Landmarks:
        return Landmarks.none()
