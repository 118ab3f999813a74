"""What a line of ``outcomes.jsonl`` holds: one outcome, exactly, and all that it depends on (docs/scaling.md)."""

import math
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct

from toolkit.estimate import Arithmetic, Output, Status
from toolkit.experiment.units import Outcome, Scored
from toolkit.geometry import Array
from toolkit.metrics import Scores, repeated, without_requests

# JSON has no word for these; null stands for NaN.
Infinite = Literal["inf", "-inf"]
Number = float | Infinite | None
Series = Annotated[tuple[Number, ...], Meta(description="one a frame; null where unknown")]


class UnitKey(Struct, frozen=True, kw_only=True):
    """All that an outcome depends on: equal keys give equal outcomes, but for the times."""

    data: Annotated[str, Meta(description="SHA-256 of the recording as it is read under seed 0")]
    seed: int
    estimator: str
    settings: Annotated[dict[str, Any], Meta(description="those that reach a run of this estimator")]
    keep: Annotated[tuple[str, ...], Meta(description="faults that are not repaired")]
    code: Annotated[str, Meta(description="SHA-256 of the toolkit's code and of the estimators'")]
    versions: Annotated[dict[str, str], Meta(description="of Python and of the packages that compute")]

    def text(self) -> bytes:
        """Return the key in one form, for a mapping."""
        return msgspec.json.encode(self, order="deterministic")


class ScoredRecord(Struct, frozen=True, kw_only=True):
    """One output's scores and series."""

    values: dict[str, int | float | None]
    notes: dict[str, str]
    nees_pose: Series
    position_m: Series
    nis_dof: Number


class OutcomeRecord(Struct, frozen=True, kw_only=True, tag_field="schema", tag="vislam.outcome/1"):
    """An outcome. A final output that only repeats the causal one is not there."""

    unit: UnitKey
    requested: Annotated[tuple[str, ...], Meta(description="metrics on request that were computed")]
    status: Status
    sequence_hash: Annotated[str, Meta(description="SHA-256 of the recording it read")]
    final_is_causal: bool
    outputs: dict[Output, ScoredRecord]
    files: Annotated[dict[str, str], Meta(description="SHA-256 of its trajectories by their relative paths")]
    log: tuple[str, ...]
    arithmetic: Annotated[Arithmetic | None, Meta(description="of an estimator that has both")] = None


class FilesRecord(Struct, frozen=True, kw_only=True, tag_field="schema", tag="vislam.outcome-files/1"):
    """Files that are written next, so that they are known as ours whatever happens then."""

    files: tuple[str, ...]


def record_of(outcome: Outcome, unit: UnitKey, requested: tuple[str, ...], files: dict[str, str]) -> OutcomeRecord:
    """Return an outcome as a line holds it, with its trajectory files; the run itself is left out."""
    repeats = outcome.final_is_causal
    return OutcomeRecord(
        unit=unit,
        requested=requested,
        status=outcome.status,
        sequence_hash=outcome.sequence_hash,
        final_is_causal=repeats,
        outputs={k: _scored_record(v) for k, v in outcome.outputs.items() if not (repeats and k == "final")},
        files=files,
        log=outcome.log,
        arithmetic=outcome.arithmetic,
    )


def outcome_of_record(record: OutcomeRecord, requested: tuple[str, ...]) -> Outcome:
    """Return the outcome of a line to the bit, without metrics on request that are not ``requested``."""
    outputs = {output: _scored(one, requested) for output, one in record.outputs.items()}
    if record.final_is_causal:
        causal = outputs["causal"]
        final = Scored(repeated(causal.scores), causal.nees_pose, causal.position_m, causal.nis_dof)
        outputs = {"causal": causal, "final": final}
    return Outcome(
        seed=record.unit.seed,
        estimator=record.unit.estimator,
        status=record.status,
        outputs=outputs,
        log=record.log,
        sequence_hash=record.sequence_hash,
        final_is_causal=record.final_is_causal,
        files=record.files,
        arithmetic=record.arithmetic,
    )


def _scored_record(scored: Scored) -> ScoredRecord:
    return ScoredRecord(
        values={key: _plain(value) for key, value in scored.scores.values.items()},
        notes=dict(scored.scores.notes),
        nees_pose=_numbers(scored.nees_pose),
        position_m=_numbers(scored.position_m),
        nis_dof=None if scored.nis_dof is None else _number(float(scored.nis_dof)),
    )


def _plain(value: float | None) -> float | None:
    """Return a number of NumPy's as Python's, whole ones whole."""
    return value.item() if isinstance(value, np.generic) else value


def _scored(record: ScoredRecord, requested: tuple[str, ...]) -> Scored:
    scores = without_requests(Scores(dict(record.values), dict(record.notes)), requested)
    nis_dof = None if record.nis_dof is None else float(record.nis_dof)
    return Scored(scores, _series(record.nees_pose), _series(record.position_m), nis_dof)


def _numbers(values: Array) -> tuple[Number, ...]:
    return tuple(_number(value) for value in values.tolist())


def _number(value: float) -> Number:
    if math.isfinite(value):
        return value
    return None if math.isnan(value) else "inf" if value > 0.0 else "-inf"


def _series(numbers: tuple[Number, ...]) -> Array:
    return np.array([math.nan if number is None else float(number) for number in numbers], dtype=float)
