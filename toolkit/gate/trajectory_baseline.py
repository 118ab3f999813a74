"""The baseline for trajectories of another system, and its file.

The contract is ``vislam.trajectory-baseline/1`` (docs/gate.md). It holds the scores of each sequence's runs, never the
trajectories, and the hash of the truth they were scored against.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, Struct, to_builtins

from toolkit.files import documents
from toolkit.gate.baseline import FALSE_ALARM_RATE, BaselineError, Values
from toolkit.gate.baseline_file import MetricValues, Percent, json_text
from toolkit.gate.trajectory_files import TIME_COVERAGE, Align, Scoring

_REMEDY = "make the baseline with vislam baseline --trajectories"
# Growth of an error that is no regression (percent), and loss of time coverage that is accepted (percentage points).
BOUND_PERCENT, COVERAGE_POINTS = 5.0, 2.0


class SequenceRecord(Struct, frozen=True, kw_only=True):
    """The truth of a sequence, and the scores of its runs."""

    sequence: str
    truth: Annotated[str, Meta(description="the truth's file, from where the baseline was made")]
    truth_hash: Annotated[str, Meta(description="of the truth's stamps and poses, to nine digits")]
    files: Annotated[tuple[str, ...], Meta(description="a run each", min_length=1)]
    scores: MetricValues

    def __post_init__(self) -> None:
        for key, values in self.scores.items():
            if len(values) != len(self.files):
                raise ValueError(f"scores.{key} does not have an entry a file")


class TrajectoryBaselineRecord(Struct, frozen=True, kw_only=True):
    """How trajectories are scored, what came of it, and what counts as worse."""

    schema: Literal["vislam.trajectory-baseline/1"]
    made_by: Annotated[dict[str, str], Meta(description="how, when and where it was made")]
    align: Annotated[Align, Meta(description="what is fitted before positions are compared")]
    gap_s: Annotated[float, Meta(description="the longest time between two poses that counts as covered", gt=0)]
    bounds: Annotated[dict[str, Percent], Meta(description="by metric key, the growth in percent that is allowed")]
    coverage_points: Annotated[float, Meta(description="percent of the time that may be lost", ge=0)]
    false_alarm_rate: Annotated[float, Meta(description="of all statistical tests of a check together", gt=0, lt=1)]
    sequences: Annotated[tuple[SequenceRecord, ...], Meta(min_length=1)]

    def __post_init__(self) -> None:
        scored = Scoring(self.align, self.gap_s).metrics
        for key in self.bounds:
            if key not in scored or key == TIME_COVERAGE:
                raise ValueError(f"bounds.{key} is not among what is scored: {', '.join(scored)}")
        for one in self.sequences:
            lacking = [key for key in (*self.bounds, TIME_COVERAGE) if key not in one.scores]
            if lacking:
                raise ValueError(f"{one.sequence} has no scores.{lacking[0]}")


@dataclass(frozen=True)
class ScoredSequence:
    """A sequence: its truth and that one's hash, the files of its runs, and the scores of each by metric."""

    truth: str
    truth_hash: str
    files: tuple[str, ...]
    scores: Mapping[str, Values]


@dataclass(frozen=True)
class TrajectoryBaseline:
    """What was scored and how, by sequence, and what counts as worse; ``bounds`` are in percent, by metric."""

    sequences: Mapping[str, ScoredSequence]
    scoring: Scoring
    bounds: Mapping[str, float]
    coverage_points: float = COVERAGE_POINTS
    false_alarm_rate: float = FALSE_ALARM_RATE
    made_by: Mapping[str, str] = field(default_factory=dict)


def load_trajectory_baseline(path: Path) -> TrajectoryBaseline:
    """Read the file; raises BaselineError where there is none, or it is not one."""
    try:
        record = documents.read(path, TrajectoryBaselineRecord, remedy=_REMEDY, error=BaselineError)
    except BaselineError as error:
        if "'vislam.baseline/" not in str(error):
            raise
        why = "is a baseline of estimators, which are run to check it; leave --trajectories out"
        raise BaselineError(f"{path} {why}") from error
    return TrajectoryBaseline(
        {one.sequence: ScoredSequence(one.truth, one.truth_hash, one.files, one.scores) for one in record.sequences},
        Scoring(record.align, record.gap_s),
        record.bounds,
        record.coverage_points,
        record.false_alarm_rate,
        record.made_by,
    )


def to_text(baseline: TrajectoryBaseline) -> str:
    """Return the file's text, the values of all runs of a metric on one line."""
    record = TrajectoryBaselineRecord(
        schema="vislam.trajectory-baseline/1",
        made_by=dict(baseline.made_by),
        align=baseline.scoring.align,
        gap_s=baseline.scoring.gap_s,
        bounds=dict(baseline.bounds),
        coverage_points=baseline.coverage_points,
        false_alarm_rate=baseline.false_alarm_rate,
        sequences=tuple(
            SequenceRecord(
                sequence=name, truth=one.truth, truth_hash=one.truth_hash, files=one.files, scores=dict(one.scores)
            )
            for name, one in baseline.sequences.items()
        ),
    )
    return json_text(to_builtins(record))
