"""The scores of estimators: ``metrics.json`` on one sequence, ``seeds.json`` over many seeds (docs/metrics-json.md).

The contracts are ``vislam.metrics/1`` and ``vislam.seeds/1``. First the records of both, then the functions that fill
them from a comparison.
"""

import math
from dataclasses import asdict, fields
from typing import Annotated, Literal

import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType

from toolkit.answers import STATUS_MEANING, Output, Status
from toolkit.experiment.comparison import Comparison, ConsistencyMark, Row
from toolkit.experiment.statistics import QuantilesAll, Spread
from toolkit.files.documents import Count, Value, of_attributes, reader
from toolkit.metrics import CONTRACT_KEYS, Metric, describe, known_metrics
from toolkit.report.curves import truth_during
from toolkit.sequence import Sequence

# What to do about a document of a run directory that cannot be read.
REPEAT = "repeat the comparison"
ALL_PROMISED = Meta(description="by metric key", extra_json_schema={"required": list(CONTRACT_KEYS)})

MotionKind = Literal["twist", "imu", "none"]
Motion = Annotated[MotionKind, Meta(description="body velocities, raw IMU or nothing between the frames")]
Notes = Annotated[dict[str, str], Meta(description="by metric key, why there is no value, or a remark on the value")]


def check_promised(metrics: dict[str, object]) -> None:
    missing = next((key for key in CONTRACT_KEYS if key not in metrics), None)
    if missing is not None:
        raise ValueError(f"metrics.{missing} is missing")


class SequenceRead(Struct, frozen=True, kw_only=True):
    """The sequence as the estimators read it, after the audit's repairs and ``--max-frames``."""

    name: Annotated[str, Meta(description="the sequence's name")]
    hash: Annotated[str, Meta(description="SHA-256 over measurements, calibration, noise, prior and truth")]
    frames: Annotated[Count, Meta(description="camera frames")]
    tracks: Annotated[Count, Meta(description="different tracks, those held out included")]
    observations: Annotated[Count, Meta(description="stereo sightings, those held out included")]
    duration_s: Annotated[float, Meta(description="from the first frame to the last", ge=0)]
    path_m: Annotated[float | None, Meta(description="length of the true path meanwhile; null without truth")]
    motion: Motion


class AuditEntry(Struct, frozen=True, kw_only=True):
    """A fault the audit found in the recording."""

    fault: Annotated[str, Meta(description="its name, as in vislam list")]
    count: Annotated[int, Meta(description="in the fault's own unit, named in detail")]
    repaired: Annotated[bool, Meta(description="whether the estimators read the data without it")]
    detail: Annotated[str, Meta(description="one sentence")]


Undecided = Annotated[dict[str, str] | UnsetType, Meta(description="by fault, why it could not be decided")]


Consistency = Annotated[ConsistencyMark | UnsetType, Meta(description="absent where no NEES, NIS or trend decides")]


class ScoredRun(Struct, frozen=True, kw_only=True):
    """One kind of output of one estimator."""

    estimator: Annotated[str, Meta(description="its name, as in vislam list, or what was read from a file")]
    output: Annotated[Output, Meta(description="what it estimated at each frame, or from the whole recording")]
    status: Annotated[Status, Meta(description="; ".join(STATUS_MEANING.values()))]
    metrics: Annotated[dict[str, Value], ALL_PROMISED]
    notes: Notes
    log: Annotated[tuple[str, ...], Meta(description="what the estimator had to recover from")]
    consistency: Consistency = UNSET

    def __post_init__(self) -> None:
        check_promised(dict(self.metrics))
        for key, value in self.metrics.items():
            if value is None and not self.notes.get(key):
                raise ValueError(f"metrics.{key} is null, and notes does not say why")


class MetricsDocument(Struct, frozen=True, kw_only=True):
    """Every estimator's scores on one sequence."""

    schema: Literal["vislam.metrics/1"]
    sequence: SequenceRead
    audit: Annotated[tuple[AuditEntry, ...], Meta(description="in the order checked; empty for a clean recording")]
    undecided: Undecided = UNSET
    runs: Annotated[tuple[ScoredRun, ...], Meta(description="by estimator, causal before final")]


class SequenceOfSeeds(Struct, frozen=True, kw_only=True):
    """What the recordings of all seeds have in common."""

    name: Annotated[str, Meta(description="the sequence's name")]
    source: Annotated[str, Meta(description="as it was requested")]
    frames: Annotated[Count, Meta(description="camera frames")]
    duration_s: Annotated[float, Meta(description="from the first frame to the last", ge=0)]
    motion: Motion


