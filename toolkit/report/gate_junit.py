"""A check of the gate as JUnit XML, which every CI shows: a suite a sequence, a test case a comparison.

The format is what the common readers agree on: https://github.com/testmoapp/junitxml describes it.
"""

from itertools import groupby
from xml.etree import ElementTree

from toolkit.gate.verdict import Check, Verdict
from toolkit.report.gate_words import about


def gate_junit(check: Check) -> str:
    """Return the document."""
    root = ElementTree.Element("testsuites", _counts(check.verdicts), name="accuracy gate")
    root.set("time", f"{check.seconds:.3f}")
    for sequence, verdicts in groupby(check.verdicts, key=lambda verdict: verdict.sequence):
        _add_suite(root, sequence, tuple(verdicts))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _add_suite(root: ElementTree.Element, sequence: str, verdicts: tuple[Verdict, ...]) -> None:
    suite = ElementTree.SubElement(root, "testsuite", _counts(verdicts), name=sequence)
    for verdict in verdicts:
        who = ".".join(filter(None, (sequence, verdict.estimator, verdict.output)))
        case = ElementTree.SubElement(suite, "testcase", classname=who, name=verdict.metric)
        told = f"{about(verdict)}: {verdict.words}" if verdict.words else ""
        if verdict.fails:
            ElementTree.SubElement(case, "failure", type=verdict.finding, message=told).text = _numbers(verdict)
        elif told:
            ElementTree.SubElement(case, "system-out").text = f"{told}\n{_numbers(verdict)}"


def _counts(verdicts: tuple[Verdict, ...]) -> dict[str, str]:
    failures = sum(verdict.fails for verdict in verdicts)
    return {"tests": str(len(verdicts)), "failures": str(failures), "errors": "0", "skipped": "0"}


def _numbers(verdict: Verdict) -> str:
    told = {
        "before": verdict.before,
        "now": verdict.after,
        "change in percent": verdict.change_percent,
        "allowed in percent": verdict.allowed_percent,
        "p, adjusted": verdict.p,
        "sees, in percent": verdict.seen_percent,
    }
    return "\n".join(f"{name}: {value:.7g}" for name, value in told.items() if value is not None)
