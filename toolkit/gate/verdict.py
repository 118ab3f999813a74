"""The verdict on one metric and on the whole check: the contract ``vislam.check/2`` (docs/gate.md)."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from toolkit.files.documents import Json, Older

Finding = Literal["regressed", "moved", "changed metric", "missing", "worse", "better", "same", "not judged"]
FAILURES: tuple[Finding, ...] = ("regressed", "moved", "changed metric", "missing")


@dataclass(frozen=True)
class Where:
    """The subject of a verdict."""

    sequence: str
    estimator: str
    output: str
    metric: str


class Verdict(Struct, frozen=True, kw_only=True):
    """What became of one metric of one estimator on one sequence; what is not finite or not checked is null.

    ``regressed`` is worse by more than is allowed; ``moved`` is another answer than chance explains, and no worse than
    is allowed; ``changed metric`` is another number of the same trajectory; they and ``missing`` fail the check.
    ``worse`` and ``better`` are changes that are shown and do not: within what is allowed, or for the good where that
    is accepted.
    """

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


def verdict_on(
    where: Where, finding: Finding, words: str, before: float | None = None, after: float | None = None,
    change_percent: float | None = None, allowed_percent: float | None = None, **tested: float,
) -> Verdict:  # fmt: skip
    """Return a verdict; ``tested`` are ``p`` and ``seen_percent``, where there was a test."""
    numbers = {"before": before, "after": after, "change_percent": change_percent, "allowed_percent": allowed_percent}
    given = {"p": None, "seen_percent": None, **numbers, **tested}
    return Verdict(
        sequence=where.sequence, estimator=where.estimator, output=where.output, metric=where.metric, finding=finding,
        words=words, fails=finding in FAILURES,
        **{name: value if value is None or math.isfinite(value) else None for name, value in given.items()},
    )  # fmt: skip


class Check(Struct, frozen=True, kw_only=True):
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
    verdicts: tuple[Verdict, ...]

    def __post_init__(self) -> None:
        if self.failures != len(self.failing):
            raise ValueError("failures does not count the verdicts that fail")
        if self.passed != (self.failures == 0):
            raise ValueError("passed does not fit failures")

    @classmethod
    def of(cls, verdicts: Iterable[Verdict], **others: Any) -> "Check":
        """Return a check of verdicts; ``others`` are the fields that do not follow from them."""
        every = tuple(verdicts)
        failures = sum(verdict.fails for verdict in every)
        return cls(schema="vislam.check/2", verdicts=every, failures=failures, passed=not failures, **others)

    @property
    def failing(self) -> tuple[Verdict, ...]:
        return tuple(verdict for verdict in self.verdicts if verdict.fails)


def _from_1(document: Json) -> Json:
    """Return a document of version 1, in which what got better always passed and no other finding is missing."""
    return {**document, "accept_better": True}


OLDER_CHECKS: Older = {"vislam.check/1": _from_1}