class MetricOverSeeds(Struct, frozen=True, kw_only=True):
    """One metric: its spread over the runs that are ok, null where there are none, and its value under each seed."""

    n: Annotated[Count, Meta(description="how many runs that are ok have a value")]
    mean: float | None
    median: float | None
    std: Annotated[float | None, Meta(description="with n - 1 in its divisor; null for a single value")]
    least: float | None
    lower_quartile: float | None
    upper_quartile: float | None
    most: float | None
    values: Annotated[tuple[Value, ...], Meta(description="one a seed, whatever the run's status")]
    quantiles_all: Annotated[QuantilesAll | UnsetType, Meta(description="absent where no value is best or had")] = UNSET


class WholeRuns(Struct, frozen=True, kw_only=True):
    """What is taken over frames and seeds together; of the pose NEES, over 6, its mean over the seeds at each frame."""

    position_rmse_m: Annotated[float | None, Meta(description="root mean square over frames and seeds, not aligned")]
    runs: Annotated[Count, Meta(description="the most runs that have a NEES at one frame")]
    nees_pose_band: Annotated[tuple[float, float] | None, Meta(description="95 % band of the mean over the runs")]
    nees_pose_in_band_percent: Annotated[float | None, Meta(description="share of the frames within their band")]
    nees_pose_above_percent: Annotated[float | None, Meta(description="share of the frames above their band")]


class RunOverSeeds(Struct, frozen=True, kw_only=True):
    """One kind of output of one estimator under all seeds."""

    estimator: Annotated[str, Meta(description="its name, as in vislam list")]
    output: Annotated[Output, Meta(description="what it estimated at each frame, or from the whole recording")]
    change: Annotated[str | UnsetType, Meta(description="on a ladder: what it changes against the rung before")] = UNSET
    status: Annotated[tuple[Status, ...], Meta(description="one a seed")]
    counts: Annotated[dict[Status, Count], Meta(description="how many seeds ended each way")]
    metrics: Annotated[dict[str, MetricOverSeeds], ALL_PROMISED]
    notes: Notes
    over_seeds: WholeRuns
    consistency: Consistency = UNSET
    ok_share: Annotated[float, Meta(description="of the seeds, from 0 to 1", ge=0, le=1)] | UnsetType = UNSET

    def __post_init__(self) -> None:
        check_promised(dict(self.metrics))
        if self.counts != {status: self.status.count(status) for status in STATUS_MEANING}:
            raise ValueError("counts does not count status")
        for key, metric in self.metrics.items():
            if len(metric.values) != len(self.status):
                raise ValueError(f"metrics.{key}.values does not have an entry a seed")
            if metric.n == 0 and not self.notes.get(key):
                raise ValueError(f"metrics.{key} has no value, and notes does not say why")
            given = zip(self.status, metric.values, strict=True)
            known = sum(status == "ok" and value is not None for status, value in given)
            if (metric.n, metric.mean is None, metric.std is None) != (known, known == 0, known < 2):
                raise ValueError(f"metrics.{key}: n, mean and std are not those of {known} values")


class LogEntry(Struct, frozen=True, kw_only=True):
    """What one run had to say."""

    estimator: str
    seed: int
    status: Status
    log: Annotated[tuple[str, ...], Meta(description="what the estimator had to recover from")]


class Seeds(Struct, frozen=True, kw_only=True):
    """Every estimator's scores over many seeds of one sequence."""

    schema: Literal["vislam.seeds/1"]
    sequence: SequenceOfSeeds
    seeds: Annotated[tuple[int, ...], Meta(description="in order")]
    hashes: Annotated[tuple[str | None, ...], Meta(description="of what was read, by seed; null where all runs died")]
    start: Annotated[str, Meta(description="where every run started")]
    estimators: Annotated[tuple[str, ...], Meta(description="in order")]
    runs: Annotated[tuple[RunOverSeeds, ...], Meta(description="by estimator, causal before final")]
    log: Annotated[tuple[LogEntry, ...], Meta(description="every run that has log lines")]

    def __post_init__(self) -> None:
        if {len(self.seeds)} != {len(self.hashes), *(len(run.status) for run in self.runs)}:
            raise ValueError("hashes does not have an entry a seed, or status of a run")


read_metrics = reader(MetricsDocument, REPEAT)
read_seeds = reader(Seeds, REPEAT)


