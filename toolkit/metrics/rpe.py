"""Relative pose error over one second and over 100 metres, and KITTI's drift: independent of earlier errors.

Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems" (IROS 2012), eqs. 2-3. Geiger, Lenz and Urtasun,
"Are we ready for autonomous driving?" (CVPR 2012), as its development kit computes them: segments start at every tenth
pose, end at the first pose whose distance along the truth exceeds the length, and their errors are divided by the
nominal length; the mean is over all segments of all lengths.
"""

from functools import cache

import numpy as np

from toolkit.geometry import Array, IntArray
from toolkit.measurements import NS_PER_S
from toolkit.metrics.parts.evaluation import (
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
RPE = (
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
KITTI = (
    Metric(
        "kitti_t_percent", "mean translation error over segments of 100 ... 800 m (percent)", "%", ("KITTI", "trans")
    ),
    Metric(
        "kitti_r_deg_per_m", "mean rotation error over segments of 100 ... 800 m (deg/m)", "deg/m", ("KITTI", "rot")
    ),
)
METRICS = RPE + KITTI
INTERVAL_M = 100.0
SEGMENT_LENGTHS_M = np.arange(100.0, 801.0, 100.0)
START_EVERY = 10
# A pair may exceed the interval by this much; a longer one spans a gap and is left out: 1.5 steps of the matched stamps
# for one second (the first stamp beyond it is at most one step late), a tenth for the 100 m (as in evo).
_LATEST_IN_STEPS = 1.5
_LONGEST_OVER_INTERVAL = 1.1


def score(evaluation: AgainstTruth) -> Scores:
    errors_of_a_second = cache(lambda: relative_errors(evaluation.oriented, *_one_second(evaluation.oriented)))
    rpe = evaluate(
        {
            "rpe_1s_m": lambda: rmse(lengths(errors_of_a_second()[:, :3, 3])),
            "rpe_1s_deg": lambda: rmse(angles_deg(errors_of_a_second()[:, :3, :3])),
            "rpe_100m_percent": lambda: _hundred_metres_percent(evaluation.oriented),
        }
    )
    return rpe | Scores.attempt(KITTI, lambda: _kitti(evaluation.oriented))


def _kitti(matched: Matched) -> Scores:
    starts = np.arange(0, len(matched), START_EVERY)
    first, length_m = (grid.ravel() for grid in np.meshgrid(starts, SEGMENT_LENGTHS_M, indexing="ij"))
    last = np.searchsorted(matched.path_m, matched.path_m[first] + length_m, side="right")
    complete = last < len(matched)
    if not complete.any():
        raise Unavailable(f"the matched path, {matched.path_m[-1] - matched.path_m[0]:.1f} m, has no segment of 100 m")
    errors = relative_errors(matched, first[complete], last[complete])
    t_per_m, r_deg_per_m = (
        of(part) / length_m[complete] for of, part in ((lengths, errors[:, :3, 3]), (angles_deg, errors[:, :3, :3]))
    )
    return Scores({"kitti_t_percent": 100.0 * float(t_per_m.mean()), "kitti_r_deg_per_m": float(r_deg_per_m.mean())})


def _one_second(matched: Matched) -> tuple[IntArray, IntArray]:
    """Pair each stamp with the first one a second later, allowing for rounding of the stamps."""
    latest_ns = NS_PER_S + _LATEST_IN_STEPS * median_period_ns(matched.t_ns)
    first, last = _first_reaching(matched.t_ns, NS_PER_S - STAMP_TOLERANCE_NS, latest_ns)
    if not first.size:
        raise Unavailable("no two matched poses are 1 s apart")
    return first, last


def _hundred_metres_percent(matched: Matched) -> float:
    """Return the RMSE of the translation error from each stamp to the first one 100 m further along the truth."""
    first, last = _first_reaching(matched.path_m, INTERVAL_M, _LONGEST_OVER_INTERVAL * INTERVAL_M)
    if not first.size:
        length_m = matched.path_m[-1] - matched.path_m[0]
        raise Unavailable(f"no two matched poses are 100 m apart; the matched path is {length_m:.1f} m")
    return rmse(lengths(relative_errors(matched, first, last)[:, :3, 3])) / INTERVAL_M * 100.0


def _first_reaching(along: Array | IntArray, least: float, most: float) -> tuple[IntArray, IntArray]:
    """Pair each of the ascending values (n,) with the first at least ``least`` beyond, but for pairs beyond ``most``.

    Return the indices (p,), (p,) of both.
    """
    last = np.searchsorted(along, along + least)
    first = np.flatnonzero(last < along.size)
    last = last[first]
    near = along[last] - along[first] <= most
    return first[near], last[near]
