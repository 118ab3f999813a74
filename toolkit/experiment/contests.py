"""Who wins: rows of a comparison ranked by an error, and whether the first is better by more than chance.

One recording is one draw of the noise, so a single run names a winner only where a paired test over stretches of the
path supports it; over seeds the test is over the seeds.

The error of a trajectory drifts slowly, so that a whole path is nearly one draw of it: the ATE of two runs of one
estimator that differ by their noise alone differ by a factor of up to 3. The *drift* over each of many stretches of the
path is tested instead, which needs no alignment and is drawn many times. Two Gaussian mean squares have the ratio F,
each with the degrees of freedom of its own: those of the mean square of a correlated vector process (Bartlett, "On the
theoretical specification and sampling properties of autocorrelated time series", 1946), fewer where the squares scatter
more than Gaussian ones. Errors of two estimators of the same measurements are correlated, and their ratio then scatters
less, by sqrt(1 - r^2) (Pitman, "A note on normal correlation", Biometrika 31, 1939).

Wheel slip or a wrong start, which no single run can show, show where an estimator that corrects the measured motion by
vision differs from one that uses it alone by more than the covariances of both allow. That of the difference is assumed
to be the sum of both; it is at most that, because estimators of the same motion from the same start share errors, which
are then not negatively correlated. A difference shows that one of the two is inconsistent, not which (Hausman 1978,
"Specification tests in econometrics").
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from scipy.special import chdtri, fdtri

from toolkit.arrays import rows_of
from toolkit.estimate import Trajectory
from toolkit.experiment.statistics import Interval, jackknife_interval, mean_interval
from toolkit.experiment.units import drift_in_body
from toolkit.geometry import Array, se3_inverse, se3_log
from toolkit.jackknife import STRETCHES
from toolkit.measurements import NS_PER_S
from toolkit.metrics import Evaluation
from toolkit.metrics.correction_trend import NOTHING_CORRECTED, TREND
from toolkit.metrics.parts.evaluation import Matched
from toolkit.metrics.parts.scores import Unavailable
from toolkit.models.gating import mahalanobis_squared
from toolkit.models.state import POSE, POSITION, ROTATION

if TYPE_CHECKING:
    from toolkit.experiment.comparison import Row
    from toolkit.sequence import Sequence as Recorded

Question = Literal["accuracy at each frame", "accuracy in the end", "withheld tracks"]
HELD_OUT, COST = "heldout_reproj_median_px", "frame_cpu_ms_mean"
COVERAGE = "coverage_percent"
_YAW, _SE3 = "ate_yaw_m", "ate_se3_m"
# Rows that answered less than the best by more than this are left out: their errors are of a part of the recording.
_COVERAGE_MARGIN_PERCENT = 5.0
# Stretches a path is divided into, at most; with fewer than the second number nothing is tested.
MOST_STRETCHES, FEWEST_STRETCHES = 40, 10
# 99 % intervals. Where an error is nearly one draw for the whole run, as of ekf with an IMU, they are too narrow: there
# one in six pairs of runs that differ by noise alone is called clear (docs/metrics.md).
CONFIDENCE = 0.99
# Degrees of freedom that the estimate of their number uses up: a drift that keeps one direction has not three, but one.
_USED_UP, _LEAST_DOF = 2.0, 0.5
# Squared distance of two consistent estimates of a pose, over its degrees of freedom, that is exceeded once in a
# million.
FARTHEST = float(chdtri(6, 1e-6)) / 6.0
# Rounding of poses that are known exactly, as the first one may be: m and rad.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Advantage:
    """How many times as large an error of another is, with its 99 % interval, over ``n`` ``parts`` of the data."""

    ratio: float
    low: float
    high: float
    n: int
    parts: str


Compared = Callable[["Row", "Row"], Advantage | None]


@dataclass(frozen=True, eq=False)
class Contest:
    """Rows from the least of an error up; ``advantages`` of the first over each of the others, in their order.

    An advantage is None where there are too few data for a test.
    """

    question: Question
    metric: str
    rows: tuple[Row, ...]
    advantages: tuple[Advantage | None, ...]

    @property
    def worse(self) -> tuple[tuple[Row, Advantage], ...]:
        """Return the rows that are worse than the first by more than chance, in order, each with its advantage."""
        pairs = zip(self.rows[1:], self.advantages, strict=True)
        return tuple((row, one) for row, one in pairs if one is not None and one.low > 1.0)

    @property
    def leaders(self) -> tuple[Row, ...]:
        """Return the first row and those that may be as good."""
        worse = [row for row, _ in self.worse]
        return tuple(row for row in self.rows if row not in worse)

    @property
    def winner(self) -> Row | None:
        """Return the row that is better than every other by more than chance, unless a mark speaks against it."""
        alone = len(self.rows) > 1 and len(self.leaders) == 1
        return self.rows[0] if alone and not self.rows[0].mark else None


def contests_of(rows: Sequence[Row], sequence: Recorded) -> tuple[Contest, ...]:
    """Return what rows can be ranked by: the error against the truth, at each frame and in the end, withheld tracks.

    Only rows that ended well under every seed take part, and that answered for as much as the best one.
    """
    good = [row for row in rows if row.answered and row.counts["ok"] == len(row.outcomes)]
    most = max((row.value(COVERAGE) or 0.0 for row in good), default=0.0)
    able = [row for row in good if (row.value(COVERAGE) or 0.0) >= most - _COVERAGE_MARGIN_PERCENT]
    key = accuracy_of(able)
    over_seeds = any(len(row.outcomes) > 1 for row in able)
    test_drift, test_tracks = (_over_seeds(key), _over_seeds(HELD_OUT)) if over_seeds else _of_one_run(sequence)
    wanted: tuple[tuple[Question, str, tuple[str, ...], Compared], ...] = (
        ("accuracy at each frame", key, ("causal", "both"), test_drift),
        ("accuracy in the end", key, ("final", "both"), test_drift),
        ("withheld tracks", HELD_OUT, ("causal", "final", "both"), test_tracks),
    )
    found = (_contest(question, metric, able, labels, test) for question, metric, labels, test in wanted)
    return tuple(contest for contest in found if contest is not None)


def cheaper_near(contest: Contest, within: float, saves: float) -> Row | None:
    """Return the cheapest row ``within`` a factor of the first's error, if it ``saves`` this share of the time."""
    first = contest.rows[0]
    limit, most = within * (first.value(contest.metric) or 0.0), (1.0 - saves) * (first.value(COST) or 0.0)
    near = [row for row in contest.rows[1:] if (row.value(contest.metric) or np.inf) <= limit and row.value(COST)]
    best = min(near, key=lambda row: row.value(COST) or np.inf, default=None)
    return best if best is not None and (best.value(COST) or np.inf) <= most else None


