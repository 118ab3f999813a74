"""Statistics robust to a few outlying intervals."""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from toolkit.geometry import Array
from toolkit.jackknife import STRETCHES
from toolkit.models.gating import MAD_TO_SIGMA

CAUCHY_SIGMAS = 2.0
ITERATIONS = 10
# Standard error of a median over that of a mean, for normal errors.
MEDIAN_TO_MEAN_ERROR = 1.2533
LEAST_STRETCHES = 2
# Level of significance.
LEVEL = 1e-3
# How long slip lasts (s); chosen with the parts of the recordings at hand in view.
SLIP_S = 1.5
# Factor by which errors of odometry that last for seconds increase the scatter of estimates (2.0 in the median of 248
# parts of ten drives, 4.6 in a tenth), and its weight in stretches.
INFLATION, INFLATION_STRETCHES = 3.0, 8.0
# Accuracy of the camera's own rate of rotation (rad/s) and velocity (m/s) over one interval.
LEAST_SPREAD_W = 0.003
LEAST_SPREAD_V = 0.05


class Scalar(NamedTuple):
    """An estimated number and its standard error."""

    value: float
    error: float


def spread(residuals: Array) -> Array:
    """Return the standard deviation (d,) of residuals (M, d) about their median, from the median deviation."""
    deviation: Array = MAD_TO_SIGMA * np.median(np.abs(residuals - np.median(residuals, axis=0)), axis=0)
    return deviation


def cauchy(residuals: Array, least_spread: float) -> Array:
    """Return log(1 + r^2) (C, M) for residuals (C, M, 3) about their medians, r in spreads of the best candidate."""
    centred = residuals - np.median(residuals, axis=1, keepdims=True)
    spreads = np.stack([spread(r) for r in residuals])
    best = spreads[np.argmin(np.sum(spreads**2, axis=1))]
    costs: Array = np.log1p(np.sum((centred / np.maximum(best, least_spread)) ** 2, axis=2))
    return costs


def mean_in_sigmas(difference: Array) -> float:
    error = float(np.std(difference)) / math.sqrt(difference.size)
    return float(np.mean(difference)) / max(error, 1e-12)


class Ranking(NamedTuple):
    """Candidates that explain the same intervals.

    ``order`` (C,) lists them by mean cost, ``best`` first. ``behind`` (C,) is how much more each one costs than the
    best, in standard errors of the mean difference.
    """

    best: int
    order: list[int]
    behind: list[float]


def ranked(costs: Array) -> Ranking:
    """Rank candidates by their costs (C, M) over M intervals. The one named first wins a tie."""
    order = np.argsort(costs.mean(axis=1), kind="stable").tolist()
    return Ranking(order[0], order, [mean_in_sigmas(cost - costs[order[0]]) for cost in costs])


def median_error(residuals: Array) -> Array:
    """Return the standard error (d,) of the median of independent residuals (M, d)."""
    error: Array = MEDIAN_TO_MEAN_ERROR * spread(residuals) / np.sqrt(len(residuals))
    return error


def slip_stretches(duration_s: float) -> int:
    """Return how many stretches, each at least SLIP_S long, there are in a recording of this length."""
    return int(np.clip(duration_s / SLIP_S, LEAST_STRETCHES, STRETCHES))


def in_motion(moved: Array, stretches: int) -> float:
    """Return the effective number of stretches, weighted by the distance or angle moved: (sum w)^2 / sum w^2 (Kish).

    ``moved`` (M, 3) is the velocity, or the rate of rotation; a stretch at standstill has no weight.
    """
    stretch = np.arange(len(moved)) * stretches // len(moved)
    gone = np.bincount(stretch, np.linalg.norm(moved, axis=1), stretches)
    return float(gone.sum() ** 2 / max(float(np.sum(gone**2)), 1e-12))


