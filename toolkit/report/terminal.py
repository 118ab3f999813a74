"""What a comparison prints: the table, and under it everything a reader must know before believing it."""

from collections.abc import Mapping

from toolkit.audit import Audit, Finding
from toolkit.errors import printable
from toolkit.experiment.comparison import Comparison
from toolkit.report.card import card_lines
from toolkit.report.header import header_lines, sequence_line
from toolkit.report.messages import (
    consistency_lines,
    finding_lines,
    note_lines,
    outcome,
    paired_lines,
    undecided_lines,
)
from toolkit.report.prose import WIDTH, Width, filled, section
from toolkit.report.table import Columns, Table, as_text, comparison_table

_INDENT = "  "


def comparison_text(comparison: Comparison, columns: Columns = None, width: Width = WIDTH) -> str:
    """Return the comparison as plain text, its prose no wider than ``width``; the table is never wrapped or cut.

    Raises VislamError for an unknown column.
    """
    lines = [filled(entry, width) for entry in header_lines(comparison, columns)]
    lines += ["", as_text(comparison_table(comparison, columns)), ""]
    lines += section("start", [comparison.prior.source], width)
    lines += section("audit", finding_lines(comparison), width)
    lines += section("facts", comparison.sequence.provenance.facts, width)
    if comparison.card is not None:
        lines += section("card", card_lines(comparison.card), width)
    lines += section("pairs", paired_lines(comparison), width)
    lines += section("nees", consistency_lines(comparison), width)
    lines += section("notes", note_lines(comparison, columns), width)
    return "\n".join(lines)


def audit_text(audited: Audit, width: Width = WIDTH) -> str:
    """Return what the audit found as plain text: fault, count, outcome, and the details below each."""
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
    if any(f.blocking for f in findings):
        lines += ["", *_spoiling(findings)]
    elif any(f.warning for f in findings):
        lines += ["", f"results have to be read with this in mind: {', '.join(f.fault for f in findings if f.warning)}"]
    elif findings and not audited.undecided:
        lines += ["", "nothing is left that spoils a result"]
    return "\n".join(lines)


def _spoiling(findings: tuple[Finding, ...]) -> list[str]:
    """Return a line for each way in which findings spoil a result, with their names."""
    by_outcome = {how: [f.fault for f in findings if outcome(f) == how] for how in ("not repaired", "too much lost")}
    return [f"{how}: {', '.join(names)}" for how, names in by_outcome.items() if names]


def listing_text(title: str, entries: Mapping[str, str], width: Width = WIDTH) -> str:
    """Return names with their one-line summaries under a title."""
    longest = max((len(name) for name in entries), default=0)
    further = " " * (longest + 2 * len(_INDENT))
    lines = (filled(text, width, f"{_INDENT}{name:<{longest}}{_INDENT}", further) for name, text in entries.items())
    return "\n".join([f"{title}:", *(line.rstrip() for line in lines)])
