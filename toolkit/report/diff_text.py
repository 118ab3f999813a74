"""The differences of two run directories for people, and as JSON."""

from collections.abc import Iterator
from typing import Annotated, Literal

from msgspec import Meta, Struct

from toolkit.documents import of_attributes
from toolkit.gate.baseline import FALSE_ALARM_RATE
from toolkit.metrics import Metric, known_metrics
from toolkit.report.differences import Change, Differences, MetricChange
from toolkit.report.prose import WIDTH, Width, filled
from toolkit.report.table import MISSING, Table, as_text, cell

_LONGEST = 40


class ChangeRecord(Struct, frozen=True, kw_only=True):
    """A thing that the two have otherwise, as text; empty where one has none."""

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
    p: Annotated[float | None, Meta(description="that it is the same on average, corrected for all tests")]
    beyond_chance: Annotated[bool | None, Meta(description="null where too few runs tell")]


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


def diff_document(found: Differences) -> DiffRecord:
    """Return the differences as a record."""
    return DiffRecord(
        schema="vislam.diff/1",
        before=found.names[0],
        after=found.names[1],
        same_results=found.same_results,
        paired=found.paired,
        settings=_records(found.settings),
        environment=_records(found.environment),
        data=_records(found.data),
        ends=_records(found.ends),
        metrics=tuple(of_attributes(MetricChangeRecord, one) for one in found.metrics),
    )


def _records(changes: tuple[Change, ...]) -> tuple[ChangeRecord, ...]:
    return tuple(of_attributes(ChangeRecord, one) for one in changes)


def diff_text(found: Differences, columns: tuple[Metric, ...] = (), width: Width = WIDTH) -> str:
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
        lines += _section(title, changes)
    shown = columns or tuple(m for m in known_metrics() if m.table == "always" or m.over_seeds)
    keys = {metric.key: metric for metric in shown}
    moved = [one for one in found.metrics if one.moved and one.metric in keys]
    if moved:
        lines += ["metrics", "", as_text(_table(moved, keys)), ""]
    lines += [filled(line, width) for line in _words(found, len(moved), len(shown))]
    return "\n".join(lines)


def _section(title: str, changes: tuple[Change, ...]) -> list[str]:
    if not changes:
        return [f"{title}: the same", ""]
    rows = tuple((one.name, _short(one.before), _short(one.after)) for one in changes)
    return [title, "", as_text(Table((("",), ("before",), ("after",)), rows, labels=3)), ""]


def _short(text: str) -> str:
    """Return a text, a long one without its middle: what differs is at the end, as of a file or of a changed commit."""
    half = (_LONGEST - 3) // 2
    return (text if len(text) <= _LONGEST else f"{text[:half]}...{text[-half:]}") or MISSING


def _table(moved: list[MetricChange], metrics: dict[str, Metric]) -> Table:
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


def _words(found: Differences, moved: int, shown: int) -> Iterator[str]:
    if found.same_results:
        yield "the results are the same, to a millionth; time and memory never are"
    elif not moved:
        yield f"none of the {shown} metrics of the tables moved; --columns all has the others"
    if found.tests:
        how = "paired by seed" if found.paired else "as independent draws, for the recordings are not the same"
        rate = f"{100.0 * FALSE_ALARM_RATE:g} %"
        yield f"chance: {found.tests} tests, {how}, which share a false-alarm rate of {rate} (Holm)"
    else:
        yield "chance: one run on each side tells nothing of it; compare over --seeds"
