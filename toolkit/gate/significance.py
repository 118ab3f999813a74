"""The statistical tests of the gate, on logarithms of metrics.

Simulated sequences are tested in pairs, because under each seed both sides read the same measurements: that a metric
*moved* by more than another processor's rounding, and that it became *worse* by more than its margin, by Student's
paired test (Montgomery, "Design and analysis of experiments", 2013, section 2.5). A NEES is worse the farther its mean
over the seeds is outside the chi-square band of as many runs, on either side (Bar-Shalom, Li and Kirubarajan 2001,
section 5.4); a NIS, the farther it is from 1. Runs that were made anew on both sides are tested by Welch's test
(Biometrika 34, 1947). The correction over all tests is Holm's (Scandinavian Journal of Statistics 6, 1979). Arrays are
tested along their last axis, so that a benchmark can test thousands of checks at once; docs/gate.md tells the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr, stdtrit

from toolkit.experiment.statistics import holm, paired_p, standard_error
from toolkit.gate.baseline import Criterion
from toolkit.gate.verdict import FAILURES, Finding, Verdict, Where, verdict_on
from toolkit.geometry import Array
from toolkit.metrics.parts.consistency import POSE_DOF, nees_band

POWER = 0.95
# Another processor's rounding moves a metric by less than this, relative (docs/gate.md).
ROUNDING = 1e-6
# A value below this is rounding, and its logarithm is not used.
_LEAST = 1e-12
# With fewer runs than this on either side their spread is unknown, and only the bound is applied.
FEWEST_RUNS = 3


@dataclass(frozen=True, eq=False)
class Compared:
    """One metric in the runs of both sides: (m,) in the baseline, (n,) now."""

    where: Where
    criterion: Criterion
    before: Array
    after: Array


@dataclass(frozen=True, eq=False)
class Pairs(Compared):
    """One metric under the seeds (..., n) both sides have, in the baseline and now; of many checks at once, too."""

    @property
    def differences(self) -> Array:
        """Log ratios (..., n) of the value now to the baseline's, positive where it grew."""
        return log_of(self.after) - log_of(self.before)

    @property
    def runs(self) -> str:
        return f"over {self.before.size} seeds"

    @property
    def change(self) -> float:
        return float(self.differences.mean())

    @property
    def still(self) -> float:
        """Return the change, as a log ratio, that is no movement."""
        return ROUNDING

    def moved_p(self) -> Array:
        """Return the p-value (...) of having moved by more than rounding, two-sided."""
        up, down = (paired_p(sign * self.differences, ROUNDING) for sign in (1.0, -1.0))
        return np.asarray(np.minimum(1.0, 2.0 * np.minimum(up, down)))

    def worse_p(self) -> Array:
        """Return the p-value (...) of being worse by more than the margin; 1 where what changed is not worse."""
        before, after, margin = log_of(self.before), log_of(self.after), self.criterion.margin
        if self.criterion.worse == "larger":
            return paired_p(after - before, margin)
        # The mean NEES over runs scatters by chance; a NIS is a mean over thousands of innovations and hardly does.
        with_band = self.where.metric == "nees_pose_mean"
        low, high = nees_band(POSE_DOF, before.shape[-1]) if with_band else (1.0, 1.0)
        return _away_p(before, after, margin, (float(np.log(low)), float(np.log(high))))

    def detectable(self, rate: float) -> float:
        """Return the excess over a margin, as a log ratio, that one test at ``rate`` finds with 95 % power."""
        return smallest_detectable(self.differences, rate)


@dataclass(frozen=True, eq=False)
class Repeats(Compared):
    """One metric in runs made anew on each side, at least FEWEST_RUNS of them, by Welch's test; growth is worse.

    What changed by less than the margin, up or down, has not moved.
    """

    @property
    def runs(self) -> str:
        return f"over {self.before.size} runs before, {self.after.size} now"

    @property
    def change(self) -> float:
        return float(log_of(self.after).mean() - log_of(self.before).mean())

    @property
    def still(self) -> float:
        return self.criterion.margin

    @property
    def variances(self) -> tuple[Array, Array]:
        """The variances (k,) whose sum is that of the change, each of one side's mean, and their degrees of freedom."""
        sides = [log_of(side) for side in (self.before, self.after)]
        of_means = [0.0 if np.ptp(side) == 0.0 else side.var(ddof=1) / side.size for side in sides]
        return np.array(of_means), np.array([side.size - 1.0 for side in sides])

    @property
    def error_and_dof(self) -> tuple[float, float]:
        """Return the standard error of the change, and its degrees of freedom."""
        variances, of_each = self.variances
        total = float(variances.sum())
        dof = total**2 / float((variances**2 / of_each).sum()) if total else float(of_each.sum())
        return float(np.sqrt(total)), dof

    def moved_p(self) -> float:
        return min(1.0, 2.0 * min(self._beyond_p(1.0), self._beyond_p(-1.0)))

    def worse_p(self) -> float:
        return self._beyond_p(1.0)

    def detectable(self, rate: float) -> float:
        error, dof = self.error_and_dof
        return float(stdtrit(dof, 1.0 - rate) + stdtrit(dof, POWER)) * error

    def _beyond_p(self, sign: float) -> float:
        excess, (error, dof) = sign * self.change - self.criterion.margin, self.error_and_dof
        return float(stdtr(dof, -excess / error)) if error else float(excess <= 0.0)


