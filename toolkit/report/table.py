"""Tables for a terminal and for Markdown, and the comparison of one sequence as such a table.

Which metrics have a column, under which heading and with how many decimals, is said by their own records in
:mod:`toolkit.metrics`; tabulate renders the cells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

from tabulate import SEPARATING_LINE, DataRow, Line, TableFormat, tabulate

from toolkit.errors import printable
from toolkit.metrics import Metric, known_metrics, metrics_called
from toolkit.report.prose import in_markdown

if TYPE_CHECKING:
    from toolkit.experiment.comparison import Comparison, Row

MISSING = "-"
_WIDEST_NUMBER = 5
_CELLS = DataRow("", "  ", "")
_PLAIN_TEXT = TableFormat(
    lineabove=None,
    linebelowheader=Line("", "-", "  ", ""),
    linebetweenrows=None,
    linebelow=None,
    headerrow=_CELLS,
    datarow=_CELLS,
    padding=0,
    with_header_hide=None,
)
_LATEX = {character: rf"\{character}" for character in "&%$#_{}"} | {
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "\\": r"\textbackslash{}",
    "±": r"$\pm$",
}
# The metric whose mean over seeds is held against its band, in a column of its own behind that of the mean.
_BANDED = "nees_pose_mean"

# What comes first in the table of a real drive: its drift, and the error that keeps the vertical. After an SE(3) fit
# good estimators differ by luck there (one model solved twice differed by a metre). The drift says what the RPE would.
_LEADING, _SAID_BY_DRIFT = ("kitti_t_percent", "ate_yaw_m"), "rpe_100m_percent"

# The columns of a table: None for the usual ones, "all", or metrics by key or name.
Columns = None | Literal["all"] | tuple[str, ...]


class Table(NamedTuple):
    """Headings (one tuple of lines a column), rows of cells, and lines that belong under the table.

    The first ``labels`` columns are words, the others numbers. ``marks`` has a remark or nothing for each row, which
    stands with its third cell, how the row's runs ended. ``best`` has row and column of each cell to set in bold where
    the kind of text can.
    """

    headings: tuple[tuple[str, ...], ...]
    rows: tuple[tuple[str, ...], ...]
    labels: int
    under: tuple[str, ...] = ()
    marks: tuple[str, ...] = ()
    best: frozenset[tuple[int, int]] = frozenset()


class _Column(NamedTuple):
    """Three lines of heading, and the cell of a row."""

    heading: tuple[str, ...]
    cell: Callable[[Row], str]


def columns_asked(names: tuple[str, ...]) -> Columns:
    """Return the columns that some names ask for: the usual ones where there are none, all for the one word "all".

    Raises VislamError for a name that is no metric's.
    """
    if names == ("all",):
        return "all"
    metrics_called(names)
    return names or None


def comparison_table(comparison: Comparison, columns: Columns = None) -> Table:
    """Return one row for each kind of output that differs from the others of its estimator.

    Over seeds a cell is the mean over the runs that are ok. Under the table of a ladder stands what each estimator
    changes. Raises VislamError for an unknown column.
    """
    ends = _ok_of(comparison) if comparison.over_seeds else _Column(("status", "", ""), lambda row: row.status)
    chosen = (ends, *_metric_columns(comparison, columns))
    rows = tuple((row.estimator, row.label, *(column.cell(row) for column in chosen)) for row in comparison.lines)
    headings = (("estimator", "", ""), ("output", "", ""), *(column.heading for column in chosen))
    under = change_lines((name, comparison.changes.get(name, "")) for name in comparison.estimators)
    marks = tuple(row.mark for row in comparison.lines)
    return Table(headings, rows, 2 if comparison.over_seeds else 3, tuple(under), marks)


def _ok_of(comparison: Comparison) -> _Column:
    """Return the column of how many runs ended well."""
    return _Column(("ok", "of", str(len(comparison.seeds))), lambda row: str(row.counts["ok"]))


def _metric_columns(comparison: Comparison, columns: Columns) -> Iterator[_Column]:
    """Yield a column for each metric; over seeds also the spread of the first, and how long the NEES is in its band."""
    for i, metric in enumerate(shown_metrics(comparison, columns)):
        yield _Column(heading(metric), partial(_value, metric=metric))
        if comparison.over_seeds and i == 0:
            yield _Column((metric.heading[0], "std", metric.unit), partial(_std, metric=metric))
        if comparison.over_seeds and metric.key == _BANDED:
            yield _Column(("NEES", "band", "%"), _in_band)


def _value(row: Row, metric: Metric) -> str:
    return cell(row.value(metric.key), metric)


def _std(row: Row, metric: Metric) -> str:
    spread = row.spread(metric.key)
    return cell(None if spread is None else spread.std, metric)


def _in_band(row: Row) -> str:
    nees = row.mean_nees
    return MISSING if nees is None else number(nees.in_band_percent, 1)


def shown_metrics(comparison: Comparison, columns: Columns = None) -> tuple[Metric, ...]:
    """Return the metrics that have a column; without any value a metric has one only if it is named.

    Pairs and coverage, whose records say so, are a column where rows differ; else :func:`shared_values` has them.
    """
    if columns is not None and columns != "all":
        return metrics_called(columns)
    valued = [metric for metric in known_metrics() if any(v is not None for v in _values(comparison, metric))]
    if columns == "all":
        return tuple(valued)
    if comparison.over_seeds:
        return tuple(metric for metric in valued if metric.over_seeds)
    differing = [m for m in valued if m.table == "where rows differ" and len(set(_values(comparison, m))) > 1]
    usual = [metric for metric in valued if metric.table == "always"]
    return (*differing, *(_for_a_drive(valued, usual) if _is_real(comparison) else usual))


def _is_real(comparison: Comparison) -> bool:
    return comparison.sequence.provenance.format != "simulated"


def _for_a_drive(valued: Sequence[Metric], usual: Sequence[Metric]) -> Sequence[Metric]:
    """Return the columns of a recording: those of a drive where it is long enough for the KITTI benchmark's drift."""
    leading = [metric for key in _LEADING for metric in valued if metric.key == key]
    if len(leading) < len(_LEADING):
        return usual
    return [*leading, *(metric for metric in usual if metric.key not in (*_LEADING, _SAID_BY_DRIFT))]


