"""The paired test of the gate, its correction for many tests at once, and the smallest change it would have seen.

Student's one-sided paired test is that of any textbook, e.g. Montgomery, "Design and analysis of experiments" (2013),
section 2.5; the correction is Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of
Statistics 6 (1979). Every function works on the last axis, so that a benchmark can judge thousands of checks at once.
"""

import numpy as np
from scipy.special import stdtr, stdtrit

from toolkit.geometry import Array, BoolArray


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