@dataclass(frozen=True, eq=False)
class Everywhere(Repeats):
    """One metric on all sequences together: the mean over them of each one's change, by Welch's test.

    A change of the system shows on every sequence, and its mean scatters less than on any of them. The values of a side
    are the geometric means (S,) of its runs on each of S sequences.
    """

    parts: tuple[Repeats, ...] = ()

    @classmethod
    def of(cls, where: Where, parts: Sequence[Repeats]) -> "Everywhere":
        """Return the test of all sequences of those of single ones, at least one."""
        before, after = (np.array([geometric_mean(side) for side in sides]) for sides in _sides(parts))
        return cls(where, parts[0].criterion, before, after, tuple(parts))

    @property
    def runs(self) -> str:
        before, after = (sum(side.size for side in sides) for sides in _sides(self.parts))
        return f"over {before} runs before, {after} now"

    @property
    def variances(self) -> tuple[Array, Array]:
        """The variances (2 S,) whose sum is that of the change, and their degrees of freedom."""
        of_each = [part.variances for part in self.parts]
        variances, dof = (np.concatenate(one) for one in zip(*of_each, strict=True))
        return variances / len(self.parts) ** 2, dof


def _sides(parts: Sequence[Repeats]) -> tuple[list[Array], list[Array]]:
    return [part.before for part in parts], [part.after for part in parts]


def log_of(values: Array) -> Array:
    """Return the logarithms (...) of values (...) that are not negative."""
    return np.log(np.maximum(values, _LEAST))


def _away_p(before: Array, after: Array, margin: float, band: tuple[float, float]) -> Array:
    """Return the p-value (...) of log values (..., n) having moved away from their band, two-sided.

    Twice the one-sided value, for the side is chosen after looking. From one side of the band to the other, the new
    distance has to exceed the old one as well.
    """
    low, high = band
    # The band is for the mean of the values themselves, not of their logarithms.
    was, now = (np.log(np.exp(x).mean(axis=-1)) for x in (before, after))
    side = np.where(now > high, 1.0, -1.0)
    outwards = paired_p(side[..., None] * (after - before), margin)
    farther = paired_p(side[..., None] * (after + before), margin + side * (low + high))
    through = side * was < np.minimum(side * low, side * high)
    p = np.where(through, np.maximum(outwards, farther), outwards)
    return np.where((low <= now) & (now <= high), 1.0, np.minimum(1.0, 2.0 * p))


def check_metrics(tests: Sequence[Pairs | Repeats], rate: float, *, accept_better: bool = False) -> list[Verdict]:
    """Judge all metrics that are tested in a check; the chance of any false alarm among them is at most ``rate``.

    A movement may go up or down and a worsening has one side, so that half of the rate belongs to each side. With
    ``accept_better`` what moved passes unless it is worse.
    """
    moved, worse = (
        holm(np.array([float(p) for p in p_values])).tolist()
        for p_values in ([one.moved_p() for one in tests], [one.worse_p() for one in tests])
    )
    verdicts = []
    for one, p, p_worse in zip(tests, moved, worse, strict=True):
        finding: Finding = "regressed" if p_worse <= rate / 2.0 else "moved" if p <= rate else "same"
        if finding == "moved" and accept_better:
            finding = "better" if _is_nearer(one) else "worse"
        margin = one.criterion.margin if accept_better else one.still
        seen = one.detectable(rate / len(tests) / 2.0) + margin
        verdicts.append(_verdict(one, finding, p_worse if finding == "regressed" else p, seen))
    return verdicts


def _is_nearer(one: Compared) -> bool:
    was, is_ = float(log_of(one.before).mean()), float(log_of(one.after).mean())
    return is_ < was if one.criterion.worse == "larger" else abs(is_) < abs(was)


def _verdict(one: Pairs | Repeats, finding: Finding, p: float, seen: float) -> Verdict:
    change = 100.0 * float(np.expm1(one.change))
    message = "" if finding == "same" else f"{percent_text(change)} {one.runs}"
    if finding in FAILURES:
        message += f", and chance explains that with p = {p:.2g}"
    before, after = geometric_mean(one.before), geometric_mean(one.after)
    seen_percent = 100.0 * float(np.expm1(seen))
    return verdict_on(
        one.where, finding, message, before, after, change, one.criterion.percent, p=p, seen_percent=seen_percent
    )


def percent_text(change: float) -> str:
    """Return a change in percent, with enough digits that one which counts is not printed as 0."""
    return f"{change:+.1f} %" if abs(change) >= 0.1 else f"{change:+.1g} %"


def geometric_mean(values: Array) -> float:
    """Return the geometric mean of values (n,), whose ratio is the mean change."""
    return float(np.exp(log_of(values).mean()))


def smallest_detectable(differences: Array, rate: float) -> float:
    """Return the excess of the mean over the margin that one test at ``rate`` sees with the power POWER.

    From the spread of the differences (n,) themselves: (t(1 - rate) + t(POWER)) standard errors, the usual
    approximation of the noncentral t; infinite for fewer than two differences.
    """
    n = differences.shape[-1]
    if n < 2:
        return float("inf")
    return float((stdtrit(n - 1, 1.0 - rate) + stdtrit(n - 1, POWER)) * standard_error(differences))
