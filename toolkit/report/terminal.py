"""What a comparison prints: the table, and under it everything a reader must know before believing it."""

import textwrap
from collections.abc import Iterable, Iterator, Mapping

from toolkit.audit import Audit
from toolkit.experiment.comparison import Comparison
from toolkit.report.messages import finding_lines, missing_lines, outcome, sequence_line, status_lines, truth_lines
from toolkit.report.seeds_md import seeds_text
from toolkit.report.table import as_text, comparison_table

_WIDTH = 118


def comparison_text(comparison: Comparison) -> str:
    """Return the comparison as plain text, no line of prose wider than 118 columns."""
    if comparison.over_seeds:
        return seeds_text(comparison)
    lines = [sequence_line(comparison.sequence), "", as_text(comparison_table(comparison)), ""]
    lines += _section("start", [comparison.prior.source])
    lines += _section("audit", finding_lines(comparison))
    lines += _section("facts", comparison.sequence.provenance.facts)
    lines += _section("notes", [*status_lines(comparison), *truth_lines(comparison), *missing_lines(comparison)])
    return "\n".join(lines)


def _section(title: str, entries: Iterable[str]) -> Iterator[str]:
    for i, entry in enumerate(entries):
        label = f"{title}:" if i == 0 else ""
        yield textwrap.fill(entry, _WIDTH, initial_indent=f"{label:<7}", subsequent_indent=" " * 9)


def audit_text(audited: Audit) -> str:
    """Return what the audit found as plain text: fault, count, outcome, and the details below each."""
    findings = audited.findings
    lines = [sequence_line(audited.sequence), ""]
    if not findings:
        return "\n".join([*lines, "no fault found"])
    heading = ("fault", "count", "outcome", "detail")
    cells = [(f.fault, str(f.count), outcome(f), f.detail) for f in findings]
    widths = [max(len(row[i]) for row in (heading, *cells)) for i in range(3)]
    for fault, count, done, detail in (heading, *cells):
        start = f"{fault:<{widths[0]}}  {count:>{widths[1]}}  {done:<{widths[2]}}  "
        lines.append(textwrap.fill(detail, _WIDTH, initial_indent=start, subsequent_indent=" " * len(start)))
    left = [f.fault for f in findings if f.blocking]
    lines += ["", f"not repaired: {', '.join(left)}" if left else "nothing is left that spoils a result"]
    return "\n".join(lines)


def listing_text(title: str, entries: Mapping[str, str]) -> str:
    """Return names with their one-line summaries under a title."""
    width = max((len(name) for name in entries), default=0)
    lines = [f"{title}:"]
    for name, summary in entries.items():
        start = f"  {name:<{width}}  "
        lines.append(
            textwrap.fill(summary, _WIDTH, initial_indent=start, subsequent_indent=" " * len(start)) or start.rstrip()
        )
    return "\n".join(lines)
