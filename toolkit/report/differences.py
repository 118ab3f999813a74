"""What differs between two run directories: settings, versions, data, how runs ended, and metrics beyond chance.

As the document ``vislam.diff/1`` and as text.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import UNSET, Meta, Struct, to_builtins

from toolkit.answers import Status
from toolkit.experiment.statistics import holm
from toolkit.gate.baseline import FALSE_ALARM_RATE, Criterion
from toolkit.gate.significance import FEWEST_RUNS, ROUNDING, Pairs, Repeats
from toolkit.gate.verdict import Where
from toolkit.metrics import Metric, cost, known_metrics
from toolkit.report.run_directory import RunFiles, SeedsFiles, repeated
from toolkit.report.scores import MetricOverSeeds
from toolkit.report.text import MISSING, WIDTH, Table, Width, as_text, cell, filled

Files = RunFiles | SeedsFiles
_SAME = 1e-6
_FEWEST_PAIRS = 2
_COSTS = frozenset(metric.key for metric in cost.METRICS)
# Parts of a manifest that are compared: request, settings, versions and data; the rest is place and time.
_ASKS_FOR = ("compare", "settings")
_RUNS_WITH = ("versions", "git_revision", "cpu", "os", "threads")
_READS = ("sequence", "start", "seeds", "references")
_LONGEST = 40


class ChangeRecord(Struct, frozen=True, kw_only=True):
    """An entry in which the two differ, as text; empty where one lacks it."""

    name: str
    before: str
    after: str


class MetricChangeRecord(Struct, frozen=True, kw_only=True):
    """A metric of one estimator and output; over seeds the mean over the runs that are ok."""

    estimator: str
    output: str
    metric: str
    before: float | None
    after: float | None
    change_percent: float | None
    moved: Annotated[bool, Meta(description="by more than a millionth")]
    p: Annotated[float | None, Meta(description="p-value of equal means, corrected for all tests")]
    beyond_chance: Annotated[bool | None, Meta(description="null where there are too few runs")]


class DiffRecord(Struct, frozen=True, kw_only=True):
    """What differs between two run directories."""

    schema: Literal["vislam.diff/1"]
    before: str
    after: str
    same_results: Annotated[bool, Meta(description="all but time and memory, to a millionth")]
    paired: Annotated[bool, Meta(description="whether both read the same recordings")]
    settings: tuple[ChangeRecord, ...]
    environment: tuple[ChangeRecord, ...]
    data: tuple[ChangeRecord, ...]
    ends: tuple[ChangeRecord, ...]
    metrics: tuple[MetricChangeRecord, ...]


def differences(before: Files, after: Files) -> DiffRecord:
    lines = [_lines(files) for files in (before, after)]
    twice = repeated(before) & repeated(after)
    both = [key for key in lines[0] if key in lines[1] and not (key[0] in twice and key[1] == "final")]
    hashes = [_hashes(files) for files in (before, after)]
    shared = hashes[0].keys() & hashes[1].keys()
    # Runs of one seed are paired where both sides read the same recording under each common one.
    paired = bool(shared) and all(hashes[0][seed] == hashes[1][seed] for seed in shared)
    values = [(key, metric) for key in both for metric in known_metrics()]
    raw = [_tested(lines[0][key], lines[1][key], metric, paired=paired) for key, metric in values]
    corrected = iter(holm(np.array([p for p in raw if p is not None])).tolist())
    changes = []
    for (key, metric), p in zip(values, raw, strict=True):
        was, is_ = (side[key].value(metric) for side in lines)
        adjusted = None if p is None else next(corrected)
        if was is None and is_ is None:
            continue
        moved, change_percent = True, None
        if was is not None and is_ is not None:
            moved = not math.isclose(was, is_, rel_tol=_SAME, abs_tol=1e-12)
            change_percent = 100.0 * (is_ / was - 1.0) if was else None
        changes.append(
            MetricChangeRecord(
                estimator=key[0],
                output=key[1],
                metric=metric.key,
                before=was,
                after=is_,
                change_percent=change_percent,
                moved=moved,
                p=adjusted,
                beyond_chance=None if adjusted is None else adjusted <= FALSE_ALARM_RATE,
            )
        )
    ends = tuple(_ends(*lines))
    manifests = [to_builtins(files.manifest) for files in (before, after)]
    settings, environment, data = (
        tuple(_changes(*({name: one.get(name) for name in names} for one in manifests)))
        for names in (_ASKS_FOR, _RUNS_WITH, _READS)
    )
    return DiffRecord(
        schema="vislam.diff/1",
        before=str(before.directory),
        after=str(after.directory),
        same_results=not ends and not any(one.moved and one.metric not in _COSTS for one in changes),
        paired=paired,
        settings=settings,
        environment=environment,
        data=data,
        ends=ends,
        metrics=tuple(changes),
    )


@dataclass(frozen=True)
class _Line:
    """One kind of output of one estimator: its status under each seed, and each metric's values, by seed."""

    status: Mapping[int, Status]
    values: Mapping[str, Mapping[int, float | None]]

    def good(self, metric: Metric) -> dict[int, float]:
        """Return the values of the runs that ended well, by seed."""
        given = self.values.get(metric.key, {})
        return {seed: value for seed, value in given.items() if value is not None and self.status[seed] == "ok"}

    def value(self, metric: Metric) -> float | None:
        """Return the value of the only run, however it ended, or the mean over those that ended well."""
        if len(self.status) == 1:
            return next(iter(self.values.get(metric.key, {}).values()), None)
        good = list(self.good(metric).values())
        return float(np.mean(good)) if good else None


