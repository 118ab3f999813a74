"""What ``vislam check --json`` writes, the contract ``vislam.check/2`` (docs/gate.md)."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from toolkit.files.documents import Json, Older
from toolkit.gate.verdict import FAILURES, Finding


class VerdictRecord(Struct, frozen=True, kw_only=True):
    """What became of one metric of one estimator on one sequence; what is not finite or not judged is null."""

    sequence: str
    estimator: str
    output: str
    metric: str
    finding: Finding
    words: str
    before: Annotated[float | None, Meta(description="the baseline's value, the mean over the seeds")]
    after: Annotated[float | None, Meta(description="the value now, the mean over the seeds")]
    change_percent: Annotated[float | None, Meta(description="how much it grew")]
    allowed_percent: float | None
    p: Annotated[float | None, Meta(description="adjusted for all tests of the check")]
    seen_percent: Annotated[float | None, Meta(description="the change this test sees with 95 % power")]
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


OLDER: Older = {"vislam.check/1": _from_1}
