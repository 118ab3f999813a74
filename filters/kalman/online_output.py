"""Makes an estimator of a filter; the final answer is its online output, the estimates given frame by frame."""

from dataclasses import dataclass, field
from typing import Protocol

from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.geometry import Array, IntArray
from toolkit.measurements import Packet


class Filter(Protocol):
    """Answers at every frame and remembers its landmarks."""

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and return the state at its frame."""

    def landmarks(self) -> Landmarks:
        """Return the last estimate of every landmark of the run."""


class OnlineOutput:
    """Keeps the estimates of a filter; ``log`` is said of the run."""

    def __init__(self, filter_: Filter, log: tuple[str, ...] = ()) -> None:
        self._filter, self._log = filter_, log
        self._estimates: list[Estimate] = []

    def step(self, packet: Packet) -> Estimate:
        self._estimates.append(self._filter.step(packet))
        return self._estimates[-1]

    def finish(self) -> Finished:
        return Finished(Trajectory.of(self._estimates), self._filter.landmarks(), log=self._log)


@dataclass
class LandmarkMemory:
    """The last estimate of every landmark a filter has had."""

    points: dict[int, Array] = field(default_factory=dict)

    def remember(self, track_ids: IntArray, points: Array) -> None:
        self.points.update(zip(track_ids.tolist(), points, strict=True))

    def landmarks(self) -> Landmarks:
        return Landmarks.of(self.points)
