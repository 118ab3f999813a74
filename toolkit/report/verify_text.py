"""A verification of an estimator as text: promises kept and broken, and what to do."""

from toolkit.report.text import WIDTH, Table, Width, as_text, filled
from toolkit.verify import VerificationRecord


def verification_text(verification: VerificationRecord, width: Width = WIDTH) -> str:
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
