"""A check of the gate as text: a table of what fails or of everything, notes, failures with reasons, the verdict.

And its files, each on request: JUnit XML, Markdown and JSON. Last, what verification finds of an estimator's promises.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from xml.etree import ElementTree

from toolkit.errors import printable
from toolkit.evaluation.against_baseline import CHANGES_PERCENT, MOST_RUNS, WANTED, Planned
from toolkit.files.documents import to_text
from toolkit.files.writing import write_text
from toolkit.gate.checking import SHOWN
from toolkit.gate.verdict import Check, Finding, Verdict
from toolkit.metrics import Metric, known_metrics
from toolkit.report.text import (
    DIGITS,
    MISSING,
    WIDTH,
    Table,
    Width,
    as_markdown,
    as_text,
    filled,
    number,
    section,
    unit_of,
)
from toolkit.verify import VerificationRecord

_FAILED: Mapping[Finding, str] = {
    "regressed": "got worse",
    "moved": "moved",
    "changed metric": "computed differently",
    "missing": "missing",
}
_STATES: tuple[Finding, ...] = ("changed metric", "missing")
_LABELS = (("sequence", "", ""), ("estimator", "", ""), ("output", "", ""), ("metric", "", ""), ("finding", "", ""))
# A value has at most this many digits.
_MOST_DIGITS = 7
_NUMBERS = (
    ("before", "", ""),
    ("now", "", ""),
    ("change", "", "%"),
    ("allowed", "", "%"),
    ("detects", "", "%"),
    ("p", "", ""),
)


def printed_lines(verdicts: Sequence[Verdict]) -> Iterator[str]:
    """Yield the lines of a table for a terminal: what the verdicts are of stands above them, and no name is folded."""
    rows = tuple(_row(verdict)[3:] for verdict in verdicts)
    lines = as_text(Table((*_LABELS[3:], *_NUMBERS), rows, labels=2)).splitlines()
    yield from (f"  {line}" for line in lines[: -len(rows)])
    for of, members in groupby(zip(map(_of, verdicts), lines[-len(rows) :], strict=True), key=lambda one: one[0]):
        yield printable(of)
        yield from (f"  {line}" for _, line in members)


def _row(verdict: Verdict) -> tuple[str, ...]:
    labels = (verdict.sequence, verdict.estimator, verdict.output, verdict.metric, verdict.finding)
    numbers = (
        *_values(verdict),
        _percent(verdict.change_percent, sign="+"),
        _percent(verdict.allowed_percent),
        _percent(verdict.seen_percent),
        MISSING if verdict.p is None else f"{verdict.p:.2g}",
    )
    return (*(_escaped(label) or MISSING for label in labels), *numbers)


def _metrics() -> dict[str, Metric]:
    return {metric.key: metric for metric in known_metrics()}


def _name(key: str) -> str:
    return _metrics()[key].name if key in _metrics() else key


def _values(verdict: Verdict) -> tuple[str, str]:
    """Return the value before and now with their unit, and with enough digits that a difference shows."""
    given = [value for value in (verdict.before, verdict.after) if value is not None and math.isfinite(value)]
    metric = _metrics().get(verdict.metric)
    unit, factor = ("", 1.0) if metric is None or metric.unit == "1" else unit_of(metric, given)
    digits = DIGITS
    if len(given) == 2 and verdict.finding != "same" and given[0] != given[1] and all(given):
        largest, difference = (
            math.floor(math.log10(size)) for size in (max(map(abs, given)), abs(given[1] - given[0]))
        )
        digits = min(max(DIGITS, largest - difference + 2), _MOST_DIGITS)
    before, now = (
        MISSING if value is None else f"{number(factor * value, digits)} {unit}".rstrip()
        for value in (verdict.before, verdict.after)
    )
    return before, now


def _percent(value: float | None, sign: str = "") -> str:
    if value is None:
        return MISSING
    # A change that is shown must not be printed as zero.
    small = 100.0 * SHOWN <= abs(value) < 0.05
    return f"{value:{sign}.0e}" if small else f"{value + 0.0:{sign}.1f}"


def _escaped(text: str) -> str:
    return " ".join(text.replace("|", "/").split())


def headline(check: Check) -> str:
    tested = len(check.verdicts)
    if check.passed:
        return f"the gate passes: nothing got worse than {check.baseline} ({tested} comparisons)"
    found = Counter(verdict.finding for verdict in check.failing)
    counts = ", ".join(f"{found[finding]} {words}" for finding, words in _FAILED.items() if found[finding])
    return f"the gate fails: of {tested} comparisons with {check.baseline}, {counts}"


def failure_lines(check: Check) -> Iterator[str]:
    for verdict in check.failing:
        yield f"{about(verdict)}: {verdict.words}"


def about(verdict: Verdict) -> str:
    what = _name(verdict.metric)
    found = _FAILED.get(verdict.finding, "")
    return f"{_of(verdict)}: {what} {'is ' if verdict.finding in _STATES else ''}{found}".strip()


def _of(verdict: Verdict) -> str:
    who = f"{verdict.estimator} {verdict.output}".strip()
    return f"{verdict.sequence}, {who}" if who else verdict.sequence


def note_lines(check: Check) -> Iterator[str]:
    yield from check.notes
    if check.tests:
        yield (
            f"{check.tests} tests share a false-alarm rate of {100.0 * check.false_alarm_rate:g} % (Holm); "
            "'detects' is the change each of them finds with 95 % power, from how much it scatters"
        )
        yield f"what this check would have found in 95 % of cases: {'; '.join(_detected(check))}"
    if any(verdict.finding == "moved" for verdict in check.failing):
        yield (
            "what moved differs from the baseline and is no worse: --accept-better lets it pass, "
            "a new baseline adopts it"
        )
    releases = ", ".join(f"{name} {release}" for name, release in check.releases.items())
    yield "; ".join(filter(None, (releases, f"took {check.seconds:.0f} s")))


def _detected(check: Check) -> Iterator[str]:
    """Yield, for each metric that was tested, the least change that a test of it finds, and the largest that one needs.

    Both with where they are.
    """
    tested = [verdict for verdict in check.verdicts if verdict.seen_percent is not None]
    for key in dict.fromkeys(verdict.metric for verdict in tested):
        seen = sorted((v.seen_percent or 0.0, _of(v)) for v in tested if v.metric == key)
        ends = [f"{_percent(percent)} % ({of})" for percent, of in dict.fromkeys((seen[0], seen[-1]))]
        yield f"{_name(key)} {' to '.join(ends)}"


def plan_table(plan: Sequence[Planned]) -> Table:
    """Return how likely changes are found with the runs there are, and how many runs find them."""
    found = [(f"{change:g} %", "found", "%") for change in CHANGES_PERCENT]
    wanted = [(f"{change:g} %", f"runs for {100.0 * WANTED:g} %", "") for change in CHANGES_PERCENT]
    headings = (*_LABELS[:1], *_LABELS[3:4], ("runs", "", ""), ("scatter", "", "%"), *found, *wanted)
    rows = tuple(
        (
            _escaped(one.where.sequence),
            one.where.metric,
            str(one.runs),
            number(one.scatter_percent, 2),
            *(MISSING if one.is_allowed(i) else f"{100.0 * chance:.0f}" for i, chance in enumerate(one.seen)),
            *(MISSING if one.is_allowed(i) else str(n or f"> {MOST_RUNS}") for i, n in enumerate(one.needed)),
        )
        for one in plan
    )
    return Table(headings, rows, labels=2)


def plan_text(plan: Sequence[Planned], width: Width = WIDTH) -> str:
    bounds = ", ".join(f"{percent:g} %" for percent in sorted({one.bound_percent for one in plan}))
    notes = (
        "a growth of an error by so much is found with this chance in a check of as many runs a sequence as there are "
        f"here; then the runs a sequence, now and in the baseline, for a chance of {100.0 * WANTED:g} %",
        "scatter is that of one run, of the mean of all sequences where they are judged together",
        f"what is not beyond the bound ({bounds}) is allowed, and never found: --bound sets it",
    )
    return "\n".join([as_text(plan_table(plan)), *section("notes", notes, width)])


def gate_text(check: Check, width: Width = WIDTH, *, verbose: bool = False) -> str:
    shown = check.verdicts if verbose else check.failing
    lines = [*printed_lines(shown), ""] if shown else []
    lines += section("notes", note_lines(check), width)
    lines += section("fails", failure_lines(check), width)
    return "\n".join([*lines, "", headline(check)])


def gate_markdown(check: Check) -> str:
    """Return a check as Markdown fit for a pull request: what failed on top, everything folded below."""
    mark, line = "✅" if check.passed else "❌", headline(check)
    parts = [f"## {mark} Accuracy gate", f"{line[0].upper()}{line[1:]}."]
    if check.failing:
        rows = tuple((*_row(verdict), _escaped(verdict.words)) for verdict in check.failing)
        parts.append(as_markdown(Table((*_LABELS, *_NUMBERS, ("why", "", "")), rows, labels=len(_LABELS))))
    parts.append("\n".join(f"- {line}" for line in note_lines(check)))
    everything = as_markdown(Table((*_LABELS, *_NUMBERS), tuple(map(_row, check.verdicts)), labels=len(_LABELS)))
    parts.append(f"<details>\n<summary>All {len(check.verdicts)} comparisons</summary>\n\n{everything}\n\n</details>")
    return "\n\n".join(parts) + "\n"


def gate_junit(check: Check) -> str:
    """Return a check as JUnit XML, which every CI shows: a suite a sequence, a test case a comparison.

    The format is what the common readers agree on: https://github.com/testmoapp/junitxml describes it.
    """
    root = ElementTree.Element("testsuites", _counts(check.verdicts), name="accuracy gate")
    root.set("time", f"{check.seconds:.3f}")
    for sequence, verdicts in groupby(check.verdicts, key=lambda verdict: verdict.sequence):
        of_suite = tuple(verdicts)
        suite = ElementTree.SubElement(root, "testsuite", _counts(of_suite), name=printable(sequence))
        for verdict in of_suite:
            who = printable(".".join(filter(None, (sequence, verdict.estimator, verdict.output))))
            case = ElementTree.SubElement(suite, "testcase", classname=who, name=verdict.metric)
            cells = zip(_NUMBERS, _row(verdict)[len(_LABELS) :], strict=True)
            numbers = "\n".join(f"{name} {cell} {unit}".rstrip() for (name, _, unit), cell in cells if cell != MISSING)
            message = printable(f"{about(verdict)}: {verdict.words}") if verdict.words else ""
            if verdict.fails:
                ElementTree.SubElement(case, "failure", type=verdict.finding, message=message).text = numbers
            elif message:
                ElementTree.SubElement(case, "system-out").text = f"{message}\n{numbers}"
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _counts(verdicts: tuple[Verdict, ...]) -> dict[str, str]:
    failures = sum(verdict.fails for verdict in verdicts)
    return {"tests": str(len(verdicts)), "failures": str(failures), "errors": "0", "skipped": "0"}


WRITERS: Mapping[str, Callable[[Check], str]] = {"junit": gate_junit, "markdown": gate_markdown, "json": to_text}
# How the file of each kind begins.
BEGINNINGS: Mapping[str, str] = {"junit": "<", "markdown": "#", "json": "{"}


def write_check(check: Check, files: Mapping[str, Path]) -> None:
    for kind, path in files.items():
        write_text(path, WRITERS[kind](check))


def verification_text(verification: VerificationRecord, width: Width = WIDTH) -> str:
    rows = tuple((check.name, check.result) for check in verification.checks)
    lines = [as_text(Table((("promise",), ("result",)), rows, labels=2)), ""]
    for check in verification.checks:
        if check.result == "failed":
            lines += [filled(f"{check.name}: {check.found}", width), filled(check.remedy, width, "  to do: "), ""]
        elif check.found:
            lines += [filled(f"{check.name}: {check.found}", width), ""]
    failed = sum(check.result == "failed" for check in verification.checks)
    told = "keeps every promise" if not failed else f"breaks {failed} of {len(verification.checks)} promises"
    return "\n".join([*lines, f"{verification.estimator} {told}"])
