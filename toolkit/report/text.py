"""How a report writes words, numbers and tables: for a terminal, in Markdown, HTML and LaTeX.

Numbers have three significant digits; lengths of centimetres and less are in millimetres, a whole column in one unit.
Lines are wrapped to the width of a terminal, and whole where they go into a file or a pipe. tabulate lays tables out.
"""

import csv
import html
import io
import math
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator
from shutil import get_terminal_size
from typing import Literal, NamedTuple

from tabulate import SEPARATING_LINE, DataRow, Line, TableFormat, tabulate

from toolkit.errors import printable
from toolkit.metrics import Metric

# Widest table and text; on a terminal, text has its width, but at least 40 columns.
WIDTH, _NARROWEST = 100, 40
Width = int | None
_LABEL = 7
# An underscore inside a word is none; a minus, a plus or a number is one only at the beginning of a line.
_MARKUP = re.compile(r"[\\`*<>\[\]|&]|(?<!\w)_|_(?!\w)|^[#~+-]|^\d+(?=[.)] )")
# More names than these are counted, not listed.
_MOST_NAMES = 4
MISSING = "-"
DIGITS = 3
# Numbers outside of these are written in powers of ten: that of a diverged estimator may have any size.
_SMALLEST, _LARGEST = 1e-3, 1e5
# A column of lengths is in millimetres where most are below the first and all below the second (m).
_SHORT_M, _LONGEST_IN_MM = 0.1, 10.0
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


def width_of_output() -> Width:
    """Return the width of text on standard output: None where it is not a terminal."""
    if not sys.stdout.isatty():
        return None
    return min(max(get_terminal_size((WIDTH, 24)).columns, _NARROWEST), WIDTH)


def filled(text: str, width: Width, first: str = "", further: str = "  ") -> str:
    text = printable(text)
    if width is None:
        return first + text
    return textwrap.fill(text, width, initial_indent=first, subsequent_indent=further)


def in_markdown(text: str) -> str:
    """Return a text in one line that Markdown shows as it is: no markup, no table, no HTML, nothing that acts."""
    return _MARKUP.sub(r"\\\g<0>", printable(text))


def markdown_section(title: str, entries: Iterable[str]) -> Iterator[str]:
    """Yield the heading and the list of a section of Markdown, each a paragraph; nothing where there is no entry."""
    lines = [f"- {in_markdown(entry)}" for entry in entries]
    if lines:
        yield f"## {title}"
        yield "\n".join(lines)


def section(title: str, entries: Iterable[str], width: Width) -> Iterator[str]:
    for i, entry in enumerate(entries):
        label = f"{title}:" if i == 0 else ""
        yield filled(entry, width, f"{label:<{_LABEL}}", " " * (_LABEL + 2))


def listed(names: Iterable[str], most: int = _MOST_NAMES) -> str:
    """Return names as in a sentence, as "a, b and c", or of more than ``most`` as "a, b, c and 4 more"."""
    given = list(dict.fromkeys(names)) or [""]
    if len(given) > most:
        given = [*given[: most - 1], f"{len(given) - most + 1} more"]
    return " and ".join(filter(None, (", ".join(given[:-1]), given[-1])))


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


class ShownUnit(NamedTuple):
    """The unit of a column, and how many of it one of the metric's own unit is."""

    name: str
    factor: float = 1.0


