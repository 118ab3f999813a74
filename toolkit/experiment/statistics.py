"""Statistics over seeds: every metric's mean, median and spread, and the NEES averaged over the seeds.

A mean is over the runs that ended well; quartiles over all runs count the others as infinitely bad.

Two estimators are compared in pairs, because under each seed they read the same recording (Montgomery, "Design and
analysis of experiments", 2013, sections 2.4 and 2.5).

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4:
over N independent runs the mean NEES of a consistent estimator stays within the chi-square band for N runs.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType
from scipy.special import stdtr, stdtrit

from toolkit.geometry import Array, IntArray
from toolkit.jackknife import STRETCHES, jackknife_error
from toolkit.metrics.parts.consistency import POSE_DOF, nees_band
from toolkit.metrics.parts.scores import Best


@dataclass(frozen=True)
class Spread:
    """Mean, median and spread of the n values of a metric; ``std`` (n - 1 in its divisor) is None for a single one."""

    n: int
    mean: float
    median: float
    std: float | None
    least: float
    lower_quartile: float
    upper_quartile: float
    most: float


class Quartiles(Struct, frozen=True, kw_only=True):
    """Quartiles in which what failed is infinitely bad; null where that decides one."""

    lower_quartile: float | None
    median: float | None
    upper_quartile: float | None


class QuantilesAll(Quartiles, frozen=True, kw_only=True):
    """Quartiles over all runs, where one that is not ok counts as infinitely bad; null where such runs decide it."""

    # A run's score until it failed or diverged does not show how it would have gone on.
    reason: Annotated[str, Meta(description="why a quartile is null")] | UnsetType = UNSET


# Level of the test: false alarms for equal estimators.
LEVEL = 0.05


@dataclass(frozen=True)
class Paired:
    """The mean difference of a metric over n seeds that both estimators have, with its standard error."""

    n: int
    mean: float
    error: float

    @property
    def interval(self) -> "Interval":
        return self.within(LEVEL)

    def within(self, level: float) -> "Interval":
        """Return the mean with the interval by Student's t that misses the true one at a rate of ``level``."""
        reach = float(stdtrit(self.n - 1, 1.0 - level / 2.0)) * self.error
        return Interval(self.mean, self.mean - reach, self.mean + reach)

    @property
    def p(self) -> float:
        """Return the p-value of Student's paired test, two-sided: small where the mean is not zero by chance."""
        if self.error == 0.0:
            return float(self.mean == 0.0)
        return 2.0 * float(stdtr(self.n - 1, -abs(self.mean) / self.error))


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


def paired_p(differences: Array, margin: float | Array = 0.0) -> Array:
    """Return the p-value (...) of the one-sided paired t-test that the mean of differences (..., n) exceeds a margin.

    A small value means that the mean is above the margin by more than chance. Differences that are all equal have no
    spread; the result is then 0 where they exceed the margin, otherwise 1. For a single difference it is 1.
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


class Interval(NamedTuple):
    """A value with the interval it lies in, of 95 % where nothing else is said."""

    value: float
    low: float
    high: float

    def exp(self) -> "Interval":
        """Return the interval of the exponential; what no double holds is infinite."""
        with np.errstate(over="ignore"):
            return Interval(*(float(np.exp(end)) for end in self))


def mean_interval(values: Array, level: float = LEVEL) -> Interval:
    """Return the mean of values (n,) with its interval by Student's t; an infinite one of a single value."""
    mean = float(np.mean(values))
    if len(values) < 2:
        return Interval(mean, -math.inf, math.inf)
    return Paired(len(values), mean, float(standard_error(np.asarray(values)))).within(level)


def jackknife_interval(estimate: Callable[..., float], *rows: Array, level: float = LEVEL) -> Interval:
    """Return an estimate from arrays (M, ...) in order of time, with its interval by :mod:`toolkit.jackknife`."""
    return Paired(STRETCHES, estimate(*rows), jackknife_error(estimate, *rows)).within(level)