def metrics_document(comparison: Comparison) -> MetricsDocument:
    """Return the scores of a comparison; a value that is not finite becomes null with a note."""
    sequence = comparison.sequence
    return MetricsDocument(
        schema="vislam.metrics/1",
        sequence=SequenceRead(
            name=sequence.name,
            hash=sequence.content_hash(),
            frames=sequence.frame_count,
            tracks=int(np.unique(sequence.observations.track_id).size),
            observations=len(sequence.observations),
            duration_s=sequence.duration_s,
            path_m=path_length_m(sequence),
            motion=sequence.motion_kind,
        ),
        audit=tuple(of_attributes(AuditEntry, finding) for finding in comparison.findings),
        undecided=dict(comparison.undecided),
        runs=tuple(_run(row) for row in comparison.rows),
    )


def seeds_document(over: Comparison) -> Seeds:
    return Seeds(
        schema="vislam.seeds/1",
        sequence=SequenceOfSeeds(
            name=over.name,
            source=over.source,
            frames=over.sequence.frame_count,
            duration_s=over.sequence.duration_s,
            motion=over.sequence.motion_kind,
        ),
        seeds=over.seeds,
        hashes=over.hashes,
        start=over.prior.source,
        estimators=over.estimators,
        runs=tuple(_run_over_seeds(group, over) for group in over.rows),
        log=tuple(of_attributes(LogEntry, outcome) for outcome in over.outcomes if outcome.log),
    )


def scores_document(comparison: Comparison) -> MetricsDocument | Seeds:
    return seeds_document(comparison) if comparison.over_seeds else metrics_document(comparison)


def path_length_m(sequence: Sequence) -> float | None:
    """Return the length of the true path while the camera ran, or None without truth or frames."""
    if sequence.truth is None or not sequence.frame_count:
        return None
    truth = truth_during(sequence)
    return 0.0 if truth is None else float(np.linalg.norm(np.diff(truth.T_world_imu[:, :3, 3], axis=0), axis=1).sum())


def _run(row: Row) -> ScoredRun:
    given, notes = row.scores.values, dict(row.scores.notes)
    known, counts = describe(), {metric.key for metric in known_metrics() if metric.count}
    metrics: dict[str, Value] = {}
    for key in (*known, *sorted(given.keys() - known.keys())):
        value = given.get(key)
        if value is None:
            metrics[key] = None
            notes.setdefault(key, "not computed")
        elif not math.isfinite(value):
            metrics[key] = None
            notes[key] = f"the value is {value}, which JSON cannot hold"
        else:
            metrics[key] = int(value) if key in counts else float(value)
    return ScoredRun(
        estimator=row.estimator,
        output=row.output,
        status=row.status,
        metrics=metrics,
        notes={key: notes[key] for key in sorted(notes)},
        log=tuple(row.run.log),
        consistency=row.consistency or UNSET,
    )


def _run_over_seeds(group: Row, over: Comparison) -> RunOverSeeds:
    metrics = known_metrics()
    return RunOverSeeds(
        estimator=group.estimator,
        output=group.output,
        change=over.changes.get(group.estimator, UNSET),
        status=tuple(outcome.status for outcome in group.outcomes),
        counts=dict(group.counts),
        metrics={metric.key: _metric(group, metric) for metric in metrics},
        notes={metric.key: group.reason(metric.key) for metric in metrics if group.spread(metric.key) is None},
        over_seeds=_whole_runs(group),
        consistency=group.consistency or UNSET,
        ok_share=group.counts["ok"] / len(group.outcomes),
    )


def _metric(group: Row, metric: Metric) -> MetricOverSeeds:
    spread = group.spread(metric.key)
    described = (
        dict.fromkeys((field.name for field in fields(Spread)), None) | {"n": 0} if spread is None else asdict(spread)
    )
    found = group.quantiles_of_all(metric)
    of_all = UNSET if found is None else found
    return MetricOverSeeds(**described, values=tuple(group.values(metric.key)), quantiles_all=of_all)


def _whole_runs(group: Row) -> WholeRuns:
    """Return the RMSE over frames and seeds, not aligned, and the NEES averaged over the seeds at each frame.

    The band is that of the largest number of runs any frame has.
    """
    nees, errors_m = group.mean_nees, group.position_m
    position_rmse_m = None if errors_m is None else float(np.sqrt(np.nanmean(errors_m**2)))
    most = 0 if nees is None else int(nees.runs.argmax())
    return WholeRuns(
        position_rmse_m=position_rmse_m,
        runs=0 if nees is None else int(nees.runs[most]),
        nees_pose_band=None if nees is None else (float(nees.low[most]), float(nees.high[most])),
        nees_pose_in_band_percent=None if nees is None else nees.in_band_percent,
        nees_pose_above_percent=None if nees is None else nees.too_sure_percent,
    )