def _hashes(files: Files) -> dict[int, str | None]:
    if isinstance(files, SeedsFiles):
        return dict(zip(files.scores.seeds, files.scores.hashes, strict=True))
    return {files.manifest.seeds.sequence: files.scores.sequence.hash}


def _lines(files: Files) -> dict[tuple[str, str], _Line]:
    def by_seed(values: Any) -> dict[int, Any]:
        given = values.values if isinstance(values, MetricOverSeeds) else values
        return dict(zip(_hashes(files), given if isinstance(given, tuple) else (given,), strict=True))

    return {
        (run.estimator, run.output): _Line(by_seed(run.status), {k: by_seed(one) for k, one in run.metrics.items()})
        for run in files.scores.runs
    }


def _tested(before: _Line, after: _Line, metric: Metric, *, paired: bool) -> float | None:
    """Return the p-value that a metric is the same on average, two-sided; None where too few runs tell.

    Values that are the same under every seed need no test; time and memory depend on other load of the machines.
    """
    was, is_ = before.good(metric), after.good(metric)
    if metric.key in _COSTS or was == is_:
        return None
    if paired:
        seeds = sorted(was.keys() & is_.keys())
        if len(seeds) < _FEWEST_PAIRS:
            return None
        sides = (np.array([side[seed] for seed in seeds]) for side in (was, is_))
        return float(Pairs(Where("", "", "", metric.key), Criterion("larger", 0.0), *sides).moved_p())
    if min(len(was), len(is_)) < FEWEST_RUNS:
        return None
    criterion = Criterion("larger", 100.0 * ROUNDING)
    sides = (np.array(list(side.values())) for side in (was, is_))
    return Repeats(Where("", "", "", metric.key), criterion, *sides).moved_p()


def _ends(before: Mapping[tuple[str, str], _Line], after: Mapping[tuple[str, str], _Line]) -> Iterator[ChangeRecord]:
    for key in dict.fromkeys((*before, *after)):
        counts = [_counts(side[key]) if key in side else "" for side in (before, after)]
        if counts[0] != counts[1]:
            yield ChangeRecord(name=" ".join(key), before=counts[0], after=counts[1])


def _counts(line: _Line) -> str:
    ends = list(line.status.values())
    return ends[0] if len(ends) == 1 else f"{ends.count('ok')} of {len(ends)} ok"


def _changes(before: Mapping[str, Any], after: Mapping[str, Any]) -> Iterator[ChangeRecord]:
    one, two = dict(_flat(before)), dict(_flat(after))
    for name in dict.fromkeys((*one, *two)):
        if one.get(name) != two.get(name):
            yield ChangeRecord(name=name, before=one.get(name, ""), after=two.get(name, ""))


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield nested values as texts by their dotted names; what is absent or null is left out."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        elif value is not None and value is not UNSET:
            yield f"{prefix}{key}", ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def diff_text(found: DiffRecord, columns: tuple[Metric, ...] = (), width: Width = WIDTH) -> str:
    """Return the differences as text: what was asked for, read and run with, then the metrics that moved.

    Without ``columns`` the metrics are those of the tables.
    """
    lines = []
    for title, changes in (
        ("settings", found.settings),
        ("data", found.data),
        ("versions and machine", found.environment),
        ("how runs ended", found.ends),
    ):
        rows = tuple((one.name, _short(one.before), _short(one.after)) for one in changes)
        table = Table((("",), ("before",), ("after",)), rows, labels=3)
        lines += [title, "", as_text(table), ""] if rows else [f"{title}: the same", ""]
    shown = columns or tuple(m for m in known_metrics() if m.table == "always" or m.over_seeds)
    keys = {metric.key: metric for metric in shown}
    moved = [one for one in found.metrics if one.moved and one.metric in keys]
    if moved:
        lines += ["metrics", "", as_text(_table(moved, keys)), ""]
    lines += [filled(line, width) for line in _summary_lines(found, len(moved), len(shown))]
    return "\n".join(lines)


def _short(text: str) -> str:
    """Return a text, a long one without its middle: differences are usually at the end."""
    half = (_LONGEST - 3) // 2
    return (text if len(text) <= _LONGEST else f"{text[:half]}...{text[-half:]}") or MISSING


def _table(moved: list[MetricChangeRecord], metrics: dict[str, Metric]) -> Table:
    rows = tuple(
        (
            one.estimator,
            one.output,
            one.metric,
            cell(one.before, metrics[one.metric]),
            cell(one.after, metrics[one.metric]),
            MISSING if one.change_percent is None else f"{one.change_percent:+.3g}",
            MISSING if one.p is None else f"{one.p:.2g}",
            {True: "beyond chance", False: "may be chance", None: MISSING}[one.beyond_chance],
        )
        for one in moved
    )
    heads = ("estimator", "output", "metric", "before", "after", "change", "p", "verdict")
    return Table(tuple((head, "%" if head == "change" else "") for head in heads), rows, labels=3)


def _summary_lines(found: DiffRecord, moved: int, shown: int) -> Iterator[str]:
    if found.same_results:
        yield "the results are the same, to a millionth; time and memory never are"
    elif not moved:
        yield f"none of the {shown} metrics of the tables moved; --columns all has the others"
    tests = sum(one.p is not None for one in found.metrics)
    if tests:
        how = "paired by seed" if found.paired else "as independent draws, for the recordings are not the same"
        rate = f"{100.0 * FALSE_ALARM_RATE:g} %"
        yield f"chance: {tests} tests, {how}, which share a false-alarm rate of {rate} (Holm)"
    else:
        yield "chance: unknown from one run on each side; compare over --seeds"