def ratio_of_means(above: Iterable[float | None], below: Iterable[float | None]) -> Paired | None:
    """Return the mean of the first over that of the second, paired by seed; None with fewer than two common seeds.

    Its error is that of ``above - ratio * below``, whose mean is zero (Cochran, "Sampling techniques", 1977, section
    2.11): a mean of the seeds' own ratios would be biased.
    """
    common = [(a, b) for a, b in zip(above, below, strict=True) if a is not None and b is not None]
    if len(common) < 2:
        return None
    over, under = np.array(common).T
    value = over.mean() / under.mean()
    error = np.std(over - value * under, ddof=1) / np.sqrt(len(common)) / under.mean()
    return Paired(len(common), float(value), float(error))


@dataclass(frozen=True, eq=False)
class MeanNees:
    """Pose NEES over 6 averaged over runs: at each frame (K,) the mean, the number of runs and the band for it."""

    mean: Array
    runs: IntArray
    low: Array
    high: Array

    @property
    def in_band_percent(self) -> float:
        known = self.runs > 0
        return 100.0 * float(np.mean((self.mean >= self.low)[known] & (self.mean <= self.high)[known]))

    @property
    def too_sure_percent(self) -> float:
        """Share of the frames with a mean at which it is above its band: errors larger than stated."""
        return 100.0 * float(np.mean((self.mean > self.high)[self.runs > 0]))


def spread_of(values: Iterable[float]) -> Spread | None:
    given = np.array(list(values), dtype=float)
    if not given.size:
        return None
    least, lower, median, upper, most = np.percentile(given, [0.0, 25.0, 50.0, 75.0, 100.0]).tolist()
    std = float(given.std(ddof=1)) if given.size > 1 else None
    return Spread(given.size, float(given.mean()), median, std, least, lower, upper, most)


def quantiles_of_all(good: Iterable[float], bad: int, best: Best) -> QuantilesAll | None:
    """Return the quartiles over the values of the good runs and as many bad ones as there are, each infinitely bad.

    Infinitely large, or infinitely small for a metric whose most is best. Returns None where there are no runs, or no
    value of the metric is better than another.
    """
    given = list(good)
    if best == "" or not (given or bad):
        return None
    sign = -1.0 if best == "most" else 1.0
    ordered = sorted([sign * value for value in given] + [np.inf] * bad)
    parts = (0.75, 0.5, 0.25) if best == "most" else (0.25, 0.5, 0.75)
    lower, median, upper = (_quantile(ordered, part) for part in parts)
    lower, median, upper = (None if q is None else sign * q for q in (lower, median, upper))
    why = f"{bad} of {len(ordered)} runs did not end well, and each counts as infinitely bad"
    reason = why if None in (lower, median, upper) else UNSET
    return QuantilesAll(lower_quartile=lower, median=median, upper_quartile=upper, reason=reason)


def _quantile(ordered: list[float], part: float) -> float | None:
    """Return a quantile of ascending values, linear between two of them; None where it is infinite."""
    place = part * (len(ordered) - 1)
    below, above = ordered[math.floor(place)], ordered[math.ceil(place)]
    if math.isinf(above):
        return None
    return below + (place - math.floor(place)) * (above - below)


def mean_nees(nees: Array) -> MeanNees:
    """Average pose NEES (runs, K), each over 6, at every frame over the runs that have it there (NaN: has not)."""
    known = np.isfinite(nees)
    runs = known.sum(axis=0)
    mean = np.where(known, nees, 0.0).sum(axis=0) / np.maximum(runs, 1)
    bands = {n: nees_band(POSE_DOF, n) if n else (np.nan, np.nan) for n in np.unique(runs).tolist()}
    low, high = (np.array([bands[n][side] for n in runs.tolist()]) for side in (0, 1))
    return MeanNees(np.where(runs > 0, mean, np.nan), runs, low, high)
