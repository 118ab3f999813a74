"""What a windowed filter says beside its estimate: its innovations, and the landmarks it has had."""

from dataclasses import dataclass, field

from toolkit.estimate import Landmarks
from toolkit.geometry import Array, BoolArray, IntArray


@dataclass
class Innovation:
    """The sum of the accepted NIS of a frame, its degrees of freedom, and how many passed the gate.

    ``unconverged`` counts iterated updates that were broken off.
    """

    nis: float = 0.0
    dof: int = 0
    tested: int = 0
    accepted: int = 0
    unconverged: int = 0

    def add(self, nis: Array, dof: IntArray, accepted: BoolArray) -> None:
        """Count N tests."""
        self.nis += float(nis[accepted].sum())
        self.dof += int(dof[accepted].sum())
        self.tested += accepted.size
        self.accepted += int(accepted.sum())

    def info(self) -> dict[str, float]:
        """Return the figures by the names an Estimate's info has."""
        return {
            "nis": self.nis,
            "nis_dof": self.dof,
            "gate_tested": self.tested,
            "gate_accepted": self.accepted,
            "unconverged": self.unconverged,
        }


@dataclass
class LandmarkMemory:
    """Every landmark a filter has had, as last known."""

    points: dict[int, Array] = field(default_factory=dict)

    def remember(self, track_ids: IntArray, points: Array) -> None:
        """Take note of landmarks (N,) at points (N, 3)."""
        self.points.update(zip(track_ids.tolist(), points, strict=True))

    def landmarks(self) -> Landmarks:
        """Return them all."""
        return Landmarks.of(self.points)
