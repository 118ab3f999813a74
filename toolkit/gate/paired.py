"""Paired tests on simulated sequences: under each seed both sides read the same measurements.

What is compared is the logarithm of a metric, so that a mean difference is a ratio. A NEES is worse the farther its
mean over the seeds is outside the chi-square band of as many runs, on either side; a move within the band is none
(Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation", 2001, section 5.4).

Student's one-sided paired test is that of any textbook, e.g. Montgomery, "Design and analysis of experiments" (2013),
section 2.5; the correction is Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of
Statistics 6 (1979). Arrays are tested along their last axis, so that a benchmark can judge thousands of checks at once.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr, stdtrit

from toolkit.gate.baseline import Criterion
from toolkit.gate.verdict import Finding, Verdict
from toolkit.geometry import Array, BoolArray
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


def paired_p(differences: Array, margin: float | Array = 0.0) -> Array:
    """Return the p-value (...) of the one-sided paired t-test that the mean of differences (..., n) exceeds a margin.

    Small means: the mean is above the margin, and chance is a poor explanation. Differences that are all equal have
    no spread to judge by; then the answer is certain: 0 where they exceed the margin, otherwise 1. One difference
    alone says nothing: 1.
    """
    given = np.asarray(differences, dtype=float)
    n = given.shape[-1]
    if n < 2:
        return np.ones(given.shape[:-1])
    excess, error = given.mean(axis=-1) - margin, standard_error(given)
    with np.errstate(divide="ignore", invalid="ignore"):
        p = np.asarray(stdtr(n - 1, -excess / error))
    return np.where(error > 0.0, p, np.where(excess > 0.0, 0.0, 1.0))


def standard_error(differences: Array) -> Array:
    """Return the standard error (...) of the mean of differences (..., n), 0 where they are all equal."""
    equal = np.ptp(differences, axis=-1) == 0.0  # whose computed variance need not be exactly zero
    n = differences.shape[-1]
    return np.where(equal, 0.0, differences.std(axis=-1, ddof=1) / np.sqrt(n))


def holm(p_values: Array) -> Array:
    """Return Holm's adjusted p-values (..., m): those at most ``rate`` are rejected with that family-wise rate.

    Of m true null hypotheses one or more is rejected with at most that probability, however the tests depend on each
    other: the k-th smallest p-value counts (m - k + 1) fold, and none counts less than a smaller one.
    """
    given = np.asarray(p_values, dtype=float)
    order = np.argsort(given, axis=-1)
    weights = np.arange(given.shape[-1], 0, -1)
    stepped = np.maximum.accumulate(np.take_along_axis(given, order, axis=-1) * weights, axis=-1)
    adjusted = np.empty_like(given)
    np.put_along_axis(adjusted, order, np.minimum(stepped, 1.0), axis=-1)
    return adjusted


def rejected(p_values: Array, rate: float) -> BoolArray:
    """Return which of m null hypotheses (..., m) fall at a family-wise false-alarm rate."""
    return np.asarray(holm(p_values) <= rate)


def smallest_seen(differences: Array, rate: float, power: float) -> float:
    """Return the excess of the mean over the margin that one test at ``rate`` sees with ``power``.

    From the spread of the differences (n,) themselves: (t(1 - rate) + t(power)) standard errors, the usual
    approximation of the noncentral t; infinite for fewer than two differences.
    """
    n = differences.shape[-1]
    if n < 2:
        return float("inf")
    return float((stdtrit(n - 1, 1.0 - rate) + stdtrit(n - 1, power)) * standard_error(differences))
