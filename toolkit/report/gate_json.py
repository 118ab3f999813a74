"""A check of the gate as JSON, the contract ``vislam.check/1`` (docs/gate.md)."""

import math
from dataclasses import asdict

from toolkit.gate.verdict import Check, Verdict
from toolkit.report.metrics_json import Json

SCHEMA = "vislam.check/1"


def gate_json(check: Check) -> Json:
    """Return the document; what is not finite is null, and the words of the verdict say it."""
    return {
        "schema": SCHEMA,
        "baseline": check.baseline,
        "passed": check.passed,
        "failures": len(check.failures),
        "false_alarm_rate": check.false_alarm_rate,
        "tests": check.tests,
        "releases": dict(check.releases),
        "seconds": check.seconds,
        "notes": list(check.notes),
        "verdicts": [_verdict(verdict) for verdict in check.verdicts],
    }


def _verdict(verdict: Verdict) -> Json:
    fields = asdict(verdict)
    finite = {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in fields.items()}
    return {**finite, "fails": verdict.fails}
