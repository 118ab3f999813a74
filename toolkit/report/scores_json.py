"""The scores of a comparison as records: ``metrics.json`` for one seed, ``seeds.json`` for many."""

import math
from dataclasses import asdict, fields

import numpy as np
from msgspec import UNSET, UnsetType

from toolkit.experiment.comparison import Comparison, Row
from toolkit.experiment.statistics import Spread
from toolkit.files.documents import Value, of_attributes
from toolkit.metrics import Metric, describe, known_metrics
from toolkit.report.curves import truth_during
from toolkit.report.score_records import (
    AuditEntry,
    ConsistencyMark,
    LogEntry,
    MetricOverSeeds,
    MetricsDocument,
    QuantilesAll,
    RunOverSeeds,
    ScoredRun,
    Seeds,
    SequenceOfSeeds,
    SequenceRead,
    WholeRuns,
)
from toolkit.sequence import Sequence


def metrics_document(comparison: Comparison) -> MetricsDocument:
    """Return the scores of a comparison; a value that is not finite becomes null with a note."""
    return MetricsDocument(
        schema="vislam.metrics/1",
        sequence=_sequence(comparison.sequence),
        audit=tuple(of_attributes(AuditEntry, finding) for finding in comparison.findings),
        undecided=dict(comparison.undecided),
        runs=tuple(_run(row) for row in comparison.rows),
    )


def seeds_document(over: Comparison) -> Seeds:
    """Return the scores of a comparison over seeds."""
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
    """Return the scores of a comparison, of one seed or over many."""
    return seeds_document(comparison) if comparison.over_seeds else metrics_document(comparison)


def path_length_m(sequence: Sequence) -> float | None:
    """Return the length of the true path while the camera ran, or None without truth or frames."""
    if sequence.truth is None or not sequence.frame_count:
        return None
    truth = truth_during(sequence)
    return 0.0 if truth is None else float(np.linalg.norm(np.diff(truth.T_world_imu[:, :3, 3], axis=0), axis=1).sum())


def _sequence(sequence: Sequence) -> SequenceRead:
    return SequenceRead(
        name=sequence.name,
        hash=sequence.content_hash(),
        frames=sequence.frame_count,
        tracks=int(np.unique(sequence.observations.track_id).size),
        observations=len(sequence.observations),
        duration_s=sequence.duration_s,
        path_m=path_length_m(sequence),
        motion=sequence.motion_kind,
    )


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
        consistency=_mark(row),
    )


def _mark(row: Row) -> ConsistencyMark | UnsetType:
    found = row.consistency
    if found is None:
        return UNSET
    return ConsistencyMark(verdict=found.verdict, metric=found.metric, mean=found.mean, band=(found.low, found.high))


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
        consistency=_mark(group),
        ok_share=group.counts["ok"] / len(group.outcomes),
    )


def _metric(group: Row, metric: Metric) -> MetricOverSeeds:
    spread = group.spread(metric.key)
    described = (
        dict.fromkeys((field.name for field in fields(Spread)), None) | {"n": 0} if spread is None else asdict(spread)
    )
    return MetricOverSeeds(
        **described, values=tuple(group.values(metric.key)), quantiles_all=_quantiles_all(group, metric)
    )


def _quantiles_all(group: Row, metric: Metric) -> QuantilesAll | UnsetType:
    found = group.quantiles_of_all(metric)
    if found is None:
        return UNSET
    return QuantilesAll(
        lower_quartile=found.lower_quartile,
        median=found.median,
        upper_quartile=found.upper_quartile,
        reason=found.reason or UNSET,
    )


def _whole_runs(group: Row) -> WholeRuns:
    """Return the RMSE over frames and seeds, not aligned, and the NEES averaged over the seeds at each frame.

    The band is that of the largest number of runs any frame has.
    """
    nees, errors_m = group.mean_nees, group.position_m
    position_rmse_m = None if errors_m is None else float(np.sqrt(np.nanmean(errors_m**2)))
    if nees is None:
        return WholeRuns(
            position_rmse_m=position_rmse_m,
            runs=0,
            nees_pose_band=None,
            nees_pose_in_band_percent=None,
            nees_pose_above_percent=None,
        )
    most = int(nees.runs.argmax())
    return WholeRuns(
        position_rmse_m=position_rmse_m,
        runs=int(nees.runs[most]),
        nees_pose_band=(float(nees.low[most]), float(nees.high[most])),
        nees_pose_in_band_percent=nees.in_band_percent,
        nees_pose_above_percent=nees.too_sure_percent,
    )
