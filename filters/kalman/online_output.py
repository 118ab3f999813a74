"""Makes an estimator of a filter: its final word is what it said at every frame."""

from typing import Protocol

from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.sequence import Packet


class Filter(Protocol):
    """Answers at every frame and remembers its landmarks."""

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and say where the IMU is."""

    def landmarks(self) -> Landmarks:
        """Return every landmark the filter ever had, as last known."""


class Speaker:
    """Remembers what a filter said."""

    def __init__(self, spoken_for: Filter) -> None:
        self._filter = spoken_for
        self._said: list[Estimate] = []

    def step(self, packet: Packet) -> Estimate:
        """Pass the packet on and remember the answer."""
        self._said.append(self._filter.step(packet))
        return self._said[-1]

    def finish(self) -> Finished:
        """Return what was said at every frame and the landmarks as last known."""
        return Finished(Trajectory.of(self._said), self._filter.landmarks())
