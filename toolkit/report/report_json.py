"""What a report draws and says beyond the scores, as a record: ``report.json``, of one seed or over many."""

from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np
from msgspec import UNSET, UnsetType

from toolkit.estimate import Output, Run
from toolkit.experiment.comparison import Comparison, Row, plain_name
from toolkit.experiment.contests import Contest
from toolkit.files.documents import number, numbers, of_attributes, rounded
from toolkit.geometry import Array
from toolkit.metrics import Evaluation
from toolkit.metrics.parts.consistency import POSE_DOF, nees_band, nees_over_time, nis_over_time
from toolkit.metrics.parts.scores import Unavailable
from toolkit.report.card import card_record
from toolkit.report.comparison_table import header_lines, noise_line, sequence_line
from toolkit.report.curves import (
    ErrorCurves,
    Errors,
    alignment_text,
    components,
    error_curves,
    onto_truth,
    seconds,
    shown_output,
    truth_during,
)
from toolkit.report.messages import (
    consistency_lines,
    note_lines,
    outcome,
    paired_lines,
    remark_lines,
)
from toolkit.report.records import (
    AuditMessage,
    CameraFrame,
    ComponentSeries,
    ContestRecord,
    DrawnMap,
    DrawnOverSeeds,
    DrawnRun,
    ErrorKind,
    ErrorSeries,
    MeanNeesSeries,
    Messages,
    NeesSeries,
    NisSeries,
    Report,
    Rival,
    SeedsMessages,
    SeedsReport,
    StepTimes,
    Vector,
)
from toolkit.report.verdict import verdict
from toolkit.sequence import Sequence

TRUTH_FILE = "trajectories/truth.tum"


Series = TypeVar("Series", NeesSeries, NisSeries)


def trajectory_file(estimator: str, output: Output) -> str:
    """Return where in a run directory the trajectory of an estimator's output is."""
    return f"trajectories/{plain_name(estimator)}_{output}.tum"


def landmarks_file(estimator: str) -> str:
    """Return where in a run directory the landmarks of an estimator are."""
    return f"landmarks/{plain_name(estimator)}.csv"


def report_document(comparison: Comparison, frames: tuple[CameraFrame, ...] = ()) -> Report:
    """Return what the report of a comparison draws and says, with some images' tracks; not finite becomes null."""
    curves = error_curves(comparison)
    return Report(
        schema="vislam.report/1",
        start_ns=int(comparison.sequence.frames_t_ns[0]),
        truth=None if truth_during(comparison.sequence) is None else TRUTH_FILE,
        alignment=alignment_text(comparison.sequence),
        error=None if curves is None else of_attributes(ErrorKind, curves),
        runs=tuple(_row(row, comparison, _curve_of(row, curves)) for row in comparison.rows),
        steps=tuple(_steps(comparison)),
        maps=tuple(_map(run) for run in comparison.runs if len(run.landmarks)),
        words=_messages(comparison),
        card=UNSET if comparison.card is None else card_record(comparison.card),
        frames=frames or UNSET,
        contests=tuple(_contest(one) for one in comparison.contests),
    )


def seeds_report_document(over: Comparison) -> SeedsReport:
    """Return what the report over seeds draws and says; its runs are those of seeds.json, in its order."""
    return SeedsReport(
        schema="vislam.report/1",
        t_s=tuple(map(rounded, over.sequence.frames_s.tolist())),
        runs=tuple(_over_seeds(group) for group in over.rows),
        words=SeedsMessages(
            sequence="; ".join(header_lines(over)),
            verdict=verdict(over),
            pairs=tuple(paired_lines(over)),
            notes=tuple(note_lines(over)),
            verdicts=tuple(consistency_lines(over)),
            start=over.prior.source,
        ),
        contests=tuple(_contest(one) for one in over.contests),
    )


def _contest(contest: Contest) -> ContestRecord:
    found = (None, *contest.advantages)
    return ContestRecord(
        question=contest.question,
        metric=contest.metric,
        by=next((one.parts for one in contest.advantages if one is not None), "nothing: too few data"),
        rivals=tuple(
            Rival(
                estimator=row.estimator,
                output=row.output,
                value=row.value(contest.metric) or 0.0,
                ratio=None if one is None else rounded(one.ratio),
                interval=None if one is None else (rounded(one.low), rounded(one.high)),
            )
            for row, one in zip(contest.rows, found, strict=True)
        ),
        leaders=tuple(row.estimator for row in contest.leaders),
        winner=None if contest.winner is None else contest.winner.estimator,
    )


def _curve_of(row: Row, curves: ErrorCurves | None) -> Errors | None:
    """Return a row's errors; where causal and final agree they were computed once and stand with the causal row."""
    output = "causal" if row.run.final_is_causal else row.output
    if curves is None or output != row.output:
        return None
    return next((errors for other, errors in curves.of_rows if _same_line(row, other)), None)


def _same_line(row: Row, other: Row) -> bool:
    return row.run is other.run and (row.run.final_is_causal or row.output == other.output)


def _messages(comparison: Comparison) -> Messages:
    return Messages(
        sequence=f"{sequence_line(comparison.sequence)}; {noise_line(comparison)}",
        verdict=verdict(comparison),
        notes=tuple(note_lines(comparison)),
        remarks=tuple(remark_lines(comparison)),
        start=comparison.prior.source,
        audit=tuple(
            AuditMessage(fault=f.fault, count=f.count, outcome=outcome(f), detail=f.detail) for f in comparison.findings
        ),
        undecided=dict(comparison.undecided),
        facts=comparison.sequence.provenance.facts,
        changes=dict(comparison.changes),
    )


