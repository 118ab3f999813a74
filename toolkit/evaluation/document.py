"""``evaluation.json``, the contract ``vislam.evaluation/1``: scores of trajectory files (docs/evaluate.md).

An entry of ``runs`` is one of ``metrics.json`` with the sequence and the file it is of. The gate takes the document in
the place of a folder of trajectories.
"""

from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, Struct

from toolkit.answers import Status
from toolkit.evaluation.scoring import METRICS
from toolkit.evaluation.standings import Cell, EvaluatedRun, EvaluatedSystems, PairedRecord, Standing
from toolkit.experiment.statistics import QuantilesOfAll
from toolkit.files import documents
from toolkit.files.documents import Count, Value, of_attributes
from toolkit.metrics import Metric

_REMEDY = "make it with vislam evaluate --out"


class TermsRecord(Struct, frozen=True, kw_only=True):
    """How trajectories were scored."""

    max_dt_s: Annotated[float | None, Meta(description="nearest poses no farther apart in time; null: interpolated")]
    offset_s: Annotated[float, Meta(description="added to the stamps of the trajectories")]
    gap_s: Annotated[float, Meta(description="the longest time between two poses that counts as covered", gt=0)]
    level: Annotated[bool, Meta(description="whether the vertical is measured: first poses turn about it alone")]
    least_coverage_percent: Annotated[float, Meta(description="of the time, below which a run counts as failed")]


class SequenceScored(Struct, frozen=True, kw_only=True):
    """The truth of a sequence."""

    sequence: str
    truth: Annotated[str, Meta(description="the truth's file, as it was given")]
    truth_hash: Annotated[str, Meta(description="of the truth's stamps and poses, to nine digits")]
    poses: Count
    duration_s: Annotated[float, Meta(ge=0)]
    path_m: Annotated[float, Meta(ge=0)]


class RunRecord(Struct, frozen=True, kw_only=True):
    """One run of one system."""

    sequence: str
    estimator: Annotated[str, Meta(description="the system's name")]
    run: str
    file: Annotated[str | None, Meta(description="as it was given; null where there is none and ought to be one")]
    output: Literal["final"]
    status: Status
    metrics: Annotated[dict[str, Value], Meta(description="by metric key")]
    notes: Annotated[dict[str, str], Meta(description="by metric key, why there is no value, or a remark on it")]
    log: Annotated[tuple[str, ...], Meta(description="why it failed")]

    def __post_init__(self) -> None:
        for key, value in self.metrics.items():
            if value is None and not self.notes.get(key):
                raise ValueError(f"metrics.{key} is null, and notes does not say why")
        if self.status != "ok" and not self.log:
            raise ValueError(f"status is {self.status}, and log does not say why")


class Quartiles(Struct, frozen=True, kw_only=True):
    """Quartiles in which what failed is infinitely bad; null where that decides one."""

    lower_quartile: float | None
    median: float | None
    upper_quartile: float | None


class OverRuns(Struct, frozen=True, kw_only=True):
    """All runs of a system on a sequence."""

    sequence: str
    estimator: str
    runs: Count
    ok: Count
    metrics: Annotated[dict[str, Quartiles | None], Meta(description="null where runs are ok and none has a value")]


class StandingRecord(Struct, frozen=True, kw_only=True):
    """A system over all sequences, best first."""

    estimator: Annotated[str, Meta(description="the system's name")]
    mean_rank: Annotated[float, Meta(description="over the sequences, by the median over the runs; 1 is the best")]
    wins: Annotated[Count, Meta(description="sequences on which every other system is worse")]
    sequences: Count
    solved: Annotated[Count, Meta(description="sequences with a median over the runs")]
    runs: Count
    ok: Count
    metrics: Annotated[dict[str, Quartiles | None], Meta(description="over the medians of the sequences")]


class EvaluationRecord(Struct, frozen=True, kw_only=True):
    """Every run of every system, and what they say together."""

    schema: Literal["vislam.evaluation/1"]
    terms: TermsRecord
    ranked_by: Annotated[str, Meta(description="key of the metric that ranks and tests")]
    sequences: Annotated[tuple[SequenceScored, ...], Meta(min_length=1)]
    runs: Annotated[tuple[RunRecord, ...], Meta(min_length=1)]
    over_runs: tuple[OverRuns, ...]
    leaderboard: tuple[StandingRecord, ...]
    paired: Annotated[tuple[PairedRecord, ...], Meta(description="every pair of systems; empty for one sequence")]
    notes: tuple[str, ...]

    def __post_init__(self) -> None:
        known = {one.sequence for one in self.sequences}
        for i, run in enumerate(self.runs):
            if run.sequence not in known:
                raise ValueError(f"runs[{i}].sequence is none of sequences")


def evaluation_document(evaluation: EvaluatedSystems) -> EvaluationRecord:
    """Return an evaluation as a record."""
    metrics = evaluation.scored_metrics
    return EvaluationRecord(
        schema="vislam.evaluation/1",
        terms=of_attributes(TermsRecord, evaluation.terms),
        ranked_by=evaluation.ranked_by.key,
        sequences=tuple(
            SequenceScored(
                sequence=name, truth=truth.path.as_posix(), truth_hash=truth.digest, poses=len(truth.poses),
                duration_s=truth.duration_s, path_m=truth.path_m,
            )
            for name, truth in evaluation.truths.items()
        ),
        runs=tuple(map(_run, evaluation.runs)),
        over_runs=tuple(_over_runs(cell, metrics) for cell in evaluation.cells.values()),
        leaderboard=tuple(map(_standing, evaluation.leaderboard)),
        paired=evaluation.paired,
        notes=evaluation.notes,
    )  # fmt: skip


def _run(run: EvaluatedRun) -> RunRecord:
    counts = {metric.key for metric in METRICS if metric.count}
    why = run.log[0] if run.log else ""
    values = {metric.key: run.values.get(metric.key) for metric in METRICS}
    notes = dict.fromkeys(values, why) if not run.values else dict(run.notes)
    return RunRecord(
        sequence=run.item.sequence,
        estimator=run.item.system,
        run=run.item.run,
        file=None if run.item.path is None else run.item.path.as_posix(),
        output="final",
        status=run.status,
        metrics={key: int(v) if v is not None and key in counts else v for key, v in values.items()},
        notes={key: notes[key] for key in sorted(notes)},
        log=run.log,
    )


def _over_runs(cell: Cell, metrics: tuple[Metric, ...]) -> OverRuns:
    quartiles = {metric.key: _quartiles(cell.quantiles(metric)) for metric in metrics}
    return OverRuns(sequence=cell.sequence, estimator=cell.system, runs=len(cell.runs), ok=cell.ok, metrics=quartiles)


def _quartiles(found: QuantilesOfAll | None) -> Quartiles | None:
    return None if found is None else of_attributes(Quartiles, found)


def _standing(standing: Standing) -> StandingRecord:
    metrics = {key: _quartiles(found) for key, found in standing.quantiles.items()}
    return of_attributes(StandingRecord, standing, estimator=standing.system, metrics=metrics)


def read_evaluation(path: Path) -> EvaluationRecord:
    """Read an ``evaluation.json``; raises DataError, in one line with the place, where it is not one."""
    return documents.read(path, EvaluationRecord, remedy=_REMEDY)