def explained_metrics(comparison: Comparison, columns: Columns = None) -> tuple[Metric, ...]:
    """Return the metrics whose missing values a reader of the table wants explained."""
    if columns is None and comparison.over_seeds:
        return tuple(metric for metric in known_metrics() if metric.over_seeds)
    if columns is None:
        shown = shown_metrics(comparison)
        return tuple(metric for metric in known_metrics() if metric in shown or metric.table != "on request")
    return known_metrics() if columns == "all" else metrics_called(columns)


def shared_values(comparison: Comparison, columns: Columns = None) -> Iterator[str]:
    """Yield, in words, pairs and coverage where they have no column: one value, or from the least to the most."""
    shown = shown_metrics(comparison, columns)
    for metric in known_metrics():
        values = sorted({value for value in _values(comparison, metric) if value is not None})
        if metric.table == "where rows differ" and metric not in shown and values:
            ends = " to ".join(dict.fromkeys(cell(value, metric) for value in (values[0], values[-1])))
            yield " ".join(filter(None, (metric.name, ends, metric.unit)))


def change_lines(changes: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield a line for each estimator that changes something against the rung before, aligned; none off a ladder."""
    given = [(name, change) for name, change in changes if change]
    width = max((len(name) for name, _ in given), default=0)
    for name, change in given:
        yield f"{name:<{width}}  {change}"


def heading(metric: Metric) -> tuple[str, str, str]:
    """Return the lines above a metric's column: what, which, unit."""
    return (*metric.heading, metric.unit)


def cell(value: float | None, metric: Metric) -> str:
    """Return a metric's value as it stands in a table."""
    if value is None:
        return MISSING
    if metric.count:
        return f"{value:.0f}"
    # An error of a few centimetres needs three decimals to say anything.
    return number(value, metric.decimals + (abs(value) < 0.1))


def number(value: float, decimals: int) -> str:
    """Return a number with at most so many decimals in five characters, in powers of ten where it needs more."""
    texts = (f"{value:.{d}f}" for d in range(decimals, -1, -1))
    # The number of a diverged estimator may have any size and must not widen the table.
    return next((text for text in texts if len(text) <= _WIDEST_NUMBER), f"{value:.0e}")


def as_text(table: Table) -> str:
    """Return the table with aligned columns, words to the left and numbers to the right; nothing is wrapped or cut.

    A row's mark stands on a line of its own below its third cell, where it widens no column.
    """
    # Headings as rows, because tabulate makes every column two characters wider than its heading.
    heads = [line for line in zip(*table.headings, strict=True) if any(line)]
    rows = [*heads, SEPARATING_LINE, *(tuple(map(printable, row)) for row in table.rows)]
    text = tabulate(rows, tablefmt=_PLAIN_TEXT, colalign=_sides(table), disable_numparse=True)
    lines = [line.rstrip() for line in text.splitlines()]
    if any(table.marks):
        lines = [*lines[: -len(table.rows)], *_marked(lines[-len(table.rows) :], table)]
    return "\n".join([*lines, *(["", *map(printable, table.under)] if table.under else [])])


def _marked(lines: list[str], table: Table) -> Iterator[str]:
    """Yield the lines of the rows, each followed by its mark if it has one."""
    names, outputs = (
        max(len(printable(text)) for text in (*table.headings[i], *(row[i] for row in table.rows))) for i in (0, 1)
    )
    indent = " " * (names + outputs + 2 * len(_CELLS.sep))
    for line, mark in zip(lines, table.marks, strict=True):
        yield line
        if mark:
            yield indent + mark


def as_markdown(table: Table) -> str:
    """Return the table in Markdown; units stand in brackets behind the names."""
    heads = [_in_one_line(lines) for lines in table.headings]
    marks = table.marks or ("",) * len(table.rows)
    labelled = (_with_mark(row, mark) for row, mark in zip(table.rows, marks, strict=True))
    plain = [(*map(in_markdown, row[: table.labels]), *row[table.labels :]) for row in labelled]
    rows = [
        tuple(f"**{text}**" if (i, j) in table.best else text for j, text in enumerate(row))
        for i, row in enumerate(plain)
    ]
    text = tabulate(rows, heads, "pipe", colalign=_sides(table), disable_numparse=True)
    return "\n\n".join(filter(None, (text, "\n".join(f"- {in_markdown(line)}" for line in table.under))))


def as_latex(table: Table) -> str:
    """Return the table as LaTeX of the package booktabs; units stand in brackets, the best cells are bold."""
    sides = "".join(side[0] for side in _sides(table))
    heads = " & ".join(_in_latex(_in_one_line(lines)) for lines in table.headings)
    rows = [" & ".join(_latex_cells(table, i)) for i in range(len(table.rows))]
    lines = [rf"\begin{{tabular}}{{{sides}}}", r"\toprule", rf"{heads} \\", r"\midrule"]
    return "\n".join([*lines, *(rf"{row} \\" for row in rows), r"\bottomrule", r"\end{tabular}"])


def _latex_cells(table: Table, row: int) -> Iterator[str]:
    for column, text in enumerate(table.rows[row]):
        escaped = _in_latex(text)
        yield rf"\textbf{{{escaped}}}" if (row, column) in table.best else escaped


def _in_latex(text: str) -> str:
    """Return a text that LaTeX prints as it is."""
    return "".join(_LATEX.get(character, character) for character in printable(text))


def _in_one_line(heading: tuple[str, ...]) -> str:
    """Return a heading in one line, the unit in brackets; a word divided by a hyphen becomes whole."""
    *words, unit = heading
    name = " ".join(filter(None, words)).replace("- ", "-")
    return f"{name} [{unit}]" if unit else name


def _with_mark(row: tuple[str, ...], mark: str) -> tuple[str, ...]:
    return (*row[:2], f"{row[2]}, {mark}", *row[3:]) if mark else row


def _sides(table: Table) -> list[Literal["left", "right"]]:
    return ["left" if i < table.labels else "right" for i in range(len(table.headings))]


def _values(comparison: Comparison, metric: Metric) -> list[float | None]:
    return [row.value(metric.key) for row in comparison.lines]
