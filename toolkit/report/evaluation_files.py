"""The directory an evaluation leaves behind: ``evaluation.json``, runs as CSV, the leaderboard in Markdown and HTML.

The page is one HTML file that opens from disk, in the style of the report's page.
"""

import math
from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

from toolkit.errors import DataError
from toolkit.evaluation.document import evaluation_document, read_evaluation
from toolkit.evaluation.standings import EvaluatedRun, EvaluatedSystems
from toolkit.files.documents import to_text
from toolkit.files.writing import check_replaceable, replaced_directory
from toolkit.report.evaluation_text import (
    evaluation_csv,
    evaluation_markdown,
    failure_lines,
    header_lines,
    leaderboard_table,
    note_lines,
    paired_lines,
    sequences_table,
)
from toolkit.report.text import Table, as_html, in_html

EVALUATION = "evaluation.json"
_FILES = (EVALUATION, "leaderboard.html", "leaderboard.md", "runs.csv")
# Of the figure, in its own units: room for names, for dots, between rows; and how many lines of colour there are.
_NAMES, _DOTS, _MARGIN, _ROW, _COLOURS = 190.0, 660.0, 60.0, 15.0, 7
_STYLE = """
main { padding: 1rem clamp(.75rem, 3vw, 2rem); display: grid; gap: var(--gap); max-width: 90rem; margin: 0 auto; }
.card > h2 { margin-bottom: .5rem; }
.scroll { overflow-x: auto; }
thead th { padding: .35rem .55rem; font-size: .84rem; white-space: normal; line-height: 1.25; min-width: 3.6rem; }
th:first-child, td:first-child { text-align: left; font-weight: 600; }
figure { margin: 0; }
svg text { fill: var(--text); font-size: 11px; }
svg .grid { stroke: var(--grid); }
svg .failed { stroke: var(--bad); stroke-width: 1.6; }
.key { display: inline-flex; gap: .4rem; align-items: center; margin-right: 1rem; font-size: .85rem; }
.key i { width: .7rem; height: .7rem; border-radius: 50%; }
"""
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'">
<title>{title} - vislam leaderboard</title>
<style>
{style}
</style>
</head>
<body>
<header class="top"><div><span class="brand">vislam leaderboard</span><h1>{title}</h1></div></header>
<main>
{cards}
</main>
</body>
</html>
"""


def check_evaluation_directory(target: Path) -> None:
    """Raise OutputError unless an evaluation can be written at ``target`` without the loss of anybody's files."""
    check_replaceable(target, _written_by_us)


def write_evaluation(evaluation: EvaluatedSystems, target: Path) -> None:
    """Write the directory, in the place of an earlier one; raises OutputError where that cannot be."""
    texts = (
        to_text(evaluation_document(evaluation)),
        leaderboard_page(evaluation),
        evaluation_markdown(evaluation),
        evaluation_csv(evaluation),
    )
    with replaced_directory(target, _written_by_us) as directory:
        for name, text in zip(_FILES, texts, strict=True):
            (directory / name).write_text(text, encoding="utf-8")


def _written_by_us(directory: Path) -> frozenset[str]:
    """Return what in a directory an earlier evaluation wrote; nothing where its document is none of ours."""
    try:
        read_evaluation(directory / EVALUATION)
    except DataError:
        return frozenset()
    return frozenset(_FILES)


def leaderboard_page(evaluation: EvaluatedSystems) -> str:
    """Return the page: leaderboard, a table by sequence, every run as a dot, tests, failures and notes."""
    title = f"{' / '.join(evaluation.systems)} on {', '.join(evaluation.sequences[:3])}"
    if len(evaluation.sequences) > 3:
        title += f" and {len(evaluation.sequences) - 3} more"
    cards = [_card("Leaderboard", _paragraphs(header_lines(evaluation)) + _html_table(leaderboard_table(evaluation)))]
    if len(evaluation.sequences) > 1:
        name = f"{evaluation.ranked_by.name} by sequence, median over the runs"
        cards.append(_card(name, _html_table(sequences_table(evaluation))))
    cards.append(_card(f"{evaluation.ranked_by.name} of every run", _figure(evaluation)))
    for heading, lines in (
        ("Is it more than chance?", paired_lines(evaluation)),
        ("Runs that failed", failure_lines(evaluation, None)),
        ("Notes", note_lines(evaluation)),
    ):
        entries = "".join(f"<li>{in_html(line)}</li>" for line in lines)
        cards += [_card(heading, f"<ul>{entries}</ul>")] if entries else []
    style = files("toolkit.report.html").joinpath("style.css").read_text(encoding="utf-8") + _STYLE
    return _PAGE.format(title=in_html(title), style=style, cards="\n".join(cards))


