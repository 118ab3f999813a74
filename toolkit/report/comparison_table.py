"""The table of a comparison, and the comparison as text: as it is printed, and as ``report.md``.

Below the table stand the verdict and the most harmful notes; the report has everything needed to read the table.
"""

from collections.abc import Iterable, Iterator, Mapping

from toolkit.errors import printable
from toolkit.experiment.comparison import Comparison
from toolkit.metrics import known_metrics
from toolkit.report.card import card_lines
from toolkit.report.headers import Columns, explained_metrics, header_lines, shown_metrics
from toolkit.report.messages import consistency_lines, finding_lines, log_lines, note_lines, remark_lines, verdict
from toolkit.report.text import (
    MISSING,
    WIDTH,
    Table,
    Width,
    as_csv,
    as_latex,
    as_markdown,
    as_text,
    cell,
    filled,
    heading,
    in_markdown,
    markdown_section,
    number,
    section,
    unit_of,
)

# The metric whose mean over seeds is compared with its band, in a column after that of the mean.
_BANDED = "nees_pose_mean"
# Notes below the printed table; the report has all.
_MOST_NOTES = 3

_HOW_TO_READ_ONE = """\
Every estimator read the same packets, with the same noise, from the same start. A **causal** line is scored on what the
estimator estimated at each frame, a **final** line on its answer after the last frame; compare like with like. A line
named for a file, as in `openvins (est.txt)`, was not run here but read from it and scored by the same rules. An error
over half a recording is not half an error: read it beside the matched pairs and the coverage. `metrics.json` has every
metric, and for each one that is missing the reason."""
_HOW_TO_READ_MANY = """\
Every estimator read the same recording under each seed; the seed draws every error, the trajectory stays. Numbers are
means over the runs that are ok; `seeds.json` has each seed's value of every metric, and quartiles over all runs. The
NEES band is the share of the frames at which the pose NEES averaged over the seeds lies within the two-sided 95 %
chi-square band for that many runs: 95 % on average for a consistent estimator, with much scatter between sets of
seeds."""
_HOW_TO_READ = """\
Beside how a run ended, `overconfident` and `timid` say that its errors, or without a truth its innovations, are larger
or smaller than the uncertainty it states allows; `heavy-tailed` and `contradicted` are in the notes.

The verdict names a winner only where a paired test supports it: over seeds by the seeds, of one run by the drift over
up to 40 stretches of the path, or by withheld tracks in ten stretches of time. Each interval has 99 %.

What no estimator is given: withheld tracks, and in a causal answer the future; only the start of raw IMU recordings
uses the first 1.5 s, and the audit the whole recording, the same for all."""


def comparison_table(comparison: Comparison, columns: Columns = None) -> Table:
    """Return one row for each kind of output that differs from the others of its estimator.

    Over seeds a cell is the mean over the runs that are ok. Under the table of a ladder stands what each estimator
    changes. Raises VislamError for an unknown column.
    """
    lines, chosen = comparison.lines, list(_columns(comparison, columns))
    cells = zip(*(column for _, column in chosen), strict=True)
    rows = tuple((row.estimator, row.label, *of_row) for row, of_row in zip(lines, cells, strict=True))
    headings = (("estimator", "", ""), ("output", "", ""), *(head for head, _ in chosen))
    under = change_lines((name, comparison.changes.get(name, "")) for name in comparison.estimators)
    return Table(headings, rows, 2 if comparison.over_seeds else 3, tuple(under), tuple(row.mark for row in lines))


def _columns(comparison: Comparison, columns: Columns) -> Iterator[tuple[tuple[str, ...], list[str]]]:
    """Yield the heading and the cells of each column: how runs ended, then the metrics.

    Over seeds also the spread of the first metric, and how long the NEES is in its band.
    """
    lines = comparison.lines
    if comparison.over_seeds:
        yield ("ok", "of", str(len(comparison.seeds))), [str(row.counts["ok"]) for row in lines]
    else:
        yield ("status", "", ""), [row.status for row in lines]
    for i, metric in enumerate(shown_metrics(comparison, columns)):
        unit = unit_of(metric, (row.value(metric.key) for row in lines if row.counts["ok"]))
        yield heading(metric, unit), [cell(row.value(metric.key), metric, unit) for row in lines]
        if comparison.over_seeds and i == 0:
            spreads = [row.spread(metric.key) for row in lines]
            stds = [cell(None if spread is None else spread.std, metric, unit) for spread in spreads]
            yield (metric.heading[0], "std", unit.name), stds
        if comparison.over_seeds and metric.key == _BANDED:
            means = [row.mean_nees for row in lines]
            yield ("NEES", "band", "%"), [MISSING if nees is None else number(nees.in_band_percent) for nees in means]


