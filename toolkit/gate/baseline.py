"""The content of a baseline: cases, releases, hashes of the measurements, results, and the criteria for "worse"."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import ClassVar, Literal

from toolkit.answers import Output, Status
from toolkit.errors import VislamError
from toolkit.settings import DEFAULTS, Settings

Worse = Literal["larger", "away from 1"]
Values = tuple[float | None, ...]
# Another GTSAM may linearise differently, another NumPy draw other numbers; NumPy's patch releases do not.
_DIGITS_THAT_MATTER = {"gtsam": 3, "numpy": 2}


class BaselineError(VislamError):
    """A baseline that cannot be used, with the installed releases or at all."""

    exit_status: ClassVar[int] = 3


@dataclass(frozen=True)
class Criterion:
    """When a metric is worse, and by how many percent it may be.

    On simulated sequences ``percent`` is a margin: the mean worsening that is accepted. On recorded ones it is the
    bound for the single value. For ``away from 1`` it is in percent of the ratio to 1.
    """

    worse: Worse
    percent: float

    @property
    def margin(self) -> float:
        """The worsening that is accepted, as a log ratio."""
        return math.log1p(self.percent / 100.0)


@dataclass(frozen=True)
class Bounds:
    """Criteria for "worse" by metric, for simulated and for recorded sequences, and limits for all.

    Under any seed a run may lose ``coverage_points`` (percent of the frames) of its coverage, and may become
    ``speed_ratio`` times slower against the reference workload.
    """

    simulated: Mapping[str, Criterion]
    recorded: Mapping[str, Criterion]
    coverage_points: float
    speed_ratio: float


# How the numbers were chosen: docs/gate.md.
DEFAULT_BOUNDS = Bounds(
    simulated={
        "ate_se3_m": Criterion("larger", 0.5),
        "ate_yaw_m": Criterion("larger", 0.5),
        "nees_pose_mean": Criterion("away from 1", 1.0),
        "nis_mean": Criterion("away from 1", 1.0),
        "heldout_reproj_median_px": Criterion("larger", 0.5),
    },
    recorded={
        "ate_se3_m": Criterion("larger", 5.0),
        "ate_yaw_m": Criterion("larger", 5.0),
        "rpe_100m_percent": Criterion("larger", 5.0),
        "nees_pose_mean": Criterion("away from 1", 10.0),
        "nis_mean": Criterion("away from 1", 10.0),
        "heldout_reproj_median_px": Criterion("larger", 2.0),
    },
    coverage_points=1.0,
    speed_ratio=1.3,
)
COVERAGE, SPEED = "coverage_percent", "speed"
# The chance of any false alarm among all statistical tests of one check.
FALSE_ALARM_RATE = 0.05


@dataclass(frozen=True)
class Case:
    """One sequence and what runs on it.

    A ``simulated`` sequence is drawn anew from each of ``seeds``; a recorded one is the same under each, and is run
    once for each. ``duration_s`` is how long to simulate, or where to cut. ``truth`` is a file beside the recording.
    """

    source: str
    simulated: bool
    seeds: tuple[int, ...]
    estimators: tuple[str, ...]
    duration_s: float | None = None
    truth: str | None = None


@dataclass(frozen=True)
class Series:
    """One estimator on one case, by seed: how it ended, its time over the reference's, metrics by kind of output.

    ``why`` is the reason of the first run that did not end well.
    """

    status: tuple[Status, ...]
    speed: Values
    outputs: Mapping[Output, Mapping[str, Values]]
    why: str = ""


@dataclass(frozen=True)
class Measured:
    """The results of a case: hash and fingerprint of what the estimators read by seed, and the series by estimator.

    ``absent`` says why an estimator has no series, ``unreadable`` why the sequence itself could not be read.
    """

    hashes: tuple[str, ...]
    fingerprints: tuple[str, ...]
    runs: Mapping[str, Series]
    absent: Mapping[str, str] = field(default_factory=dict)
    unreadable: str = ""


@dataclass(frozen=True)
class Baseline:
    """Cases with what was measured on them, the releases and settings it was measured with, and what counts as worse.

    ``false_alarm_rate`` is that of all statistical tests of one check together.
    """

    releases: Mapping[str, str]
    cases: tuple[tuple[Case, Measured], ...]
    bounds: Bounds = DEFAULT_BOUNDS
    false_alarm_rate: float = FALSE_ALARM_RATE
    made_by: Mapping[str, str] = field(default_factory=dict)
    settings: Settings = DEFAULTS


def installed_releases() -> dict[str, str]:
    """Return the releases that results depend on, as they are installed."""
    return {name: version(name) for name in _DIGITS_THAT_MATTER}


def other_releases(releases: Mapping[str, str]) -> tuple[str, ...]:
    """Say what here is another release than in a baseline; nothing where all that matters is the same."""
    return tuple(
        f"{name} {releases.get(name, '(not given)')}, here {here}"
        for name, here in installed_releases().items()
        if _matters(name, releases.get(name, "")) != _matters(name, here)
    )


def _matters(name: str, release: str) -> list[str]:
    return release.split(".")[: _DIGITS_THAT_MATTER[name]]


def releases_in_a_name() -> str:
    """Return the installed releases as part of a file name."""
    return "_".join(f"{name}-{'.'.join(_matters(name, release))}" for name, release in installed_releases().items())
