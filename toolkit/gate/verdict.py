"""The verdict on one metric and on the whole check; as JSON, the contract ``vislam.check/2`` (docs/gate.md)."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta, Struct

from toolkit.files.documents import Json, Older, of_attributes

Finding = Literal["regressed", "moved", "changed metric", "missing", "worse", "better", "same", "not judged"]
FAILURES: tuple[Finding, ...] = ("regressed", "moved", "changed metric", "missing")


@dataclass(frozen=True)
class Verdict:
    """What became of one metric of one estimator on one sequence.

    ``regressed`` is worse by more than is allowed; ``moved`` is another answer than chance explains, and no worse than
    is allowed; ``changed metric`` is another number of the same trajectory; they and ``missing`` fail the check.
    ``worse`` and ``better`` are changes that are shown and do not: within what is allowed, or for the good where that
    is accepted. ``before`` and ``after`` are the baseline's value and the one now, means over the seeds where there are
    several; ``change_percent`` is the relative change. ``p`` is adjusted for all tests of the check; ``seen_percent``
    is the change this test would have detected with 95 % power.
    """

    sequence: str
    estimator: str
    output: str
    metric: str
    finding: Finding
    words: str
    before: float | None = None
    after: float | None = None
    change_percent: float | None = None
    allowed_percent: float | None = None
    p: float | None = None
    seen_percent: float | None = None

    @property
    def fails(self) -> bool:
        return self.finding in FAILURES


@dataclass(frozen=True)
class Check:
    """Every verdict of a check, what a reader must know beside them, and how it was made.

    ``tests`` is the number of statistical tests that share the ``false_alarm_rate``; ``accept_better`` says that what
    moved passed unless it was worse.
    """

    baseline: str
    verdicts: tuple[Verdict, ...]
    notes: tuple[str, ...]
    false_alarm_rate: float
    tests: int
    releases: dict[str, str]
    seconds: float
    accept_better: bool = False

    @property
    def failures(self) -> tuple[Verdict, ...]:
        return tuple(verdict for verdict in self.verdicts if verdict.fails)

    @property
    def passed(self) -> bool:
        return not self.failures


class VerdictRecord(Struct, frozen=True, kw_only=True):
    """What became of one metric of one estimator on one sequence; what is not finite or not checked is null."""

    sequence: str
    estimator: str
    output: str
    metric: str
    finding: Finding
    words: str
    before: Annotated[float | None, Meta(description="the baseline's value, the mean over the seeds")]
    after: Annotated[float | None, Meta(description="the value now, the mean over the seeds")]
    change_percent: Annotated[float | None, Meta(description="relative change of the value")]
    allowed_percent: float | None
    p: Annotated[float | None, Meta(description="adjusted for all tests of the check")]
    seen_percent: Annotated[float | None, Meta(description="the change this test detects with 95 % power")]
    fails: Annotated[bool, Meta(description="whether the check fails for this")]

    def __post_init__(self) -> None:
        if self.fails != (self.finding in FAILURES):
            raise ValueError(f"fails does not fit the finding {self.finding!r}")


class CheckDocument(Struct, frozen=True, kw_only=True):
    """Every verdict of a check, and how it was made."""

    schema: Literal["vislam.check/2"]
    baseline: Annotated[str, Meta(description="the file or folder that was given")]
    passed: bool
    failures: Annotated[int, Meta(description="how many verdicts fail", ge=0)]
    false_alarm_rate: Annotated[float, Meta(description="of all statistical tests together", gt=0, lt=1)]
    tests: Annotated[int, Meta(description="how many statistical tests there were", ge=0)]
    releases: Annotated[dict[str, str], Meta(description="what it ran with")]
    seconds: Annotated[float, Meta(ge=0)]
    accept_better: Annotated[bool, Meta(description="whether what moved passed unless it was worse")]
    notes: tuple[str, ...]
    verdicts: tuple[VerdictRecord, ...]

    def __post_init__(self) -> None:
        if self.failures != sum(verdict.fails for verdict in self.verdicts):
            raise ValueError("failures does not count the verdicts that fail")
        if self.passed != (self.failures == 0):
            raise ValueError("passed does not fit failures")


def _from_1(document: Json) -> Json:
    """Return a document of version 1, in which what got better always passed and no other finding is missing."""
    return {**document, "accept_better": True}


OLDER_CHECKS: Older = {"vislam.check/1": _from_1}


def check_document(check: Check) -> CheckDocument:
    """Return a check as a record; what is not finite is null, and the words of the verdict say it."""
    return of_attributes(
        CheckDocument,
        check,
        schema="vislam.check/2",
        failures=len(check.failures),
        releases=dict(check.releases),
        verdicts=tuple(of_attributes(VerdictRecord, verdict, _finite) for verdict in check.verdicts),
    )


def _finite(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value
