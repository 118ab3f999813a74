"""A baseline: cases, releases, hashes of the measurements, results, and the criteria for "worse"; and its file.

The file is JSON that people can read and review, the values of all seeds of a metric on one line. The contract is
``vislam.baseline/1`` (docs/gate.md). Whatever is wrong with a file is said in one line, with the place.
"""

import dataclasses
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from msgspec import UNSET, Meta, Struct, UnsetType, field, to_builtins

from toolkit.answers import Output, Status
from toolkit.errors import VislamError
from toolkit.files import documents
from toolkit.settings import DEFAULTS, Settings, changes_of
from toolkit.settings.reading import settings_of, without_removed

Worse = Literal["larger", "away from 1"]
Values = tuple[float | None, ...]
Percent = Annotated[float, Meta(ge=0)]
# Another GTSAM may linearise differently, another NumPy draw other numbers; NumPy's patch releases do not.
_DIGITS_THAT_MATTER = {"gtsam": 3, "numpy": 2}


class BaselineError(VislamError):
    """A baseline that cannot be used, with the installed releases or at all."""

    exit_status: ClassVar[int] = 3


class Criterion(Struct, frozen=True):
    """When a metric is worse, and by how many percent it may be.

    For ``away from 1`` it is in percent of the ratio to 1.
    """

    worse: Worse
    percent: Percent

    @property
    def margin(self) -> float:
        """The worsening that is accepted, as a log ratio."""
        return math.log1p(self.percent / 100.0)


class MarginRecord(Criterion, frozen=True):
    """When a metric of simulated sequences is worse."""

    percent: Annotated[Percent, Meta(description="the mean worsening that is tolerated")] = field(name="margin_percent")


class BoundRecord(Criterion, frozen=True):
    """When a metric of a recording is worse."""

    percent: Annotated[Percent, Meta(description="the worsening that a single value must keep below")] = field(
        name="bound_percent"
    )


class BoundsRecord(Struct, frozen=True):
    """What counts as worse."""

    simulated: Annotated[dict[str, MarginRecord], Meta(description="by metric key")]
    recorded: Annotated[dict[str, BoundRecord], Meta(description="by metric key")]
    coverage_points: Annotated[float, Meta(description="percent of the frames that may be lost", ge=0)]
    speed_ratio: Annotated[float, Meta(description="how many times slower a run may become", gt=1)]


# How the numbers were chosen: docs/gate.md.
DEFAULT_BOUNDS = BoundsRecord(
    simulated={
        "ate_se3_m": MarginRecord("larger", 0.5),
        "ate_yaw_m": MarginRecord("larger", 0.5),
        "nees_pose_mean": MarginRecord("away from 1", 1.0),
        "nis_mean": MarginRecord("away from 1", 1.0),
        "heldout_reproj_median_px": MarginRecord("larger", 0.5),
    },
    recorded={
        "ate_se3_m": BoundRecord("larger", 5.0),
        "ate_yaw_m": BoundRecord("larger", 5.0),
        "rpe_100m_percent": BoundRecord("larger", 5.0),
        "nees_pose_mean": BoundRecord("away from 1", 10.0),
        "nis_mean": BoundRecord("away from 1", 10.0),
        "heldout_reproj_median_px": BoundRecord("larger", 2.0),
    },
    coverage_points=1.0,
    speed_ratio=1.3,
)
COVERAGE, SPEED = "coverage_percent", "speed"
# Characters of an entry of a list that stands on one line.
_SHORT = 43
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


MetricValues = Annotated[
    dict[str, Values], Meta(description="by metric key, a value for each seed; null where it was not computed")
]


class SeriesRecord(Struct, frozen=True, kw_only=True):
    """One estimator on one sequence, by seed; an output it does not give is left out."""

    status: tuple[Status, ...]
    speed: Annotated[Values, Meta(description="processor time over that of the reference workload")]
    causal: MetricValues | UnsetType = UNSET
    final: MetricValues | UnsetType = UNSET

    @property
    def outputs(self) -> dict[Output, dict[str, Values]]:
        given: dict[Output, dict[str, Values] | UnsetType] = {"causal": self.causal, "final": self.final}
        return {output: metrics for output, metrics in given.items() if metrics is not UNSET}


@dataclass(frozen=True)
class Measured:
    """The results of a case: hash and fingerprint of what the estimators read by seed, and the series by estimator.

    ``why`` has the reason of an estimator's first run that did not end well. ``absent`` says why an estimator has no
    series, ``unreadable`` why the sequence itself could not be read.
    """

    hashes: tuple[str, ...]
    fingerprints: tuple[str, ...]
    runs: Mapping[str, SeriesRecord]
    absent: Mapping[str, str] = dataclasses.field(default_factory=dict)
    unreadable: str = ""
    why: Mapping[str, str] = dataclasses.field(default_factory=dict)


@dataclass(frozen=True)
class Baseline:
    """Cases with what was measured on them, the releases and settings it was measured with, and what counts as worse.

    ``false_alarm_rate`` is that of all statistical tests of one check together.
    """

    releases: Mapping[str, str]
    cases: tuple[tuple[Case, Measured], ...]
    bounds: BoundsRecord = DEFAULT_BOUNDS
    false_alarm_rate: float = FALSE_ALARM_RATE
    made_by: Mapping[str, str] = dataclasses.field(default_factory=dict)
    settings: Settings = DEFAULTS


def installed_releases() -> dict[str, str]:
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
    return "_".join(f"{name}-{'.'.join(_matters(name, release))}" for name, release in installed_releases().items())


_REMEDY = "make the baseline with vislam baseline"

Seed = Annotated[int, Meta(ge=0)]


