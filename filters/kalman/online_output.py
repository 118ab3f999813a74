"""Makes an estimator of a filter, whose final answer is its online output: the estimates it gave frame by frame."""

from dataclasses import dataclass, field
from typing import Protocol

from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.geometry import Array, IntArray
from toolkit.sequence import Packet


class Filter(Protocol):
    """Answers at every frame and remembers its landmarks; a class that derives from it may leave out the log."""

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and return the state at its frame."""

    def landmarks(self) -> Landmarks:
        """Return every landmark the filter ever had, as last known."""

    def log(self) -> tuple[str, ...]:
        """Return the lines that a user should read of the run."""
        return ()


class OnlineOutput:
    """Keeps the estimates of a filter."""

    def __init__(self, filter_: Filter) -> None:
        self._filter = filter_
        self._estimates: list[Estimate] = []

    def step(self, packet: Packet) -> Estimate:
        """Pass the packet on and keep the estimate."""
        self._estimates.append(self._filter.step(packet))
        return self._estimates[-1]

    def finish(self) -> Finished:
        """Return the estimates of every frame and the landmarks as last known."""
        return Finished(Trajectory.of(self._estimates), self._filter.landmarks(), log=self._filter.log())


@dataclass
class LandmarkMemory:
    """Every landmark a filter has had, as last known."""

    points: dict[int, Array] = field(default_factory=dict)

    def remember(self, track_ids: IntArray, points: Array) -> None:
        """Store landmarks (N,) at points (N, 3)."""
        self.points.update(zip(track_ids.tolist(), points, strict=True))

    def landmarks(self) -> Landmarks:
        """Return every landmark, as last known."""
        return Landmarks.of(self.points)
