"""The protocol every estimator follows; :mod:`toolkit.registry` finds them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

from toolkit.estimate import Estimate, Finished
from toolkit.geometry import Array
from toolkit.measurements import MotionKind, MotionNoise, Packet, Prior, StereoRig
from toolkit.models.state import Predictor
from toolkit.progress import SILENT, Progress
from toolkit.settings import DEFAULTS, Scalar, Settings

Part = TypeVar("Part")


@dataclass(frozen=True, eq=False)
class Setup:
    """All that an estimator knows before the first packet; ``gravity_world`` (3,) m/s^2.

    ``motion`` predicts by the measured motion and its ``noise``: one model for all estimators.

    ``options`` are the settings of this estimator alone, by name; a long ``finish`` reports to ``progress``.
    """

    rig: StereoRig
    noise: MotionNoise
    prior: Prior
    gravity_world: Array
    motion_kind: MotionKind
    motion: Predictor
    settings: Settings = DEFAULTS
    options: Mapping[str, Scalar] = field(default_factory=dict)
    progress: Progress = SILENT

    def choice(self, option: str, parts: Mapping[Scalar, Part]) -> Part:
        """Return the part for the value that an option has, the first of them where it is not set."""
        return parts[self.options.get(option, next(iter(parts)))]


class Estimator(Protocol):
    """Reads packets in order of time and estimates the state of the IMU."""

    def step(self, packet: Packet) -> Estimate | None:
        """Answer for the packet's frame from the past alone, or return None to answer only at the end."""

    def finish(self) -> Finished:
        """Answer for every frame with all that is known at the end."""


Build = Callable[[Setup], Estimator]
