"""The report's decoupled EKF made sound: gates, landmark noise in the innovation, biases (Kang, III-C)."""

from filters.kalman.decoupled import DecoupledEkf
from toolkit.estimate import Estimate, Finished, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.sequence import Packet


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return Ekf(setup)


class Ekf:
    """Answers at every frame; its final word is what it said."""

    def __init__(self, setup: Setup) -> None:
        self._filter = DecoupledEkf(setup)
        self._said: list[Estimate] = []

    def step(self, packet: Packet) -> Estimate:
        """Correct the pose and the map by one packet."""
        self._said.append(self._filter.step(packet))
        return self._said[-1]

    def finish(self) -> Finished:
        """Return what was said at every frame and every landmark as last known."""
        return Finished(Trajectory.of(self._said), self._filter.landmarks())
