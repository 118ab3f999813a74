"""Tables for a terminal, for Markdown and for LaTeX, and a metric's heading and value as they stand in one.

Under which heading and with how many decimals is said by the metrics' own records; tabulate renders the cells.
"""

from collections.abc import Iterator
from typing import Literal, NamedTuple

from tabulate import SEPARATING_LINE, DataRow, Line, TableFormat, tabulate

from toolkit.errors import printable
from toolkit.metrics import Metric
from toolkit.report.prose import in_markdown

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
