"""What a comparison prints: the table, and under it everything a reader must know before believing it."""

import textwrap
from collections.abc import Iterable, Iterator, Mapping

from tabulate import tabulate

from toolkit.audit import Audit
from toolkit.experiment.comparison import Comparison
from toolkit.report.messages import consistency_lines, finding_lines, header_lines, note_lines, outcome, sequence_line
from toolkit.report.table import Columns, Table, as_text, comparison_table

_WIDTH = 100
_INDENT = "  "


def comparison_text(comparison: Comparison, columns: Columns = None) -> str:
    """Return the comparison as plain text, no line of prose wider than 100 columns.

    Raises VislamError for an unknown column.
    """
    lines = [line for entry in header_lines(comparison, columns) for line in _wrapped(entry)]
    lines += ["", as_text(comparison_table(comparison, columns)), ""]
    lines += _section("start", [comparison.prior.source])
    lines += _section("audit", finding_lines(comparison))
    lines += _section("facts", comparison.sequence.provenance.facts)
    lines += _section("nees", consistency_lines(comparison))
    lines += _section("notes", note_lines(comparison, columns))
    return "\n".join(lines)


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, subsequent_indent="  ")


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
    headings = (("fault",), ("outcome",), ("count",))
    rows = tuple((f.fault, outcome(f), str(f.count)) for f in findings)
    lines += [as_text(Table(headings, rows, labels=2)), ""]
    for finding in findings:
        lines += _wrapped(f"{finding.fault}: {finding.detail}")
    left = [f.fault for f in findings if f.blocking]
    lines += ["", f"not repaired: {', '.join(left)}" if left else "nothing is left that spoils a result"]
    return "\n".join(lines)


def listing_text(title: str, entries: Mapping[str, str]) -> str:
    """Return names with their one-line summaries under a title."""
    width = max((len(name) for name in entries), default=0)
    columns = [None, _WIDTH - width - 2 * len(_INDENT)]
    text = tabulate(entries.items(), tablefmt="plain", maxcolwidths=columns, disable_numparse=True)
    return "\n".join([f"{title}:", *(f"{_INDENT}{line}".rstrip() for line in text.splitlines())])