def accuracy_of(rows: Iterable[Row]) -> str:
    """Return the ATE to rank by: after a fit of heading and position, but where a world's tilt is most of that error.

    The remark on such a value says so.
    """
    tilted = any(
        _YAW in scored.scores.notes and _SE3 not in scored.scores.notes and scored.scores.values.get(_YAW) is not None
        for row in rows
        for scored in row.good
    )
    return _SE3 if tilted else _YAW


def error_of(rows: Sequence[Row]) -> str:
    """Return the key of the error that rows have: the ATE, or without a truth that of withheld tracks."""
    key = accuracy_of(rows)
    return key if any(row.value(key) is not None for row in rows) else HELD_OUT


def _contest(
    question: Question, metric: str, rows: Iterable[Row], labels: tuple[str, ...], test: Compared
) -> Contest | None:
    """Return the contest of the rows with a label that have the metric, one an estimator; None of fewer than two."""
    scored = [row for row in rows if row.label in labels and row.value(metric) is not None]
    ranked = sorted(scored, key=lambda row: row.value(metric) or 0.0)
    best_of = {row.estimator: row for row in reversed(ranked)}
    ranked = [row for row in ranked if best_of[row.estimator] is row]
    if len(ranked) < 2:
        return None
    return Contest(question, metric, tuple(ranked), tuple(test(ranked[0], row) for row in ranked[1:]))


def _over_seeds(metric: str) -> Compared:
    def compared(one: Row, other: Row) -> Advantage | None:
        pairs = zip(one.good_values(metric), other.good_values(metric), strict=True)
        known = np.array([(a, b) for a, b in pairs if a is not None and b is not None]).reshape(-1, 2)
        return less_over_seeds(known[:, 0], known[:, 1])

    return compared


