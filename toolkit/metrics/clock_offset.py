"""The offset of an estimate's clock from the truth's: the shift of its stamps by which its positions fit best.

A constant offset of two clocks displaces each position along its velocity. It is fitted together with the alignment
that ATE fits, as in Furgale, Rehder and Siegwart, "Unified temporal and spatial calibration for multi-sensor systems"
(IROS 2013), section III, with the truth's positions in the place of a spline of them. A clock that runs fast displaces
them increasingly; its rate is fitted in the same way, from the middle of the recording outwards. Positions of another
point of the body, as of a prism or an antenna, are displaced along its axes, which is fitted likewise.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, skew, so3_exp
from toolkit.jackknife import STRETCHES, jackknife_cov
from toolkit.measurements import NS_PER_S
from toolkit.metrics.parts.evaluation import AgainstTruth, Matched, fit_se3, lengths, rmse
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable

ORDER = 45
OFFSET, ERROR = "clock_offset_ms", "clock_offset_error_ms"
METRICS = (
    Metric(
        OFFSET,
        "shift of the estimate's stamps with which its positions fit the truth's best (ms)",
        "ms",
        ("clock", "offset"),
        best="",
    ),
    Metric(
        ERROR,
        "standard error of the clock offset, by a jackknife over ten stretches of time (ms)",
        "ms",
        ("clock", "off. +-"),
        name="clock offset, error",
        best="",
    ),
)
_ITERATIONS, _SETTLED_S = 20, 1e-6
# Pairs that are needed, and their largest distance in median steps: a path is not known across a gap.
_FEWEST_PAIRS, _WIDEST_STEPS = 3 * STRETCHES, 1.5
# If a smaller share of the velocity remains after the alignment, a shift in time cannot be told from one in space.
_LEAST_LEFT = 0.02
# An offset is reported from this many standard errors and from a millisecond on; few stamps are more accurate.
_SIGMAS, _LEAST_MS = 5.0, 1.0
# A rate is reported between the first two values (beyond the second, other stretches of a path fit as well, and the
# shift of the time is limited likewise) if positions fit this many times as well as with any offset. The fit takes in
# these shares of the pairs about the middle, one after the other.
_LEAST_RATE, _MOST_RATE, _TIMES_BETTER, _SHARES = 1e-3, 0.1, 3.0, (0.15, 0.3, 0.6, 1.0)
_RATE_REMARK = (
    "time passes {:.4f} +- {:.4f} times as fast by its stamps as by the truth's: with that its positions fit to "
    "{:.3g} m in place of {:.3g} m; stamp both by one clock"
)
_REMARK = (
    "with its stamps shifted by {:.1f} +- {:.1f} ms its positions fit the truth's to {:.3g} m in place of {:.3g} m: "
    "two clocks, a truth whose positions are stamped early or late, or a drift proportional to the velocity"
)


# A point of the body is reported if with it positions fit this many times as well as without, and as with any offset.
_TIMES_NEARER, _FEWEST_OF_A_POINT, _SETTLED_M = 2.0, 6, 1e-6
_POINT_REMARK = (
    "at the point ({2:.3f}, {3:.3f}, {4:.3f}) m of its body its positions fit the truth's to {0:.3g} m in place of "
    "{1:.3g} m: the truth is of another point, as of a prism, an antenna or a camera"
)


class _Fit(NamedTuple):
    """The offset (s) of a clock and, if it is fitted, by how much slower it runs (c,); their standard errors (c,).

    Also the RMS distance of positions without and with it (m).
    """

    clock: Array
    errors: Array
    before_m: float
    after_m: float


def score(evaluation: AgainstTruth) -> Scores:
    try:
        fit = _fit(evaluation.compared, with_rate=False)
    except Unavailable as reason:
        why = _of_rate(evaluation, np.inf) or str(reason)
        return Scores({OFFSET: None, ERROR: None}, {OFFSET: why, ERROR: why})
    offset_ms, error_ms = 1e3 * float(fit.clock[0]), 1e3 * float(fit.errors[0])
    scores = Scores({OFFSET: offset_ms, ERROR: error_ms})
    if remark := _of_rate(evaluation, fit.after_m):
        return scores.remarked([OFFSET], remark)
    if abs(offset_ms) < max(_LEAST_MS, _SIGMAS * error_ms) or other_point(evaluation) is not None:
        return scores
    return scores.remarked([OFFSET], _REMARK.format(offset_ms, error_ms, fit.after_m, fit.before_m))


def _fit(pairs: Matched, with_rate: bool) -> _Fit:
    """Fit a clock by Gauss-Newton, a rate from the middle of the time outwards; raise Unavailable where none fits."""
    from scipy.interpolate import CubicSpline  # slow to import, and most processes do not need it

    true, estimated = pairs.positions
    t_s = (pairs.t_ns - pairs.t_ns[0]) / NS_PER_S
    wide = np.diff(t_s) > _WIDEST_STEPS * np.median(np.diff(t_s))
    usable = ~(np.append(wide, False) | np.insert(wide, 0, False))
    if usable.sum() < _FEWEST_PAIRS:
        raise Unavailable(f"a clock offset needs {_FEWEST_PAIRS} matched pairs without a gap, there are {usable.sum()}")
    path, middle_s = CubicSpline(t_s, true), 0.5 * t_s[-1]
    since_s = np.vander(t_s - middle_s, 2, increasing=True)[:, : 1 + with_rate]
    clock = np.zeros(1 + with_rate)
    for share in _SHARES if with_rate else _SHARES[-1:]:
        rows = usable & (np.abs(t_s - middle_s) <= share * middle_s)
        for _ in range(_ITERATIONS):
            at_s = t_s + since_s @ clock
            # A pair that a step moved beyond the ends stays out, so that the fit does not oscillate with it.
            rows &= (at_s >= t_s[0]) & (at_s <= t_s[-1])
            if rows.sum() < _FEWEST_PAIRS:
                break
            error_m, jacobian = _linearised(path, at_s[rows], estimated[rows])
            step = _clock_step(error_m, jacobian, since_s[rows])
            clock += step
            if share == 1.0 and abs(step[0]) < _SETTLED_S:
                before_m = rmse(lengths(_linearised(path, t_s[rows], estimated[rows])[0]))
                errors = np.sqrt(np.diag(jackknife_cov(_clock_step, error_m, jacobian, since_s[rows])))
                return _Fit(clock, errors, before_m, rmse(lengths(error_m)))
    raise Unavailable("no offset within the recording makes the positions fit")


def other_point(evaluation: AgainstTruth) -> str | None:
    """Return the remark on a truth of another point of the body; None where that explains no more than a clock does.

    Gauss-Newton over the turn of the world and the point, positions less their means.
    """
    pairs = evaluation.compared
    if len(pairs) < _FEWEST_OF_A_POINT:
        return None
    true, estimated = (positions - positions.mean(axis=0) for positions in pairs.positions)
    try:
        alignment = evaluation.se3_alignment
    except Unavailable:
        return None
    R_truth_body, point_m = alignment.rotation @ pairs.estimate[:, :3, :3], np.zeros(3)
    moved, world = estimated @ alignment.rotation.T, np.eye(3)
    before_m = rmse(lengths(true - moved))
    for _ in range(_ITERATIONS):
        arms = world @ (R_truth_body - R_truth_body.mean(axis=0))
        at = moved @ world.T + arms @ point_m
        jacobian = np.concatenate([-skew(at), arms], axis=2).reshape(-1, 6)
        step = np.linalg.lstsq(jacobian, (true - at).ravel(), rcond=_LEAST_LEFT)[0]
        world, point_m = so3_exp(step[:3]) @ world, point_m + step[3:]
        if np.linalg.norm(step) < _SETTLED_M:
            break
    after_m = rmse(lengths(true - moved @ world.T - world @ (R_truth_body - R_truth_body.mean(axis=0)) @ point_m))
    if not _TIMES_NEARER * after_m < before_m:
        return None
    try:
        if _TIMES_NEARER * after_m > _fit(pairs, with_rate=False).after_m:
            return None
    except Unavailable:
        pass
    return _POINT_REMARK.format(after_m, before_m, *point_m)


def _of_rate(evaluation: AgainstTruth, by_offset_m: float) -> str:
    """Return the remark on the rate of the estimate's clock; empty if it is not determined, or an offset does as well.

    ``by_offset_m`` is the RMS distance that an offset alone leaves.
    """
    try:
        fit = _fit(evaluation.compared, with_rate=True)
    except Unavailable:
        return ""
    slower, error = float(fit.clock[1]), float(fit.errors[1])
    if not max(_LEAST_RATE, _SIGMAS * error) <= abs(slower) <= _MOST_RATE:
        return ""
    beyond = abs(fit.clock[0]) >= _MOST_RATE * (evaluation.compared.t_ns[-1] - evaluation.compared.t_ns[0]) / NS_PER_S
    if beyond or _TIMES_BETTER * fit.after_m > min(fit.before_m, by_offset_m):
        return ""
    return _RATE_REMARK.format(1.0 / (1.0 + slower), error, fit.after_m, fit.before_m)


def _linearised(path: Callable[..., Array], t_s: Array, estimated: Array) -> tuple[Array, Array]:
    """Align positions (n, 3) with the true ones at their shifted stamps (n,) s, and linearise the remaining errors.

    Return the aligned less the true ones (n, 3) m and their Jacobian (n, 3, 7): to the time (the true velocity, m/s), a
    turn about each axis of the world and a displacement along each.
    """
    true, velocity = path(t_s), path(t_s, 1)
    alignment = fit_se3(true, estimated)
    aligned = estimated @ alignment.rotation.T + alignment.translation
    turned = -skew(aligned - aligned.mean(axis=0))
    moved = np.broadcast_to(np.eye(3), turned.shape)
    return aligned - true, np.concatenate([velocity[:, :, None], turned, moved], axis=2)


def _clock_step(error_m: Array, jacobian: Array, since_s: Array) -> Array:
    """Return the step (c,) of the clock that best explains errors (n, 3), together with any rotation and displacement.

    The clock's time is off by ``since_s`` (n, c) times its parameters: 1 for an offset, the time itself for a rate.
    """
    velocity, aligning = jacobian[:, :, 0], jacobian[:, :, 1:].reshape(-1, 6)
    moved = (velocity[:, :, None] * since_s[:, None]).reshape(-1, since_s.shape[1])
    left = moved - aligning @ np.linalg.lstsq(aligning, moved, rcond=None)[0]
    squared = left.T @ left
    if np.linalg.det(squared) <= _LEAST_LEFT**2 * np.prod(np.sum(moved**2, axis=0)):
        raise Unavailable("the velocity hardly changes, so that a shift in time looks like one in space")
    return np.asarray(np.linalg.solve(squared, left.T @ error_m.ravel()))