def chance_sigmas(stretches: float) -> float:
    """Return the number of standard errors exceeded by chance less often than ``LEVEL``, by Student's t.

    The error is that of a jackknife over this many stretches; with two or fewer the result is infinite.
    """
    return float(stdtrit(stretches - 1.0, 1.0 - 0.5 * LEVEL)) if stretches > LEAST_STRETCHES else np.inf


def chance_bound(error: Array, formal: Array, stretches: float) -> Array:
    """Return the bounds (m,) that estimates exceed by chance less often than ``LEVEL``.

    ``error`` (m,) is the standard error of a jackknife over stretches of the recording, and ``formal`` (m,) that if
    errors of intervals were independent. A few stretches determine their own scatter badly. Therefore a second bound is
    computed, in which the inflation of the formal error is pooled with the usual one, and the smaller bound
    is returned. Source: Smyth, "Linear models and empirical Bayes methods for assessing differential expression in
    microarray experiments" (2004), section 3.
    """
    own_dof = max(stretches - 1.0, 0.0)
    inflation = np.maximum(error / np.maximum(formal, 1e-12), 1.0)
    dof = INFLATION_STRETCHES + own_dof
    pooled = formal * np.sqrt((INFLATION_STRETCHES * INFLATION**2 + own_dof * inflation**2) / dof)
    by_own = chance_sigmas(stretches) * np.maximum(error, formal)
    return np.asarray(np.minimum(float(stdtrit(dof, 1.0 - 0.5 * LEVEL)) * pooled, by_own))


def regression(response: Array, jacobian: Array) -> tuple[Array, Array]:
    """Solve response (M, k) = jacobian (M, k, m) x by least squares with Cauchy weights.

    The covariance (m, m) assumes that errors of rows are independent.
    """
    unknowns = jacobian.shape[2]
    rows, flat = jacobian.reshape(-1, unknowns), response.ravel()
    found = np.linalg.lstsq(rows, flat)[0]
    for _ in range(ITERATIONS):
        residual = (flat - rows @ found).reshape(response.shape)
        scale = np.maximum(spread(residual), 1e-9)
        weight = 1.0 / (1.0 + (residual / scale) ** 2 / CAUCHY_SIGMAS**2) / scale**2
        weighted = rows * weight.reshape(-1, 1)
        information: Array = weighted.T @ rows
        information += 1e-12 * np.trace(information) * np.eye(unknowns)
        found = np.linalg.solve(information, weighted.T @ flat)
    return np.asarray(found), np.asarray(np.linalg.inv(information))


def slope(instrument: Array, regressor: Array, response: Array) -> Scalar:
    """Estimate s in response = s * regressor + noise, all (M, d), with Cauchy weights.

    ``instrument`` is correlated with the regressor and independent of the noise of regressor and response. A regressor
    with negligible noise is its own instrument (Wooldridge, "Econometric Analysis of Cross Section and Panel Data",
    2010, chapter 5). The error is the heteroscedasticity-robust one (White 1980).
    """
    scale = np.maximum(spread(response), 1e-9)
    z, x, y = instrument / scale, regressor / scale, response / scale
    # A row has one weight, so the products of its components are summed beforehand.
    zy, zx, yy, xy, xx = (np.einsum("ij,ij->i", a, b) for a, b in ((z, y), (z, x), (y, y), (x, y), (x, x)))
    value, weight = 0.0, np.ones(len(z))
    for _ in range(ITERATIONS):
        value = float(weight @ zy) / _away_from_zero(float(weight @ zx))
        chi2 = yy - 2.0 * value * xy + value**2 * xx
        weight = 1.0 / (1.0 + chi2 / (z.shape[1] * CAUCHY_SIGMAS**2))
    moment = weight * (zy - value * zx)
    return Scalar(value, float(np.linalg.norm(moment)) / abs(_away_from_zero(float(weight @ zx))))


def _away_from_zero(x: float) -> float:
    return x if abs(x) > 1e-12 else 1e-12
