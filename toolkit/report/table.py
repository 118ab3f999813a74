"""The comparison as a table: the same cells for plain text and for Markdown."""

from dataclasses import dataclass
from typing import NamedTuple

from toolkit.experiment.comparison import Comparison, Row

_SEPARATOR = "  "
_MISSING = "-"
_WIDEST_NUMBER = 5


@dataclass(frozen=True)
class Column:
    """A metric in the table: its key, what stands above it (name, alignment, unit) and its decimals."""

    key: str
    heading: tuple[str, str, str]
    decimals: int

    @property
    def name(self) -> str:
        """Return the heading in one line, without the unit."""
        return " ".join(filter(None, self.heading[:2]))


# The heading's second line names the alignment of everything that is compared with the truth.
COLUMNS = (
    Column("pairs", ("pairs", "", ""), 0),
    Column("coverage_percent", ("cover", "", "%"), 1),
    Column("ate_se3_m", ("ATE", "SE(3)", "m"), 2),
    Column("ate_yaw_m", ("ATE", "yaw", "m"), 2),
    Column("rpe_100m_percent", ("RPE", "100 m", "%"), 2),
    Column("kitti_t_percent", ("KITTI", "trans", "%"), 2),
    Column("end_drift_percent", ("end", "drift", "%"), 2),
    Column("reproj_median_px", ("reproj", "own", "px"), 2),
    Column("heldout_reproj_median_px", ("reproj", "held-out", "px"), 2),
    Column("nis_mean", ("NIS", "mean", "1"), 2),
    Column("frame_ms_mean", ("frame", "mean", "ms"), 2),
    Column("total_s", ("total", "", "s"), 2),
)
_LABELS = (("estimator", "", ""), ("output", "", ""), ("status", "", ""))
_CHANGE = ("change", "", "")


class Table(NamedTuple):
    """Headings (one tuple of lines a column) and rows of cells; the first ``labels`` columns are words."""

    headings: tuple[tuple[str, ...], ...]
    rows: tuple[tuple[str, ...], ...]
    labels: int


def comparison_table(comparison: Comparison) -> Table:
    """Return one row for each kind of output that says something of its own.

    Pairs and coverage always have a column, other metrics where some row has one.
    """
    columns = [c for c in COLUMNS if c.key in ("pairs", "coverage_percent") or _has_value(comparison, c.key)]
    changes = _changes(comparison)
    rows = tuple(
        (row.estimator, row.label, row.status, *change, *(_cell(row, column) for column in columns))
        for row, change in zip(comparison.lines, changes, strict=True)
    )
    labels = (*_LABELS, _CHANGE) if comparison.changes else _LABELS
    return Table((*labels, *(c.heading for c in columns)), rows, labels=len(labels))


def _changes(comparison: Comparison) -> list[tuple[str, ...]]:
    """Return a cell a row with what its estimator changes, told once an estimator; no cells without a ladder."""
    if not comparison.changes:
        return [()] * len(comparison.lines)
    names = [row.estimator for row in comparison.lines]
    return [("" if name in names[:i] else comparison.changes.get(name, ""),) for i, name in enumerate(names)]


def as_text(table: Table) -> str:
    """Return the table with aligned columns, words to the left and numbers to the right."""
    heading_lines = list(zip(*table.headings, strict=True))
    lines = [line for line in heading_lines if any(line)]
    widths = [max(len(cell) for cell in column) for column in zip(*lines, *table.rows, strict=True)]

    def aligned(cells: tuple[str, ...]) -> str:
        padded = (
            cell.ljust(width) if i < table.labels else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(cells, widths, strict=True))
        )
        return _SEPARATOR.join(padded).rstrip()

    rule = _SEPARATOR.join("-" * width for width in widths)
    return "\n".join([*map(aligned, lines), rule, *map(aligned, table.rows)])


def as_markdown(table: Table) -> str:
    """Return the table in Markdown; units stand in brackets behind the names."""
    heads = [" ".join(filter(None, lines[:-1])) + (f" [{lines[-1]}]" if lines[-1] else "") for lines in table.headings]
    rules = [":--" if i < table.labels else "--:" for i in range(len(heads))]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (heads, rules, *table.rows))


def _has_value(comparison: Comparison, key: str) -> bool:
    return any(row.scores.values.get(key) is not None for row in comparison.lines)


def _cell(row: Row, column: Column) -> str:
    value = row.scores.values.get(column.key)
    if value is None:
        return _MISSING
    if column.decimals == 0:
        return f"{value:.0f}"
    # An error of a few centimetres says nothing in two decimals.
    return number(value, column.decimals + (abs(value) < 0.1))


def number(value: float, decimals: int) -> str:
    """Return a number with at most so many decimals in five characters, in powers of ten where it needs more."""
    texts = (f"{value:.{d}f}" for d in range(decimals, -1, -1))
    # A diverged estimator may be light years away; its number must not tear the columns apart.
    return next((text for text in texts if len(text) <= _WIDEST_NUMBER), f"{value:.0e}")