def _of_one_run(sequence: Recorded) -> tuple[Compared, Compared]:
    """Return the tests of the rows of one run: by drift against the truth, and by the withheld tracks both predict."""
    evaluations: dict[int, Evaluation] = {}

    def evaluation(row: Row) -> Evaluation:
        return evaluations.setdefault(id(row), Evaluation(row.run, row.output, sequence))

    def by_drift(one: Row, other: Row) -> Advantage | None:
        try:
            return less_drift(evaluation(one).compared, evaluation(other).compared)
        except Unavailable:
            return None

    def by_tracks(one: Row, other: Row) -> Advantage | None:
        (seen, mine), (also_seen, its) = evaluation(one).held_out_errors, evaluation(other).held_out_errors
        both, of_mine, of_its = np.intersect1d(seen, also_seen, assume_unique=True, return_indices=True)
        in_time = np.argsort(sequence.held_out.frame[both], kind="stable")
        errors: tuple[Array, Array] = (mine[of_mine][in_time], its[of_its][in_time])
        return less_median(*errors)

    return by_drift, by_tracks


class _Drift(NamedTuple):
    """The drift (K, 3) m over each stretch, and the degrees of freedom of its mean square."""

    over_m: Array
    dof: float


def less_drift(one: Matched, other: Matched) -> Advantage | None:
    """Return how many times as much the other drifts as the one, at the stamps that both have.

    None with fewer than ten stretches, or where one of them does not drift at all.
    """
    row, both = rows_of(one.t_ns, other.t_ns)
    mine, its = np.flatnonzero(both), row[both]
    count = min(MOST_STRETCHES, mine.size - 1)
    if count < FEWEST_STRETCHES:
        return None
    ends = _ends(one.path_m[mine], count)
    drifts = [
        _drift(pairs.truth[rows[ends]], pairs.estimate[rows[ends]]) for pairs, rows in ((one, mine), (other, its))
    ]
    if any(drift is None for drift in drifts):
        return None
    return _ratio(*(drift for drift in drifts if drift is not None))


def _ends(path_m: Array, count: int) -> Array:
    """Return the rows (count + 1,) that divide a path (n,) into stretches of equal length, each at least a step."""
    at_m = np.linspace(path_m[0], path_m[-1], count + 1)
    rows = np.searchsorted(path_m, at_m)
    step = np.arange(count + 1)
    # Where the vehicle stands still, stretches of no length would share their ends.
    rows = np.maximum.accumulate(np.maximum(rows, step) - step) + step
    return np.minimum(rows, path_m.size - 1 - step[::-1])


def _drift(truth: Array, estimate: Array) -> _Drift | None:
    """Return the drift between neighbouring poses (K + 1, 4, 4), or None where it is zero or overflows."""
    in_body_m = drift_in_body(truth, estimate)
    in_world_m = np.einsum("kij,kj->ki", truth[:-1, :3, :3], in_body_m)
    total = float(np.sum(in_body_m**2) ** 2)
    if not 0.0 < total < np.inf:
        return None
    # A wrong scale keeps its direction in the body, a wrong velocity or tilt in the world.
    dof = min(degrees_of_freedom(in_body_m), degrees_of_freedom(in_world_m)) - _USED_UP
    return _Drift(in_body_m, max(dof, _LEAST_DOF))