def change_lines(changes: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield an aligned line for each estimator with its change against the rung before; none outside a ladder."""
    given = [(name, change) for name, change in changes if change]
    width = max((len(name) for name, _ in given), default=0)
    for name, change in given:
        yield f"{name:<{width}}  {change}"


def comparison_text(comparison: Comparison, columns: Columns = None, width: Width = WIDTH) -> str:
    """Return the comparison as plain text, its prose no wider than ``width``; the table is never wrapped or cut.

    Raises VislamError for an unknown column.
    """
    lines = [filled(entry, width) for entry in header_lines(comparison, columns)]
    lines += ["", as_text(comparison_table(comparison, columns)), "", filled(verdict(comparison), width, further="")]
    notes = list(note_lines(comparison, columns))
    shown = notes[:_MOST_NOTES]
    if notes[_MOST_NOTES:]:
        shown[-1] += f" ({len(notes) - _MOST_NOTES} more in report.md)"
    lines += section("notes", shown, width)
    if comparison.card is not None:
        lines += section("card", card_lines(comparison.card), width)
    return "\n".join(lines)


def comparison_markdown(comparison: Comparison, columns: Columns = None) -> str:
    """Return the recording, the rules, the table and the verdict as Markdown; raises VislamError as the table does."""
    table = as_markdown(comparison_table(comparison, columns))
    lines = [in_markdown(line) + "." for line in header_lines(comparison, columns)]
    return "\n\n".join([*lines, table, in_markdown(verdict(comparison))])


def comparison_latex(comparison: Comparison, columns: Columns = None) -> str:
    """Return the table for a paper, after comments with recording and rules; the package booktabs is needed."""
    comments = [f"% {printable(line)}" for line in header_lines(comparison, columns)]
    return "\n".join([*comments, as_latex(comparison_table(comparison, columns))])


def comparison_csv(comparison: Comparison) -> str:
    """Return a line a row of the table with every metric in full: over seeds means over the runs that are ok."""
    keys = [metric.key for metric in known_metrics()]
    rows = (
        [comparison.name, row.estimator, row.label, len(row.outcomes), row.counts["ok"], *map(row.value, keys)]
        for row in comparison.lines
    )
    return as_csv(["sequence", "estimator", "output", "runs", "ok", *keys], rows).rstrip("\n")


def report_text(comparison: Comparison, captions: Mapping[str, str]) -> str:
    """Return the report; ``captions`` maps the file names of the figures, beside the report, to their captions."""
    seeds = f", {len(comparison.seeds)} seeds" if comparison.over_seeds else ""
    parts = [
        f"# {in_markdown(' / '.join(comparison.estimators) + ' on ' + comparison.name)}{seeds}",
        *(f"{in_markdown(line)}." for line in header_lines(comparison)),
        as_markdown(comparison_table(comparison)),
        f"**{in_markdown(verdict(comparison))}**",
        *markdown_section("Is the stated uncertainty consistent?", consistency_lines(comparison)),
        *markdown_section("Notes", note_lines(comparison)),
        *markdown_section("Remarks on single numbers", remark_lines(comparison)),
        *markdown_section("What the estimators report", log_lines(comparison)),
        *markdown_section("Where every estimator started", [comparison.prior.source]),
        *markdown_section("What the audit found in the recording", finding_lines(comparison)),
        *markdown_section("About this recording", comparison.sequence.provenance.facts),
        *markdown_section("Its tracks", () if comparison.card is None else card_lines(comparison.card)),
        "## Figures",
        *(f"![{in_markdown(said)}](figures/{name})\n\n*{in_markdown(said)}*" for name, said in captions.items()),
        "## How to read the table",
        _HOW_TO_READ_MANY if comparison.over_seeds else _HOW_TO_READ_ONE,
        _HOW_TO_READ,
        "\n".join(f"- **{metric.name}**: {metric.meaning}" for metric in explained_metrics(comparison)),
        "`vislam report` with the path of this folder makes an interactive page of it.",
    ]
    return "\n\n".join(parts) + "\n"
