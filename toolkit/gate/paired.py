"""Paired tests on simulated sequences: under each seed both sides read the same measurements.

What is compared is the logarithm of a metric, so that a mean difference is a ratio. A NEES is worse the farther its
mean over the seeds is outside the chi-square band of as many runs, on either side; a move within the band is none
(Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation", 2001, section 5.4).
"""

from dataclasses import dataclass

import numpy as np

from toolkit.gate.baseline import Criterion
from toolkit.gate.statistics import holm, paired_p, smallest_seen
from toolkit.gate.verdict import Finding, Verdict
from toolkit.geometry import Array
from toolkit.metrics._shared.consistency import POSE_DOF, nees_band

POWER = 0.95
# Below this a value is one of rounding, and its logarithm says nothing.
_LEAST = 1e-12


@dataclass(frozen=True)
class Where:
    """What a verdict is about."""

    sequence: str
    estimator: str
    output: str
    metric: str


@dataclass(frozen=True, eq=False)
class Pairs:
    """One metric under the seeds (..., n) both sides have, in the baseline and now; of many checks at once, too."""

    where: Where
    criterion: Criterion
    before: Array
    after: Array

    @property
    def differences(self) -> Array:
        """Log ratios (..., n) of the value now to the baseline's, positive where it grew."""
        return log_of(self.after) - log_of(self.before)

    @property
    def margin(self) -> float:
        """The worsening that nobody minds, as a log ratio."""
        return float(np.log1p(self.criterion.percent / 100.0))


def log_of(values: Array) -> Array:
    """Return logarithms of values that are not negative."""
    return np.log(np.maximum(values, _LEAST))


def worse_p(pairs: Pairs) -> Array:
    """Return the p-value (...) of having become worse by more than the margin; 1 where what changed is not worse."""
    if pairs.criterion.worse == "larger":
        return paired_p(pairs.differences, pairs.margin)
    return _away_p(log_of(pairs.before), log_of(pairs.after), pairs.margin)


def _away_p(before: Array, after: Array, margin: float) -> Array:
    """Return the p-value (...) of log values (..., n) having moved away from their band, two-sided.

    Twice the one-sided value, for the side is chosen after looking. From one side of the band to the other, the new
    distance has to exceed the old one as well.
    """
    low, high = (float(log_of(np.array(edge))) for edge in nees_band(POSE_DOF, before.shape[-1]))
    # The band is for the mean of the values themselves, not of their logarithms.
    was, now = (np.log(np.exp(x).mean(axis=-1)) for x in (before, after))
    side = np.where(now > high, 1.0, -1.0)
    outwards = paired_p(side[..., None] * (after - before), margin)
    farther = paired_p(side[..., None] * (after + before), margin + side * (low + high))
    through = side * was < np.minimum(side * low, side * high)
    p = np.where(through, np.maximum(outwards, farther), outwards)
    return np.where((low <= now) & (now <= high), 1.0, np.minimum(1.0, 2.0 * p))


def better_p(pairs: Pairs) -> Array:
    """Return the p-value of having become better: the same test with the sides exchanged."""
    return worse_p(Pairs(pairs.where, pairs.criterion, pairs.after, pairs.before))


def judge_pairs(tests: list[Pairs], rate: float) -> list[Verdict]:
    """Judge all paired metrics of a check; the chance of any false alarm among them is at most ``rate``."""
    if not tests:
        return []
    worse, better = (holm(np.array([float(p(pairs)) for pairs in tests])) for p in (worse_p, better_p))
    return [_verdict(*one, rate, len(tests)) for one in zip(tests, worse.tolist(), better.tolist(), strict=True)]


def _verdict(pairs: Pairs, p: float, p_better: float, rate: float, tests: int) -> Verdict:
    finding: Finding = "regressed" if p <= rate else "better" if p_better <= rate else "same"
    change = 100.0 * float(np.expm1(pairs.differences.mean()))
    sides = 1 if pairs.criterion.worse == "larger" else 2
    seen = smallest_seen(pairs.differences, rate / tests / sides, POWER) + pairs.margin
    words = {
        "regressed": f"{change:+.1f} % over {pairs.before.size} seeds, and chance explains that with p = {p:.2g}",
        "better": f"{change:+.1f} % over {pairs.before.size} seeds",
        "same": "",
    }
    where = pairs.where
    return Verdict(
        where.sequence, where.estimator, where.output, where.metric, finding, words[finding],
        before=_mean(pairs.before), after=_mean(pairs.after), change_percent=change,
        allowed_percent=pairs.criterion.percent, p=p, seen_percent=100.0 * float(np.expm1(seen)),
    )  # fmt: skip


def _mean(values: Array) -> float:
    """Return the geometric mean, whose ratio is the mean change."""
    return float(np.exp(log_of(values).mean()))
