"""A check of the gate as a table: a row a comparison, the same cells for plain text and for Markdown."""

from toolkit.gate.bounded import SHOWN
from toolkit.gate.verdict import Check, Verdict
from toolkit.report.table import Table, number

_MISSING = "-"
_LABELS = (("sequence", "", ""), ("estimator", "", ""), ("output", "", ""), ("metric", "", ""), ("finding", "", ""))
_NUMBERS = (
    ("before", "", ""),
    ("now", "", ""),
    ("change", "", "%"),
    ("allowed", "", "%"),
    ("sees", "", "%"),
    ("p", "", ""),
)


def gate_table(check: Check) -> Table:
    """Return every verdict of a check."""
    return Table((*_LABELS, *_NUMBERS), tuple(map(_row, check.verdicts)), labels=len(_LABELS))


def failures_table(check: Check) -> Table:
    """Return what the check fails for, with the reason in words."""
    rows = tuple((*_row(verdict), _escaped(verdict.words)) for verdict in check.failures)
    headings = (*_LABELS, *_NUMBERS, ("why", "", ""))
    return Table(headings, rows, labels=len(_LABELS))


def _row(verdict: Verdict) -> tuple[str, ...]:
    labels = (verdict.sequence, verdict.estimator, verdict.output, verdict.metric, verdict.finding)
    numbers = (
        _value(verdict.before),
        _value(verdict.after),
        _percent(verdict.change_percent, sign="+"),
        _percent(verdict.allowed_percent),
        _percent(verdict.seen_percent),
        _MISSING if verdict.p is None else f"{verdict.p:.2g}",
    )
    return (*(_escaped(label) or _MISSING for label in labels), *numbers)


def _value(value: float | None) -> str:
    return _MISSING if value is None else number(value, 4)


def _percent(value: float | None, sign: str = "") -> str:
    if value is None:
        return _MISSING
    # A change that is shown must not be printed as none.
    small = 100.0 * SHOWN <= abs(value) < 0.05
    return f"{value:{sign}.0e}" if small else f"{value + 0.0:{sign}.1f}"


def _escaped(text: str) -> str:
    """Return text that cannot end a Markdown cell."""
    return " ".join(text.replace("|", "/").split())
