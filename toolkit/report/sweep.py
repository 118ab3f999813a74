"""A sweep as ``sweep.json`` (the contract ``vislam.sweep/1``), as a table and text made of that, and as a folder."""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from toolkit.experiment.statistics import Interval
from toolkit.experiment.sweep import BREAKS_AT, Breaking, Sweep
from toolkit.files.documents import number as finite
from toolkit.files.documents import of_attributes, reader
from toolkit.metrics import Metric, known_metrics
from toolkit.report.headers import sequence_line
from toolkit.report.manifest import RecordingRecord, SeedsUsed, made_here, recording_record
from toolkit.report.run_directory import Results, Shown
from toolkit.report.text import MISSING, Table, cell, number, unit_of
from toolkit.settings import Scalar, changes_of


class IntervalRecord(Struct, frozen=True, kw_only=True):
    """A value with its 95 % interval; null is infinite, as the error of runs that did not end well is."""

    value: float | None
    low: float | None
    high: float | None


class AxisRecord(Struct, frozen=True, kw_only=True):
    """What was varied: a setting by its key, or a planted fault as fault:NAME."""

    name: str
    meaning: str
    unit: str
    clean: Annotated[Scalar | None, Meta(description="without it; null where that is none, or no finite number")]
    values: tuple[Scalar, ...]
    found: Annotated[tuple[tuple[str, ...], ...], Meta(description="faults the audit names, by dose; none of settings")]


class EffectRecord(Struct, frozen=True, kw_only=True):
    """An estimator at one point; null is what is not known."""

    estimator: str
    at: Annotated[dict[str, Scalar], Meta(description="value by axis; an axis that is not here is at its clean value")]
    runs: Annotated[int, Meta(ge=1)]
    ok: Annotated[int, Meta(ge=0)]
    error: Annotated[float | None, Meta(description="mean over the runs that are ok, of the metric of the sweep")]
    over_clean: Annotated[IntervalRecord | None, Meta(description="error over that of the clean recording")]
    held_out: Annotated[IntervalRecord | None, Meta(description="error of withheld tracks over that of the clean one")]
    nees: Annotated[IntervalRecord | None, Meta(description="of the pose, over its 6 degrees of freedom")]
    cpu_ms: Annotated[float | None, Meta(description="of a frame")]


class SweepRecord(Struct, frozen=True, kw_only=True):
    """What a sweep found."""

    schema: Literal["vislam.sweep/1"]
    made: Annotated[dict[str, str], Meta(description="command, date, git_revision and cpu")]
    sequence: RecordingRecord
    about: Annotated[str, Meta(description="the sequence in a line")]
    seeds: SeedsUsed
    settings: Annotated[dict[str, Any], Meta(description="those that are not the defaults, nested")]
    estimators: tuple[str, ...]
    metric: Annotated[str, Meta(description="key of the error")]
    intervals: Annotated[Literal["seeds", "stretches"], Meta(description="what they are over")]
    axes: tuple[AxisRecord, ...]
    effects: tuple[EffectRecord, ...]
    breaking: Annotated[tuple[Breaking, ...], Meta(description="null is beyond the largest dose that was tried")]
    figures: Annotated[dict[str, str], Meta(description="caption by file")]
    files: Annotated[tuple[str, ...], Meta(description="that the sweep wrote, relative to its directory")]


read_sweep = reader(SweepRecord, "repeat the sweep")


def sweep_document(
    sweep: Sweep, command: str = "", figures: Mapping[str, str] | None = None, files: tuple[str, ...] = ()
) -> SweepRecord:
    """Return a sweep as a record; ``figures`` are captions by file, ``files`` what was written beside it."""
    plan, sequence = sweep.grid.plan, sweep.grid.case.sequence
    axes = [
        of_attributes(
            AxisRecord,
            axis,
            clean=None if isinstance(axis.clean, float) and math.isinf(axis.clean) else axis.clean,
            found=tuple(sweep.found[point] for point in axis.points if point in sweep.found),
        )
        for axis in sweep.axes
    ]
    return SweepRecord(
        schema="vislam.sweep/1",
        made=made_here(command),
        sequence=recording_record(sequence),
        about=sequence_line(sequence),
        seeds=SeedsUsed(sequence=plan.seeds[0], count=len(plan.seeds)),
        settings=changes_of(plan.settings),
        estimators=sweep.estimators,
        metric=sweep.metric,
        intervals="seeds" if sweep.over_seeds else "stretches",
        axes=tuple(axes),
        effects=tuple(of_attributes(EffectRecord, e, _in_json, at=dict(e.point)) for e in sweep.effects.values()),
        breaking=sweep.breaking,
        figures=dict(figures or {}),
        files=files,
    )


