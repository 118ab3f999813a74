"""The files a check of the gate leaves behind: JUnit XML, Markdown and JSON, each only where it is asked for."""

import math
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from xml.etree import ElementTree

from toolkit.documents import to_text
from toolkit.errors import OutputError, printable
from toolkit.files import check_parent, replaced_file
from toolkit.gate.verdict import Check, Verdict
from toolkit.report.gate_text import about, gate_markdown
from toolkit.report.manifest import cpu_model, git_revision
from toolkit.report.records.check import CheckDocument, VerdictRecord


def check_document(check: Check) -> CheckDocument:
    """Return a check as a record; what is not finite is null, and the words of the verdict say it."""
    return CheckDocument(
        schema="vislam.check/2",
        baseline=check.baseline,
        passed=check.passed,
        failures=len(check.failures),
        false_alarm_rate=check.false_alarm_rate,
        tests=check.tests,
        releases=dict(check.releases),
        seconds=check.seconds,
        accept_better=check.accept_better,
        notes=check.notes,
        verdicts=tuple(_verdict(verdict) for verdict in check.verdicts),
    )


def _verdict(verdict: Verdict) -> VerdictRecord:
    return VerdictRecord(
        sequence=verdict.sequence,
        estimator=verdict.estimator,
        output=verdict.output,
        metric=verdict.metric,
        finding=verdict.finding,
        words=verdict.words,
        before=_finite(verdict.before),
        after=_finite(verdict.after),
        change_percent=_finite(verdict.change_percent),
        allowed_percent=_finite(verdict.allowed_percent),
        p=_finite(verdict.p),
        seen_percent=_finite(verdict.seen_percent),
        fails=verdict.fails,
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def gate_junit(check: Check) -> str:
    """Return a check as JUnit XML, which every CI shows: a suite a sequence, a test case a comparison.

    The format is what the common readers agree on: https://github.com/testmoapp/junitxml describes it.
    """
    root = ElementTree.Element("testsuites", _counts(check.verdicts), name="accuracy gate")
    root.set("time", f"{check.seconds:.3f}")
    for sequence, verdicts in groupby(check.verdicts, key=lambda verdict: verdict.sequence):
        _add_suite(root, sequence, tuple(verdicts))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _add_suite(root: ElementTree.Element, sequence: str, verdicts: tuple[Verdict, ...]) -> None:
    suite = ElementTree.SubElement(root, "testsuite", _counts(verdicts), name=printable(sequence))
    for verdict in verdicts:
        who = printable(".".join(filter(None, (sequence, verdict.estimator, verdict.output))))
        case = ElementTree.SubElement(suite, "testcase", classname=who, name=verdict.metric)
        message = printable(f"{about(verdict)}: {verdict.words}") if verdict.words else ""
        if verdict.fails:
            ElementTree.SubElement(case, "failure", type=verdict.finding, message=message).text = _numbers(verdict)
        elif message:
            ElementTree.SubElement(case, "system-out").text = f"{message}\n{_numbers(verdict)}"


def _counts(verdicts: tuple[Verdict, ...]) -> dict[str, str]:
    failures = sum(verdict.fails for verdict in verdicts)
    return {"tests": str(len(verdicts)), "failures": str(failures), "errors": "0", "skipped": "0"}


def _numbers(verdict: Verdict) -> str:
    numbers = {
        "before": verdict.before,
        "now": verdict.after,
        "change in percent": verdict.change_percent,
        "allowed in percent": verdict.allowed_percent,
        "p, adjusted": verdict.p,
        "sees, in percent": verdict.seen_percent,
    }
    return "\n".join(f"{name}: {value:.7g}" for name, value in numbers.items() if value is not None)


WRITERS: Mapping[str, Callable[[Check], str]] = {
    "junit": gate_junit,
    "markdown": gate_markdown,
    "json": lambda check: to_text(check_document(check)),
}


def check_writable(path: Path) -> None:
    """Raise OutputError unless a file can be written at ``path``; replaces nothing."""
    if path.is_dir():
        raise OutputError(f"{path} is a directory; name a file")
    check_parent(path.parent)


def write_check(check: Check, files: Mapping[str, Path]) -> None:
    """Write a check in each of the kinds of WRITERS that has a file; raise OutputError where one cannot be written."""
    for kind, path in files.items():
        write_text(path, WRITERS[kind](check))


def write_text(path: Path, text: str) -> None:
    """Write a text file at once or not at all, in the place of an earlier one if there is one."""
    with replaced_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


def made_here(command: str) -> dict[str, str]:
    """Return what a baseline says of how, when and where it was made."""
    return {
        "command": command,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "git_revision": git_revision() or "not from a checkout",
        "cpu": cpu_model(),
    }