def degrees_of_freedom(vectors: Array) -> float:
    """Return the degrees of freedom of the mean square of correlated vectors (K, d) of mean zero.

    K times d where they are white, of equal variance in all directions and Gaussian.
    """
    count = len(vectors)
    squares = (vectors**2).sum(axis=1)
    mean = squares.mean()
    scatter = max(float(squares.var()), 2.0 * float(np.sum((vectors.T @ vectors / count) ** 2)))
    lagged = 0.0
    for lag in range(1, count // 2 + 1):
        cov = vectors[:-lag].T @ vectors[lag:] / count
        # Without the part that white vectors have by chance.
        lagged += float(np.sum(cov**2)) - (count - lag) / count**2 * mean**2
    return float(2.0 * count * mean**2 / (scatter + 4.0 * max(lagged, 0.0)))


def _ratio(one: _Drift, other: _Drift) -> Advantage:
    squares, others = np.sum(one.over_m**2), np.sum(other.over_m**2)
    shared = min(1.0, float(np.sum(one.over_m * other.over_m) ** 2 / (squares * others)))
    log_ratio, tail = 0.5 * np.log(others / squares), 0.5 * (1.0 - CONFIDENCE)
    narrowed = 0.5 * np.sqrt(1.0 - shared)
    above, below = (narrowed * np.log(fdtri(other.dof, one.dof, p)) for p in (1.0 - tail, tail))
    found = Interval(log_ratio, log_ratio - above, log_ratio - below)
    return _advantage(found, len(one.over_m), "stretches of the path")


def less_median(one: Array, other: Array) -> Advantage | None:
    """Return how many times as large the other's median is, of errors (M,) of the same things in order of time.

    By a block jackknife over ten stretches of time, with Student's t. None with fewer than ten errors a stretch.
    """
    if one.size < STRETCHES**2:
        return None

    def log_ratio(mine: Array, others: Array) -> float:
        return float(np.log(np.median(others) / np.median(mine)))

    found = jackknife_interval(log_ratio, one, other, level=1.0 - CONFIDENCE)
    return _advantage(found, STRETCHES, "stretches of time") if np.isfinite(found).all() else None


def less_over_seeds(one: Array, other: Array) -> Advantage | None:
    """Return how many times as large the other's errors (n,) are, seed by seed (geometric mean), by Student's t.

    None with fewer than three seeds, or where an error is not positive.
    """
    if one.size < 3 or not (np.minimum(one, other) > 0.0).all():
        return None
    return _advantage(mean_interval(np.log(other / one), 1.0 - CONFIDENCE), one.size, "seeds")


def _advantage(log_ratio: Interval, count: int, parts: str) -> Advantage:
    # A ratio of a million stands for any larger one, which a diverged run may have.
    ratio, low, high = np.exp(np.clip(log_ratio, -14.0, 14.0)).tolist()
    return Advantage(ratio, low, high, count, parts)


class FarthestPose(NamedTuple):
    """The largest distance of a row from the measured motion alone: time (s), distance, squared Mahalanobis distance.

    ``squared`` is divided by its 6 degrees of freedom: 1 on average where both are consistent and independent.
    """

    row: Row
    t_s: float
    distance_m: float
    angle_deg: float
    squared: float


def too_far(rows: Iterable[Row]) -> tuple[FarthestPose, ...]:
    """Return the rows that are farther from one that corrects nothing than chance allows; none over seeds.

    Over seeds no runs are kept.
    """
    rows = [row for row in rows if row.answered]
    uncorrected = [row for row in rows if row.value(TREND) is None and row.reason(TREND) == NOTHING_CORRECTED]
    motion = _trajectory(uncorrected[0]) if uncorrected else None
    if motion is None:
        return ()
    names = {row.estimator for row in uncorrected}
    apart = (farthest(row, motion) for row in rows if row.estimator not in names)
    return tuple(one for one in apart if one is not None and one.squared > FARTHEST)


def farthest(row: Row, motion: Trajectory) -> FarthestPose | None:
    """Return the largest Mahalanobis distance of a row from a trajectory, or None where a covariance is lacking."""
    other = _trajectory(row)
    if other is None or other.cov is None or motion.cov is None:
        return None
    _, mine, its = np.intersect1d(motion.t_ns, other.t_ns, assume_unique=True, return_indices=True)
    cov = motion.cov[mine][:, POSE, POSE] + other.cov[its][:, POSE, POSE] + _ROUNDING**2 * np.eye(6)
    apart = se3_log(se3_inverse(motion.T_world_imu[mine]) @ other.T_world_imu[its])
    known = np.isfinite(cov).all(axis=(1, 2)) & np.isfinite(apart).all(axis=1)
    if not known.any():
        return None
    squared = mahalanobis_squared(apart[known], cov[known])
    k = int(np.argmax(squared))
    t_s = (motion.t_ns[mine][known][k] - motion.t_ns[0]) / NS_PER_S
    distance_m, angle = np.linalg.norm(apart[known][k, POSITION]), np.linalg.norm(apart[known][k, ROTATION])
    return FarthestPose(row, float(t_s), float(distance_m), float(np.degrees(angle)), float(squared[k]) / 6.0)


def _trajectory(row: Row) -> Trajectory | None:
    run = row.outcomes[0].run
    return None if run is None or len(row.outcomes) > 1 else run.trajectory(row.output)
