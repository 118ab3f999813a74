"""``report.json``, the contract ``vislam.report/1``: what a report draws and says beyond the scores (docs/report.md).

It has two forms: of a comparison, and of one over seeds. First the records of both, then the functions that fill them.
Times ``t_s`` count from the first frame; numbers have six digits; a value that is not finite is null.
"""

from typing import Annotated, Literal

import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType, convert

from toolkit.answers import Output
from toolkit.experiment.comparison import Comparison, Row
from toolkit.files.documents import number, numbers, of_attributes, reader, rounded
from toolkit.files.writing import plain_name
from toolkit.report import curves, messages
from toolkit.report.card import CardRecord, card_record
from toolkit.report.headers import header_lines, noise_line, sequence_line
from toolkit.report.scores import REPEAT, Undecided

TRUTH_FILE = "trajectories/truth.tum"
Vector = tuple[float, float, float]


class DrawnRun(Struct, frozen=True, kw_only=True):
    """One kind of output of one estimator, in the order of metrics.json."""

    estimator: str
    output: Output
    repeats_causal: Annotated[bool, Meta(description="this final answer is the causal one, which has its own entry")]
    trajectory: Annotated[str | None, Meta(description="its TUM file in the run directory")]
    rotation: Annotated[tuple[Vector, Vector, Vector], Meta(description="of its alignment, rows")]
    translation_m: Annotated[Vector, Meta(description="rotation times a position plus this is in the truth's world")]
    errors: Annotated[
        curves.ErrorSeries | None, Meta(description="null where there are none, or with the causal entry")
    ]
    nees: Annotated[curves.NeesSeries | str, Meta(description="or why there is none")]
    nis: Annotated[curves.NisSeries | str, Meta(description="or why there is none")]
    components: Annotated[
        curves.ComponentSeries | UnsetType, Meta(description="absent where none, or with the causal entry")
    ] = UNSET


class StepTimes(curves.Columns, frozen=True, kw_only=True):
    """The wall clock of an estimator's steps."""

    estimator: str
    t_s: curves.Times
    step_ms: curves.Numbers
    finish_s: float | None


class DrawnMap(Struct, frozen=True, kw_only=True):
    """Where an estimator's landmarks are."""

    estimator: str
    landmarks: Annotated[str, Meta(description="their file in the run directory")]
    output: Annotated[Output, Meta(description="with whose alignment they move")]


class AuditMessage(Struct, frozen=True, kw_only=True):
    """A fault of the recording and what became of it."""

    fault: str
    count: int
    outcome: str
    detail: str


VerdictText = Annotated[str, Meta(description="in words; absent before it was added")] | UnsetType
Contests = Annotated[tuple[messages.ContestRecord, ...] | UnsetType, Meta(description="who wins, or that nobody does")]


class Messages(Struct, frozen=True, kw_only=True):
    """What the report says."""

    sequence: Annotated[str, Meta(description="the recording in a line")]
    verdict: VerdictText = UNSET
    notes: tuple[str, ...]
    remarks: tuple[str, ...]
    start: str
    audit: tuple[AuditMessage, ...]
    undecided: Undecided = UNSET
    facts: tuple[str, ...]
    changes: Annotated[dict[str, str], Meta(description="on a ladder, what each rung changes")]


class Report(Struct, frozen=True, kw_only=True):
    """What the report of a comparison draws and says."""

    schema: Literal["vislam.report/1"]
    start_ns: Annotated[int, Meta(description="stamp of the first frame")]
    truth: Annotated[str | None, Meta(description="the truth while the camera ran, a TUM file in the run directory")]
    alignment: Annotated[str, Meta(description="in words, how estimates are laid over the truth")]
    error: Annotated[curves.ErrorKind | None, Meta(description="null where there are no errors")]
    runs: Annotated[tuple[DrawnRun, ...], Meta(description="one for each of metrics.json, in its order")]
    steps: tuple[StepTimes, ...]
    maps: tuple[DrawnMap, ...]
    words: Messages
    card: Annotated[CardRecord | UnsetType, Meta(description="of the recording's tracks, where requested")] = UNSET
    contests: Contests = UNSET


class MeanNeesSeries(curves.Columns, frozen=True, kw_only=True):
    """Pose NEES over 6, averaged over the seeds, with its 95 % band for as many runs."""

    pose: curves.Numbers
    low: curves.Numbers
    high: curves.Numbers


class DrawnOverSeeds(Struct, frozen=True, kw_only=True):
    """One kind of output of one estimator, in the order of seeds.json; its series are over the frames."""

    estimator: str
    output: Output
    nees: MeanNeesSeries | None
    position_rms_m: Annotated[curves.Numbers | None, Meta(description="RMS over the seeds, from the common start")]


class SeedsMessages(Struct, frozen=True, kw_only=True):
    """What the report over seeds says."""

    sequence: Annotated[str, Meta(description="the recording and the seeds in a line")]
    verdict: VerdictText = UNSET
    notes: tuple[str, ...]
    verdicts: Annotated[tuple[str, ...], Meta(description="which estimators are overconfident")]
    start: str


