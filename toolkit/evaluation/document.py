"""``evaluation.json``, the contract ``vislam.evaluation/1``: scores of trajectory files (docs/evaluate.md).

An entry of ``runs`` is one of ``metrics.json`` with the sequence and the file it is of. The gate takes the document in
the place of a folder of trajectories.
"""

from pathlib import Path
from typing import Annotated, Literal

from msgspec import UNSET, Meta, Struct, UnsetType

from toolkit.evaluation.standings import EvaluatedSystems, PairedRecord, Quartiles, RunRecord, StandingRecord
from toolkit.files import documents
from toolkit.files.documents import Count, of_attributes

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


class OverRuns(Struct, frozen=True, kw_only=True):
    """All runs of a system on a sequence."""

    sequence: str
    estimator: str
    runs: Count
    ok: Count
    metrics: Annotated[dict[str, Quartiles | None], Meta(description="null where runs are ok and none has a value")]


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
    figures: Annotated[tuple[str, ...], Meta(description="files in the folder of figures")] | UnsetType = UNSET

    def __post_init__(self) -> None:
        known = {one.sequence for one in self.sequences}
        for i, run in enumerate(self.runs):
            if run.sequence not in known:
                raise ValueError(f"runs[{i}].sequence is none of sequences")


def evaluation_document(evaluation: EvaluatedSystems) -> EvaluationRecord:
    """Return an evaluation as a record."""
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
        runs=evaluation.runs,
        over_runs=tuple(
            OverRuns(
                sequence=cell.sequence, estimator=cell.system, runs=len(cell.runs), ok=cell.ok,
                metrics={metric.key: cell.quantiles(metric) for metric in evaluation.scored_metrics},
            )
            for cell in evaluation.cells.values()
        ),
        leaderboard=evaluation.leaderboard,
        paired=evaluation.paired,
        notes=evaluation.notes,
    )  # fmt: skip


def read_evaluation(path: Path) -> EvaluationRecord:
    """Read an ``evaluation.json``; raises DataError, in one line with the place, where it is not one."""
    return documents.read(path, EvaluationRecord, remedy=_REMEDY)