def unit_of(metric: Metric, values: Iterable[float | None]) -> ShownUnit:
    """Return the unit in which the values of a metric that stand in one column are written."""
    sizes = sorted(abs(value) for value in values if value is not None)
    if metric.unit == "m" and sizes and sizes[len(sizes) // 2] < _SHORT_M and sizes[-1] < _LONGEST_IN_MM:
        return ShownUnit("mm", 1e3)
    return ShownUnit(metric.unit)


def heading(metric: Metric, unit: ShownUnit) -> tuple[str, str, str]:
    return (*metric.heading, unit.name)


def cell(value: float | None, metric: Metric, unit: ShownUnit | None = None) -> str:
    """Return a metric's value as it stands in a table, in the metric's own unit unless another is given."""
    if value is None:
        return MISSING
    scaled = value if unit is None else unit.factor * value
    return f"{scaled:.0f}" if metric.count else number(scaled)


def number(value: float, digits: int = DIGITS) -> str:
    """Return a number with ``digits`` significant digits, its whole part in full, in powers of ten where extreme."""
    if value == 0.0:
        return "0"
    if abs(value) >= _LARGEST or not math.isfinite(value):
        return f"{value:.0e}"
    if abs(value) < _SMALLEST:
        return f"{value:.1e}".replace("e-0", "e-")
    # After rounding, for 9.996 has one digit before the point and 10.0 two.
    exponent = math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    return f"{value:.{max(0, digits - 1 - exponent)}f}"


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
    names, outputs = (
        max(len(printable(text)) for text in (*table.headings[i], *(row[i] for row in table.rows))) for i in (0, 1)
    )
    indent = " " * (names + outputs + 2 * len(_CELLS.sep))
    for line, mark in zip(lines, table.marks, strict=True):
        yield line
        if mark:
            yield indent + mark


def as_markdown(table: Table) -> str:
    """Return the table in Markdown; units stand in brackets behind the names, the best cells are bold."""
    marks = table.marks or ("",) * len(table.rows)
    marked = [
        (*row[:2], f"{row[2]}, {mark}", *row[3:]) if mark else row for row, mark in zip(table.rows, marks, strict=True)
    ]
    escaped = tuple((*map(in_markdown, row[: table.labels]), *row[table.labels :]) for row in marked)
    rows = _cells(table._replace(rows=escaped), str, "**{}**")
    heads = [_in_one_line(lines) for lines in table.headings]
    text = tabulate(rows, heads, "pipe", colalign=_sides(table), disable_numparse=True)
    return "\n\n".join(filter(None, (text, "\n".join(f"- {in_markdown(line)}" for line in table.under))))


def as_html(table: Table) -> str:
    """Return the table as an element of HTML; units stand in brackets behind the names, the best cells are bold."""
    heads = [in_html(_in_one_line(lines)) for lines in table.headings]
    rows = _cells(table, in_html, '<b class="best">{}</b>')
    return str(tabulate(rows, heads, "unsafehtml", colalign=_sides(table), disable_numparse=True))


def as_csv(heads: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return lines of values in full, numbers as Python writes them; None is nothing."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(heads)
    for row in rows:
        writer.writerow(["" if value is None else value if isinstance(value, str) else repr(value) for value in row])
    return out.getvalue()


def as_latex(table: Table) -> str:
    """Return the table as LaTeX of the package booktabs; units stand in brackets, the best cells are bold."""
    sides = "".join(side[0] for side in _sides(table))
    heads = " & ".join(_in_latex(_in_one_line(lines)) for lines in table.headings)
    rows = [" & ".join(row) for row in _cells(table, _in_latex, r"\textbf{{{}}}")]
    lines = [rf"\begin{{tabular}}{{{sides}}}", r"\toprule", rf"{heads} \\", r"\midrule"]
    return "\n".join([*lines, *(rf"{row} \\" for row in rows), r"\bottomrule", r"\end{tabular}"])


def _cells(table: Table, escaped: Callable[[str], str], bold: str) -> list[list[str]]:
    return [
        [bold.format(escaped(text)) if (i, j) in table.best else escaped(text) for j, text in enumerate(row)]
        for i, row in enumerate(table.rows)
    ]


def in_html(text: str) -> str:
    return html.escape(printable(text))


def _in_latex(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in printable(text))


def _in_one_line(heading: tuple[str, ...]) -> str:
    """Return a heading in one line, the unit in brackets; a word divided by a hyphen becomes whole."""
    *words, unit = heading
    name = " ".join(filter(None, words)).replace("- ", "-")
    return f"{name} [{unit}]" if unit else name


def _sides(table: Table) -> list[Literal["left", "right"]]:
    return ["left" if i < table.labels else "right" for i in range(len(table.headings))]
