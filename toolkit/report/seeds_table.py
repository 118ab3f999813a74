"""The comparison over seeds as a table, and in words what its NEES columns say."""

from collections.abc import Iterator

from toolkit.experiment.comparison import Comparison, Row
from toolkit.report.table import Table, number

_MISSING = "-"
# Key, name, what of it, unit, decimals; "mean" and "std" are over the seeds.
_COLUMNS = (
    ("ate_none_m", "ATE", "none", "m", 3),
    ("ate_yaw_m", "ATE", "yaw", "m", 3),
    ("nees_ori_mean", "NEES", "rot", "1", 2),
    ("nees_pos_mean", "NEES", "pos", "1", 2),
    ("nees_pose_mean", "NEES", "pose", "1", 2),
)
_COSTS = (("nis_mean", "NIS", "", "1", 2), ("frame_ms_mean", "frame", "", "ms", 2), ("total_s", "total", "", "s", 2))
# A consistent estimator is in its band at 95 % of the frames on average; what is less than this is told.
_MOSTLY_PERCENT = 80.0


def seeds_table(over: Comparison) -> Table:
    """Return one row for each kind of output: means over the runs that are ok, and the spread of the first error."""
    labels = [("estimator", "", ""), ("output", "", ""), *([("change", "", "")] if over.changes else [])]
    counts = ("ok", "of", str(len(over.seeds)))
    spread = ("ATE", "std", "m")
    in_band = ("NEES", "in band", "%")
    heads = [tuple(column[1:4]) for column in _COLUMNS]
    headings = (*labels, counts, heads[0], spread, *heads[1:], in_band, *(tuple(column[1:4]) for column in _COSTS))
    rows = tuple(_row(group, over, first=i == 0 or over.rows[i - 1].estimator != group.estimator)
                 for i, group in enumerate(over.rows))  # fmt: skip
    return Table(headings, rows, labels=len(labels))


def _row(group: Row, over: Comparison, *, first: bool) -> tuple[str, ...]:
    change = [over.changes.get(group.estimator, "") if first else ""] if over.changes else []
    error = group.spread(_COLUMNS[0][0])
    std = _MISSING if error is None or error.std is None else number(error.std, 3)
    means = [_mean(group, key, decimals) for key, *_, decimals in _COLUMNS]
    nees = group.mean_nees
    in_band = _MISSING if nees is None else number(nees.in_band_percent, 1)
    costs = (_mean(group, key, decimals) for key, *_, decimals in _COSTS)
    return (group.estimator, group.output, *change, str(group.counts["ok"]), means[0], std, *means[1:], in_band, *costs)


def _mean(group: Row, key: str, decimals: int) -> str:
    spread = group.spread(key)
    return _MISSING if spread is None else number(spread.mean, decimals)


def status_lines(over: Comparison) -> Iterator[str]:
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


def consistency_lines(over: Comparison) -> Iterator[str]:
    """Yield a verdict a row on whether its stated covariance is honest; equal verdicts of both outputs once."""
    told: set[str] = set()
    for group in over.rows:
        nees = group.mean_nees
        if nees is None:
            yield f"{group.estimator} {group.output}: {group.reason('nees_pose_mean')}"
            continue
        verdict = f"{group.estimator}{{}}: in its band at {nees.in_band_percent:.0f} % of the frames"
        if nees.in_band_percent < _MOSTLY_PERCENT:
            above, below = nees.too_sure_percent, 100.0 - nees.in_band_percent - nees.too_sure_percent
            how = "too sure of itself" if above >= below else "less sure of itself than it could be"
            verdict += f", above it at {above:.0f} %, below at {below:.0f} %: {how}"
        if verdict not in told:
            told.add(verdict)
            same = sum(g.estimator == group.estimator and _equal(g, group) for g in over.rows) > 1
            yield verdict.format("" if same else f" {group.output}")


def _equal(one: Row, other: Row) -> bool:
    nees, others = one.mean_nees, other.mean_nees
    return nees is not None and others is not None and nees.in_band_percent == others.in_band_percent