def _row(row: Row, comparison: Comparison, errors: Errors | None) -> DrawnRun:
    answered = row.run.trajectory(row.output) is not None
    alignment = onto_truth(row.run, row.output, comparison.sequence) if answered else None
    rotation = np.eye(3) if alignment is None else alignment.rotation
    translation_m = np.zeros(3) if alignment is None else alignment.translation
    return DrawnRun(
        estimator=row.estimator,
        output=row.output,
        repeats_causal=row.output == "final" and row.run.final_is_causal,
        trajectory=trajectory_file(row.estimator, row.output) if answered else None,
        rotation=(_vector(rotation[0]), _vector(rotation[1]), _vector(rotation[2])),
        translation_m=_vector(translation_m),
        errors=None if errors is None else _errors(errors, comparison.sequence),
        nees=_series_or_reason(_nees, row, comparison),
        nis=_series_or_reason(_nis, row, comparison),
        components=UNSET if row.repeats_causal else _components(row, comparison),
    )


def _vector(values: Array) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


def _errors(errors: Errors, sequence: Sequence) -> ErrorSeries:
    return ErrorSeries(
        t_s=seconds(sequence, errors.t_ns),
        path_m=numbers(errors.path_m),
        position_m=numbers(errors.position_m),
        heading_deg=numbers(errors.heading_deg),
    )


def _series_or_reason(series: Callable[[Row, Comparison], Series], row: Row, comparison: Comparison) -> Series | str:
    """Return a series, or in words why there is none."""
    if row.run.trajectory(row.output) is None:
        return "the run gave no trajectory"
    try:
        with np.errstate(all="ignore"):  # a diverged run overflows; that becomes null
            return series(row, comparison)
    except Unavailable as reason:
        return str(reason)


def _components(row: Row, comparison: Comparison) -> ComponentSeries | UnsetType:
    """Return errors and stated deviations by component, or nothing where there are none."""
    with np.errstate(all="ignore"):  # as above
        found = components(comparison, row)
    if found is None:
        return UNSET
    sigma = np.full(found.error.shape, np.nan) if found.sigma is None else found.sigma
    names = ("about_x_deg", "about_y_deg", "about_z_deg", "x_m", "y_m", "z_m")  # as the columns stand in Components
    columns = {name: numbers(found.error[:, i]) for i, name in enumerate(names)}
    stated = {f"sigma_{name}": numbers(sigma[:, i]) for i, name in enumerate(names)}
    return ComponentSeries(t_s=seconds(comparison.sequence, found.t_ns), **columns, **stated)


def _nees(row: Row, comparison: Comparison) -> NeesSeries:
    nees = nees_over_time(Evaluation(row.run, row.output, comparison.sequence))
    return NeesSeries(
        t_s=seconds(comparison.sequence, nees.t_ns),
        pose=numbers(nees.pose),
        orientation=numbers(nees.orientation),
        position=numbers(nees.position),
        band=nees_band(POSE_DOF),
    )


def _nis(row: Row, comparison: Comparison) -> NisSeries:
    """Return each step's NIS over what is expected of it, with the two-sided 95 % band of a consistent filter's."""
    found = nis_over_time(Evaluation(row.run, row.output, comparison.sequence))
    causal = row.run.causal
    assert causal is not None, "an output without estimates has no innovations"
    low, high = found.bands()
    return NisSeries(
        t_s=seconds(comparison.sequence, causal.t_ns[found.rows]),
        per_dof=numbers(found.nis / found.expected),
        low=numbers(low),
        high=numbers(high),
    )


def _steps(comparison: Comparison) -> Iterator[StepTimes]:
    sequence = comparison.sequence
    for run in comparison.runs:
        if run.timings is not None and run.timings.step_s.size:
            yield StepTimes(
                estimator=run.estimator,
                t_s=seconds(sequence, sequence.frames_t_ns[: run.timings.step_s.size]),
                step_ms=numbers(1e3 * run.timings.step_s),
                finish_s=number(run.timings.finish_s),
            )


def _map(run: Run) -> DrawnMap:
    """Return where a run's landmarks are; they move with the run's last word onto the truth."""
    return DrawnMap(estimator=run.estimator, landmarks=landmarks_file(run.estimator), output=shown_output(run))


def _over_seeds(group: Row) -> DrawnOverSeeds:
    """Return the NEES averaged over the seeds with its band, and the position error over the seeds, or None each."""
    nees, errors_m = group.mean_nees, group.position_m
    return DrawnOverSeeds(
        estimator=group.estimator,
        output=group.output,
        nees=None
        if nees is None
        else MeanNeesSeries(pose=numbers(nees.mean), low=numbers(nees.low), high=numbers(nees.high)),
        position_rms_m=None if errors_m is None else numbers(_rms_over_runs(errors_m)),
    )


def _rms_over_runs(errors: Array) -> Array:
    """Return the root mean square (K,) over runs of errors (runs, K), NaN where no run has one."""
    known = np.isfinite(errors)
    total, count = np.where(known, errors, 0.0) ** 2, known.sum(axis=0)
    return np.where(count > 0, np.sqrt(total.sum(axis=0) / np.maximum(count, 1)), np.nan)