def _in_json(value: Any) -> Any:
    if isinstance(value, Interval):
        return IntervalRecord(**dict(zip(Interval._fields, map(finite, value), strict=True)))
    return finite(value) if isinstance(value, float) else value


def sweep_table(sweep: SweepRecord) -> Table:
    """Return each estimator's error over its clean one, with the interval, at every point, and where it breaks."""
    of_faults = (axis for axis in sweep.axes if axis.found)
    found = {(a.name, value): names for a in of_faults for value, names in zip(a.values, a.found, strict=True)}
    rows = []
    for at, effects in groupby(sweep.effects, key=lambda effect: effect.at):
        if at:
            told = ", ".join(name for one in at.items() for name in found.get(one, ()))
            rows.append(
                (
                    ", ".join(at),
                    ", ".join(map(shown_value, at.values())),
                    told,
                    *(in_words(effect.over_clean) for effect in effects),
                )
            )
        else:
            rows.append(("clean", "", "", *_clean_cells(metric_of(sweep), list(effects))))
    unknown = {(e.estimator, *one) for e in sweep.effects if e.over_clean is None for one in e.at.items()}
    for (name, _), sides in groupby(sweep.breaking, key=lambda one: (one.axis, one.tried)):
        axis = next(axis for axis in sweep.axes if axis.name == name)
        cells = (MISSING if (one.estimator, name, one.tried) in unknown else _breaking(one, axis) for one in sides)
        rows.append((name, "breaks at", "", *cells))
    heads = ("over", "value", "audit says", *sweep.estimators)
    return Table(tuple((head, "", "") for head in heads), tuple(rows), labels=3, under=tuple(_under(sweep)))


def metric_of(sweep: Sweep | SweepRecord) -> Metric:
    return next(metric for metric in known_metrics() if metric.key == sweep.metric)


def shown_value(value: Scalar) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _clean_cells(metric: Metric, effects: Sequence[EffectRecord]) -> Iterator[str]:
    unit = unit_of(metric, [effect.error for effect in effects])
    for effect in effects:
        of = "" if effect.ok == effect.runs else f", {effect.ok} of {effect.runs} ok"
        yield f"{cell(effect.error, metric, unit)} {unit.name}{of}"


def in_words(interval: IntervalRecord | None) -> str:
    """Return a ratio with its interval, as in 1.20 (0.98-1.47)."""
    if interval is None:
        return MISSING
    value, low, high = ("inf" if one is None else number(one) for one in (interval.value, interval.low, interval.high))
    return value if low == high == "inf" else f"{value} ({low}-{high})"


def _breaking(one: Breaking, axis: AxisRecord) -> str:
    is_below = isinstance(axis.clean, str) or axis.clean is None or one.tried < axis.clean
    beyond = f"{'<' if is_below else '>'}{number(one.tried)}"
    dose, low, high = (beyond if end is None else number(end) for end in (one.dose, one.low, one.high))
    return beyond if dose == low == high else f"{dose} ({low} to {high})"


def _under(sweep: SweepRecord) -> Iterator[str]:
    metric, over = metric_of(sweep), f"{sweep.seeds.count} seeds, paired by seed"
    what = metric.name
    if sweep.intervals == "stretches":
        what, over = (what if metric.unit == "px" else "drift"), "stretches of the one recording"
    yield f"{what} over that of the clean recording, with 95 % intervals over {over}; inf: runs that did not end well"
    if sweep.breaking:
        yield f"breaks at: the dose at which it passes {BREAKS_AT:g} times clean, between doses that were run"
    for axis in sweep.axes:
        yield f"{axis.name}{f' [{axis.unit}]' if axis.unit else ''}: {axis.meaning}"


def _shown_as(sweep: SweepRecord) -> Shown:
    return Shown(f"Sweep of {sweep.sequence.name}", sweep.about, sweep_table(sweep), sweep.figures, sweep.files)


SWEEPS = Results("sweep.json", "sweep.md", sweep_document, read_sweep, _shown_as)
