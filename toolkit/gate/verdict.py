"""What the gate says of one metric, and of the whole check."""

from dataclasses import dataclass
from typing import Literal

Finding = Literal["regressed", "moved", "changed metric", "missing", "worse", "better", "same", "not judged"]
FAILURES: tuple[Finding, ...] = ("regressed", "moved", "changed metric", "missing")


@dataclass(frozen=True)
class Verdict:
    """What became of one metric of one estimator on one sequence.

    ``regressed`` is worse by more than is allowed; ``moved`` is another answer than chance explains, and no worse than
    is allowed; ``changed metric`` is another number of the same trajectory; they and ``missing`` fail the check.
    ``worse`` and ``better`` are changes that are shown and do not: within what is allowed, or for the good where that
    is accepted. ``before`` and ``after`` are the baseline's value and the one now, means over the seeds where there are
    several; ``change_percent`` is how much it grew. ``p`` is adjusted for all tests of the check; ``seen_percent`` is
    the change this test would have seen with 95 % power.
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
        """Say whether the check fails for this."""
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
        """Return what the check fails for."""
        return tuple(verdict for verdict in self.verdicts if verdict.fails)

    @property
    def passed(self) -> bool:
        """Say whether nothing fails the check."""
        return not self.failures
