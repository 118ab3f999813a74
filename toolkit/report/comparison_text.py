"""A comparison as text: as it is printed, and as ``report.md``; the findings of an audit, and a verification, alone.

Below the table stand the verdict and the most harmful notes; the report has everything needed to read the table.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from toolkit.audit import Audit
from toolkit.errors import printable
from toolkit.experiment.comparison import Comparison
from toolkit.metrics import known_metrics
from toolkit.report.card import card_lines
from toolkit.report.comparison_table import Columns, comparison_table, explained_metrics, header_lines, sequence_line
from toolkit.report.messages import (
    consistency_lines,
    finding_lines,
    log_lines,
    note_lines,
    outcome,
    remark_lines,
    undecided_lines,
    verdict,
)
from toolkit.report.text import (
    WIDTH,
    Table,
    Width,
    as_csv,
    as_latex,
    as_markdown,
    as_text,
    filled,
    in_markdown,
    markdown_section,
    section,
)

if TYPE_CHECKING:
    from toolkit.verify import VerificationRecord

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


def audit_text(audited: Audit, width: Width = WIDTH) -> str:
    findings = audited.findings
    lines = [printable(sequence_line(audited.sequence)), ""]
    if findings:
        headings = (("fault",), ("outcome",), ("count",))
        rows = tuple((f.fault, outcome(f), str(f.count)) for f in findings)
        lines += [as_text(Table(headings, rows, labels=2)), ""]
        lines += [filled(f"{finding.fault}: {finding.detail}", width) for finding in findings]
    else:
        lines += ["no fault found"]
    lines += [filled(line, width) for line in undecided_lines(audited.undecided)]
    lines += section("facts", audited.sequence.provenance.facts, width)
    if findings and not audited.undecided and not any(f.blocking or f.warning for f in findings):
        lines += ["", "no fault is left that invalidates a result"]
    return "\n".join(lines)


def verification_text(verification: "VerificationRecord", width: Width = WIDTH) -> str:
    rows = tuple((check.name, check.result) for check in verification.checks)
    lines = [as_text(Table((("promise",), ("result",)), rows, labels=2)), ""]
    for check in verification.checks:
        if check.result == "failed":
            lines += [filled(f"{check.name}: {check.found}", width), filled(check.remedy, width, "  to do: "), ""]
        elif check.found:
            lines += [filled(f"{check.name}: {check.found}", width), ""]
    failed = sum(check.result == "failed" for check in verification.checks)
    verdict = "keeps every promise" if not failed else f"breaks {failed} of {len(verification.checks)} promises"
    return "\n".join([*lines, f"{verification.estimator} {verdict}"])