class CaseRecord(Struct, frozen=True, kw_only=True):
    """One sequence, on which measurements it was run, and what came of it."""

    source: str
    kind: Literal["simulated", "recorded"]
    duration_s: Annotated[float, Meta(description="how long to simulate, or where to cut", gt=0)] | None
    truth: Annotated[str | None, Meta(description="a file beside the recording")]
    seeds: Annotated[tuple[Seed, ...], Meta(min_length=1)]
    hashes: Annotated[tuple[str, ...], Meta(description="of what was read under each seed")]
    fingerprints: Annotated[tuple[str, ...], Meta(description="the same, rounded to six digits")]
    runs: Annotated[dict[str, SeriesRecord], Meta(description="by estimator", min_length=1)]

    def __post_init__(self) -> None:
        if len(set(self.seeds)) != len(self.seeds):
            raise ValueError("seeds names one twice")
        columns: dict[str, tuple[object, ...]] = {"hashes": self.hashes, "fingerprints": self.fingerprints}
        for name, run in self.runs.items():
            columns |= {f"runs.{name}.status": run.status, f"runs.{name}.speed": run.speed}
            for output, metrics in run.outputs.items():
                for key, values in metrics.items():
                    columns[f"runs.{name}.{output}.{key}"] = values
        for place, column in columns.items():
            if len(column) != len(self.seeds):
                raise ValueError(f"{place} does not have an entry a seed")


class BaselineRecord(Struct, frozen=True, kw_only=True):
    """What was run, with which releases, what came of it, and what counts as worse."""

    schema: Literal["vislam.baseline/1"]
    made_by: Annotated[dict[str, str | int | float], Meta(description="how, when and where it was made")]
    releases: Annotated[dict[str, str], Meta(description="what it was made with and is valid for")]
    false_alarm_rate: Annotated[float, Meta(description="of all statistical tests of a check together", gt=0, lt=1)]
    bounds: BoundsRecord
    sequences: Annotated[tuple[CaseRecord, ...], Meta(min_length=1)]
    settings: (
        Annotated[
            dict[str, Any],
            Meta(description="those of every run that are no defaults; a default that changes is measured"),
        ]
        | UnsetType
    ) = UNSET


def load_baseline(path: Path) -> Baseline:
    """Read a baseline from its file, or from a folder the one made with the releases installed here.

    Raises BaselineError where there is none, or it is not one.
    """
    if path.is_dir():
        return _of_these_releases(path)
    try:
        return from_document(documents.read(path, BaselineRecord, remedy=_REMEDY, error=BaselineError))
    except BaselineError as error:
        if "'vislam.trajectory-baseline/" not in str(error):
            raise
        raise BaselineError(f"{path} is a baseline of trajectories; check it with --trajectories DIR") from error


def _of_these_releases(folder: Path) -> Baseline:
    known = {path: load_baseline(path) for path in sorted(folder.glob("*.json"))}
    fitting = {path: one for path, one in known.items() if not other_releases(one.releases)}
    if len(fitting) == 1:
        return next(iter(fitting.values()))
    here = ", ".join(f"{name} {release}" for name, release in installed_releases().items())
    if not known:
        raise BaselineError(f"{folder}: it holds no baseline (*.json); {_REMEDY}")
    if not fitting:
        raise BaselineError(f"{folder}: none of {len(known)} baselines is for {here}; make one with vislam baseline")
    raise BaselineError(f"{folder}: {', '.join(path.name for path in fitting)} are all for {here}; name one of them")


def check_releases(baseline: Baseline, name: str) -> None:
    """Raise BaselineError where the baseline was made with other releases than are installed."""
    others = other_releases(baseline.releases)
    if others:
        raise BaselineError(
            f"{name}: made with {'; '.join(others)}, which alone may change results; make a baseline with these "
            "releases, or compare all the same with --allow-other-releases"
        )


def to_text(baseline: Baseline) -> str:
    """Return the document; refuses NaN and infinity, which are not JSON."""
    record = documents.of_attributes(
        BaselineRecord,
        baseline,
        schema="vislam.baseline/1",
        settings=changes_of(baseline.settings) or UNSET,
        sequences=tuple(_case_record(case, measured) for case, measured in baseline.cases),
    )
    return json_text(to_builtins(record))


def from_document(record: BaselineRecord) -> Baseline:
    return Baseline(
        record.releases,
        tuple(_case(case) for case in record.sequences),
        record.bounds,
        record.false_alarm_rate,
        {name: str(value) for name, value in record.made_by.items()},
        settings_of({} if record.settings is UNSET else without_removed(record.settings), "the baseline's settings"),
    )


def _case_record(case: Case, measured: Measured) -> CaseRecord:
    of_case = {name: getattr(case, name) for name in ("source", "duration_s", "truth", "seeds")}
    kind: Literal["simulated", "recorded"] = "simulated" if case.simulated else "recorded"
    return documents.of_attributes(CaseRecord, measured, kind=kind, **of_case)


def _case(record: CaseRecord) -> tuple[Case, Measured]:
    simulated, estimators = record.kind == "simulated", tuple(record.runs)
    case = Case(record.source, simulated, record.seeds, estimators, record.duration_s, record.truth)
    return case, Measured(record.hashes, record.fingerprints, record.runs)


def json_text(value: object) -> str:
    """Return JSON for people to review: a list of numbers or of short words is one line."""
    # A line ends behind the bracket of a list alone, never inside a text.
    return re.sub(r"\[\n[^][{}]*\n *\]", _on_one_line, json.dumps(value, indent=2, allow_nan=False)) + "\n"


def _on_one_line(found: "re.Match[str]") -> str:
    entries = [line.strip() for line in found[0][1:-1].splitlines()]
    return f"[{' '.join(entries).strip()}]" if max(map(len, entries), default=0) <= _SHORT else found[0]