class SeedsReport(Struct, frozen=True, kw_only=True):
    """What the report of a comparison over seeds draws and says."""

    schema: Literal["vislam.report/1"]
    t_s: Annotated[curves.Times, Meta(description="of the frames")]
    runs: Annotated[tuple[DrawnOverSeeds, ...], Meta(description="one for each of seeds.json, in its order")]
    words: SeedsMessages
    contests: Contests = UNSET

    def __post_init__(self) -> None:
        for i, run in enumerate(self.runs):
            nees = {} if run.nees is None else {f"runs[{i}].nees.pose": run.nees.pose}
            errors = {} if run.position_rms_m is None else {f"runs[{i}].position_rms_m": run.position_rms_m}
            curves.check_lengths({"t_s": self.t_s, **nees, **errors})


read_report = reader(Report, REPEAT)
read_seeds_report = reader(SeedsReport, REPEAT)


_FILES = {"trajectory": "trajectories/{}_{}.tum", "states": "states/{}_{}.txt", "landmarks": "landmarks/{}.csv"}


def file_of(kind: Literal["trajectory", "states", "landmarks"], estimator: str, output: Output = "final") -> str:
    """Return where in a run directory an output's trajectory or its covariances are, or an estimator's landmarks."""
    return _FILES[kind].format(plain_name(estimator), output)


def report_document(comparison: Comparison) -> Report:
    kind, errors = curves.error_curves(comparison)
    return Report(
        schema="vislam.report/1",
        start_ns=int(comparison.sequence.frames_t_ns[0]),
        truth=None if curves.truth_during(comparison.sequence) is None else TRUTH_FILE,
        alignment=curves.alignment_text(comparison.sequence),
        error=kind,
        runs=tuple(_row(row, comparison, errors.get(row)) for row in comparison.rows),
        steps=tuple(
            StepTimes(
                estimator=run.estimator,
                t_s=curves.seconds(comparison.sequence, comparison.sequence.frames_t_ns[: run.timings.step_s.size]),
                step_ms=numbers(1e3 * run.timings.step_s),
                finish_s=number(run.timings.finish_s),
            )
            for run in comparison.runs
            if run.timings is not None and run.timings.step_s.size
        ),
        maps=tuple(
            DrawnMap(
                estimator=run.estimator, landmarks=file_of("landmarks", run.estimator), output=curves.shown_output(run)
            )
            for run in comparison.runs
            if len(run.landmarks)
        ),
        words=Messages(
            sequence=f"{sequence_line(comparison.sequence)}; {noise_line(comparison)}",
            verdict=messages.verdict(comparison),
            notes=tuple(messages.note_lines(comparison)),
            remarks=tuple(messages.remark_lines(comparison)),
            start=comparison.prior.source,
            audit=tuple(of_attributes(AuditMessage, one, outcome=messages.outcome(one)) for one in comparison.findings),
            undecided=dict(comparison.undecided),
            facts=comparison.sequence.provenance.facts,
            changes=dict(comparison.changes),
        ),
        card=UNSET if comparison.card is None else card_record(comparison.card),
        contests=tuple(messages.contest_record(one) for one in comparison.contests),
    )


def seeds_report_document(over: Comparison) -> SeedsReport:
    return SeedsReport(
        schema="vislam.report/1",
        t_s=tuple(map(rounded, over.sequence.frames_s.tolist())),
        runs=tuple(_over_seeds(group) for group in over.rows),
        words=SeedsMessages(
            sequence="; ".join(header_lines(over)),
            verdict=messages.verdict(over),
            notes=tuple(messages.note_lines(over)),
            verdicts=tuple(messages.consistency_lines(over)),
            start=over.prior.source,
        ),
        contests=tuple(messages.contest_record(one) for one in over.contests),
    )


def _row(row: Row, comparison: Comparison, errors: curves.ErrorSeries | None) -> DrawnRun:
    answered = row.run.trajectory(row.output) is not None
    alignment = curves.onto_truth(row.run, row.output, comparison.sequence) if answered else curves.NOT_ALIGNED
    return DrawnRun(
        estimator=row.estimator,
        output=row.output,
        repeats_causal=row.output == "final" and row.run.final_is_causal,
        trajectory=file_of("trajectory", row.estimator, row.output) if answered else None,
        rotation=convert(alignment.rotation.tolist(), tuple[Vector, Vector, Vector]),
        translation_m=convert(alignment.translation.tolist(), Vector),
        errors=errors,
        nees=curves.computed_or_reason(curves.nees_series, row.run, row.output, comparison.sequence),
        nis=curves.computed_or_reason(curves.nis_series, row.run, row.output, comparison.sequence),
        components=(None if row.repeats_causal else curves.components(comparison, row)) or UNSET,
    )


def _over_seeds(group: Row) -> DrawnOverSeeds:
    nees, errors_m = group.mean_nees, group.position_m
    known_m = None if errors_m is None else np.ma.masked_invalid(errors_m)
    rms_m = None if known_m is None else np.sqrt((known_m * known_m).mean(axis=0))
    return DrawnOverSeeds(
        estimator=group.estimator,
        output=group.output,
        nees=None if nees is None else of_attributes(MeanNeesSeries, nees, numbers, pose=numbers(nees.mean)),
        position_rms_m=None if rms_m is None else numbers(rms_m.filled(np.nan)),
    )