def _html_table(table: Table) -> str:
    return f'<div class="scroll">{as_html(table)}</div>'


def _card(title: str, body: str) -> str:
    return f'<section class="card"><h2>{in_html(title)}</h2>{body}</section>'


def _paragraphs(lines: Iterable[str]) -> str:
    return "".join(f'<p class="fine">{in_html(line)}</p>' for line in lines)


def _figure(evaluation: EvaluatedSystems) -> str:
    """Return every run as a dot, a row a sequence and system, on a logarithmic scale; a cross is one that failed."""
    rows = [(sequence, system) for sequence in evaluation.sequences for system in evaluation.systems]
    values = [v for run in evaluation.runs if run.status == "ok" and (v := _value(run, evaluation)) is not None]
    if not values:
        return '<p class="fine">No run has a value.</p>'
    low, high = math.floor(math.log10(min(values))), math.ceil(math.log10(max(values)))
    scale = _DOTS / max(high - low, 1)
    height = _ROW * len(rows) + 34.0
    marks = []
    for decade in range(low, max(high, low + 1) + 1):
        x = _NAMES + scale * (decade - low)
        marks.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="4" y2="{height - 22:.1f}"/>')
        marks.append(f'<text x="{x:.1f}" y="{height - 6:.1f}" text-anchor="middle">{10.0**decade:g}</text>')
    for i, (sequence, system) in enumerate(rows):
        y, colour = 10.0 + _ROW * (i + 0.5), evaluation.systems.index(system) % _COLOURS
        if i % len(evaluation.systems) == 0:
            marks.append(f'<text x="0" y="{y + 4:.1f}">{in_html(sequence[:30])}</text>')
        for run in evaluation.cells[system, sequence].runs:
            value = _value(run, evaluation)
            title = f"<title>{in_html(_named(run, value))}</title>"
            if run.status == "ok" and value is not None:
                x = _NAMES + scale * (math.log10(value) - low)
                style = f'style="fill:var(--line-{colour});fill-opacity:.75"'
                marks.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" {style}>{title}</circle>')
            elif run.status != "ok":
                x = _NAMES + _DOTS + 0.5 * _MARGIN
                cross = f"M{x - 4:.1f} {y - 4:.1f}l8 8m0 -8l-8 8"
                marks.append(f'<path class="failed" d="{cross}">{title}</path>')
    keys = "".join(
        f'<span class="key"><i style="background:var(--line-{i % _COLOURS})"></i>{in_html(system)}</span>'
        for i, system in enumerate(evaluation.systems)
    )
    unit = f" [{evaluation.ranked_by.unit}]" if evaluation.ranked_by.unit else ""
    label = f"{evaluation.ranked_by.name}{unit} of every run, logarithmic; a cross is a run that failed"
    box = f"0 0 {_NAMES + _DOTS + _MARGIN:.0f} {height:.0f}"
    drawing = f'<svg viewBox="{box}" role="img" aria-label="{in_html(label)}">{"".join(marks)}</svg>'
    return f'<figure>{keys}{drawing}<figcaption class="fine">{in_html(label)}</figcaption></figure>'


def _value(run: EvaluatedRun, evaluation: EvaluatedSystems) -> float | None:
    value = run.values.get(evaluation.ranked_by.key)
    return value if value is not None and value > 0.0 else None


def _named(run: EvaluatedRun, value: float | None) -> str:
    entry = run.log[0] if run.status != "ok" else f"{value:.4g}" if value is not None else "no value"
    return f"{run.item.system}, {run.item.sequence}, {run.item.run}: {entry}"
