"""The comparison over seeds as a table, and in words what its NEES columns say."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

from toolkit.experiment.monte_carlo import Group, OverSeeds
from toolkit.metrics import Metric, known_metrics, metrics_called
from toolkit.report.table import MISSING, Columns, Table, cell, change_lines, heading, number

# The metric whose mean over seeds is held against its band, in a column of its own behind that of the mean.
_BANDED = "nees_pose_mean"
# A consistent estimator is in its band at 95 % of the frames on average; a share below this is remarked on.
_MOSTLY_PERCENT = 80.0


class _Column(NamedTuple):
    """Three lines of heading, and the cell of a row."""

    heading: tuple[str, str, str]
    cell: Callable[[Group], str]


def seeds_table(over: OverSeeds, columns: Columns = None) -> Table:
    """Return one row for each kind of output: means over the runs that are ok, and the spread of the first metric.

    Under the table of a ladder stands what each estimator changes. Raises VislamError for an unknown column.
    """
    chosen = tuple(_columns(over, columns))
    rows = tuple((group.estimator, group.output, *(column.cell(group) for column in chosen)) for group in over.groups)
    labels = (("estimator", "", ""), ("output", "", ""))
    under = change_lines((name, over.changes.get(name, "")) for name in over.estimators)
    return Table((*labels, *(column.heading for column in chosen)), rows, len(labels), tuple(under))


def _columns(over: OverSeeds, columns: Columns) -> Iterator[_Column]:
    yield _Column(("ok", "of", str(len(over.seeds))), lambda group: str(group.counts["ok"]))
    for i, metric in enumerate(_metrics(over, columns)):
        yield _Column(heading(metric), partial(_mean, metric=metric))
        if i == 0:
            yield _Column((metric.heading[0], "std", metric.unit), partial(_std, metric=metric))
        if metric.key == _BANDED:
            yield _Column(("NEES", "band", "%"), _in_band)


def _metrics(over: OverSeeds, columns: Columns) -> tuple[Metric, ...]:
    if columns is not None and columns != "all":
        return metrics_called(columns)
    known = known_metrics() if columns == "all" else (metric for metric in known_metrics() if metric.over_seeds)
    return tuple(metric for metric in known if any(group.spread(metric.key) for group in over.groups))


def _mean(group: Group, metric: Metric) -> str:
    spread = group.spread(metric.key)
    return cell(None if spread is None else spread.mean, metric)


def _std(group: Group, metric: Metric) -> str:
    spread = group.spread(metric.key)
    return cell(None if spread is None else spread.std, metric)


def _in_band(group: Group) -> str:
    nees = group.mean_nees
    return MISSING if nees is None else number(nees.in_band_percent, 1)


def status_lines(over: OverSeeds) -> Iterator[str]:
    """Yield the runs that did not end well, with what the first of a kind said about it."""
    for estimator in over.estimators:
        for status in ("diverged", "failed"):
            bad = [o for o in over.outcomes if o.estimator == estimator and o.status == status]
            if bad:
                log = bad[0].log
                # A run that failed says so first; the runner appends what diverged behind the estimator's own words.
                why = f": {' '.join(log[0 if status == 'failed' else -1].split())}" if log else ""
                seeds = f"seed{'s' if len(bad) > 1 else ''} {', '.join(str(o.seed) for o in bad)}"
                yield f"{estimator} {status} under {seeds}{why}"
    if not over.all_ok:
        yield "means and spreads are over the runs that are ok; seeds.json has every run's values"


def consistency_lines(over: OverSeeds) -> Iterator[str]:
    """Yield a verdict a row on whether its stated covariance is honest; equal verdicts of both outputs once."""
    given: set[str] = set()
    for group in over.groups:
        nees = group.mean_nees
        if nees is None:
            yield f"{group.estimator} {group.output}: {group.reason('nees_pose_mean')}"
            continue
        verdict = f"{group.estimator}{{}}: in its band at {nees.in_band_percent:.0f} % of the frames"
        if nees.in_band_percent < _MOSTLY_PERCENT:
            above, below = nees.too_sure_percent, 100.0 - nees.in_band_percent - nees.too_sure_percent
            how = "too sure of itself" if above >= below else "less sure of itself than it could be"
            verdict += f", above it at {above:.0f} %, below at {below:.0f} %: {how}"
        if verdict not in given:
            given.add(verdict)
            same = sum(g.estimator == group.estimator and _equal(g, group) for g in over.groups) > 1
            yield verdict.format("" if same else f" {group.output}")


def _equal(one: Group, other: Group) -> bool:
    nees, others = one.mean_nees, other.mean_nees
    return nees is not None and others is not None and nees.in_band_percent == others.in_band_percent
