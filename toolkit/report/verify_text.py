"""A verification of an estimator as text and as JSON: promises kept and broken, and what to do."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from toolkit.files.documents import of_attributes
from toolkit.report.text import WIDTH, Table, Width, as_text, filled
from toolkit.verify.verification import Result, Verification


class CheckRecord(Struct, frozen=True, kw_only=True):
    """One promise and what came of it."""

    name: str
    result: Result
    found: Annotated[str, Meta(description="what broke it, or why it could not be had")]
    remedy: Annotated[str, Meta(description="what to do; empty where it is kept")]


class VerificationRecord(Struct, frozen=True, kw_only=True):
    """Every promise of an estimator."""

    schema: Literal["vislam.verification/1"]
    estimator: str
    passed: bool
    checks: tuple[CheckRecord, ...]


def verification_document(verification: Verification) -> VerificationRecord:
    """Return a verification as a record."""
    return VerificationRecord(
        schema="vislam.verification/1",
        estimator=verification.estimator,
        passed=verification.passed,
        checks=tuple(of_attributes(CheckRecord, check) for check in verification.checks),
    )


def verification_text(verification: Verification, width: Width = WIDTH) -> str:
    """Return the table of what passed and failed, then each failure with what to do, then the verdict."""
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
