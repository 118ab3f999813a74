"""Relative pose error over one second and over 100 metres: drift, independent of earlier errors.

Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems" (IROS 2012), eqs. 2-3.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, IntArray
from toolkit.measurements import NS_PER_S
from toolkit.metrics.parts.against_truth import (
    STAMP_TOLERANCE_NS,
    AgainstTruth,
    Matched,
    angles_deg,
    lengths,
    median_period_ns,
    relative_errors,
    rmse,
)
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable, evaluate

ORDER = 20
METRICS = (
    Metric("rpe_1s_m", "RMSE of the translation error over 1 s (m)", "m", ("RPE", "1 s")),
    Metric("rpe_1s_deg", "RMSE of the rotation error over 1 s (deg)", "deg", ("RPE rot", "1 s")),
    Metric(
        "rpe_100m_percent",
        "RMSE of the translation error over 100 m of true path (percent)",
        "%",
        ("RPE", "100 m"),
        table="always",
    ),
)
INTERVAL_M = 100.0
# A pair may exceed the interval by this much; a longer one spans a gap and is left out: 1.5 steps of the matched stamps
# for one second (the first stamp beyond it is at most one step late), a tenth for the 100 m (as in evo).
_LATEST_IN_STEPS = 1.5
_LONGEST_OVER_INTERVAL = 1.1


class _Intervals(NamedTuple):
    """Indices (p,), (p,) of the first and last matched pair of each interval."""

    first: IntArray
    last: IntArray


def score(evaluation: AgainstTruth) -> Scores:
    """Score drift over one second and over 100 m."""
    errors_of_a_second = cache(lambda: _errors_of_a_second(evaluation))
    return evaluate(
        {
            "rpe_1s_m": lambda: rmse(lengths(errors_of_a_second()[:, :3, 3])),
            "rpe_1s_deg": lambda: rmse(angles_deg(errors_of_a_second()[:, :3, :3])),
            "rpe_100m_percent": lambda: hundred_metres_percent(evaluation.oriented),
        }
    )


def hundred_metres_percent(matched: Matched) -> float:
    """Return the RMSE of the translation error over 100 m of true path, in percent; may raise Unavailable."""
    errors = relative_errors(matched, *_hundred_metres(matched))
    return rmse(lengths(errors[:, :3, 3])) / INTERVAL_M * 100.0


def _errors_of_a_second(evaluation: AgainstTruth) -> Array:
    return relative_errors(evaluation.oriented, *_one_second(evaluation.oriented))


def _one_second(matched: Matched) -> _Intervals:
    """Pair each stamp with the first one a second later, allowing for rounding of the stamps."""
    latest_ns = NS_PER_S + _LATEST_IN_STEPS * median_period_ns(matched.t_ns)
    intervals = _first_reaching(matched.t_ns, NS_PER_S - STAMP_TOLERANCE_NS, latest_ns)
    if not intervals.first.size:
        raise Unavailable("no two matched poses are 1 s apart")
    return intervals


def _hundred_metres(matched: Matched) -> _Intervals:
    """Pair each stamp with the first one 100 m further along the truth."""
    intervals = _first_reaching(matched.path_m, INTERVAL_M, _LONGEST_OVER_INTERVAL * INTERVAL_M)
    if not intervals.first.size:
        length_m = matched.path_m[-1] - matched.path_m[0]
        raise Unavailable(f"no two matched poses are 100 m apart; the matched path is {length_m:.1f} m")
    return intervals


def _first_reaching(along: Array | IntArray, least: float, most: float) -> _Intervals:
    """Pair each of the ascending values (n,) with the first at least ``least`` beyond; drop pairs beyond ``most``."""
    last = np.searchsorted(along, along + least)
    first = np.flatnonzero(last < along.size)
    last = last[first]
    near = along[last] - along[first] <= most
    return _Intervals(first[near], last[near])
