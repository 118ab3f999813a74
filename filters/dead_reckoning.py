"""Prediction alone: the measured motion integrated from the start, vision unused (Kang, III-A, eqs. 1-2)."""

from filters.kalman.belief import initial_belief
from filters.kalman.prediction import predictor
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.sequence import Packet


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return DeadReckoning(setup)


class DeadReckoning:
    """Integrates the motion; its error grows with time and nothing ever corrects it."""

    def __init__(self, setup: Setup) -> None:
        self._predict = predictor(setup)
        self._belief = initial_belief(setup.prior, setup.motion_kind)
        self._said: list[Estimate] = []

    def step(self, packet: Packet) -> Estimate:
        """Integrate the motion up to the packet's frame."""
        if packet.motion is not None:
            self._belief = self._predict(self._belief, packet.motion)
        self._said.append(self._belief.estimate(packet.frame.t_ns))
        return self._said[-1]

    def finish(self) -> Finished:
        """Return what was said at every frame; there are no landmarks."""
        return Finished(Trajectory.of(self._said), Landmarks.none())
