"""One trajectory file against the truth: matched in time, checked to be of the same recording, scored.

The metrics are those of :mod:`toolkit.metrics`, from the same functions, and so is the rule of association;
``max_dt_s`` asks for that of evo (Grupp 2017) instead, the nearest pose. Stated covariances are judged as an
estimator's are. A truth that states some is another estimate of the same run, and a difference is compared with the sum
of both: errors that both share cancel in it, so that this finds too little, and never too much.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from toolkit.datasets.trajectories import read_poses
from toolkit.datasets.trajectories.belonging import Reference, body_of, other_axes, range_s
from toolkit.datasets.trajectories.covariances import CONVENTIONS, CovConvention
from toolkit.datasets.trajectories.formats import PosesFile, read_finite_poses, read_rows
from toolkit.errors import DataError
from toolkit.estimate import Trajectory
from toolkit.files.reading import is_regular
from toolkit.geometry import Array, IntArray
from toolkit.measurements import NS_PER_S
from toolkit.metrics import Metric, Scores, Unavailable, ate, clock_offset, coverage, drift, nees, rpe, uncertainty
from toolkit.metrics.parts.consistency import NOT_MET, OTHER_WORLD, BodyErrors, StatedErrors, nees_of, with_covariances
from toolkit.metrics.parts.evaluation import (
    STAMP_TOLERANCE_NS,
    Matched,
    PairsAgainstTruth,
    changes,
    distance_along,
    median_period_ns,
    poses_at,
)
from toolkit.metrics.parts.readings import likelier_reading
from toolkit.models.gating import chi2_bound
from toolkit.sequence import content_digest

TIME_COVERAGE = "time_coverage_percent"
COVERAGE = Metric(
    TIME_COVERAGE,
    "the truth's time that lies between poses no farther apart than the longest gap (percent)",
    "%",
    ("cover", "time"),
    name="time coverage",
    best="most",
    table="always",
)
_PAIRS = next(metric for metric in coverage.METRICS if metric.key == "pairs")
_NEES_KEYS = (*nees.OF_POSE, *(metric.key for metric in uncertainty.METRICS))
METRICS: tuple[Metric, ...] = (
    *ate.METRICS,
    *rpe.METRICS,
    *drift.METRICS,
    *clock_offset.METRICS,
    *(metric for metric in nees.METRICS if metric.key in _NEES_KEYS),
    *uncertainty.METRICS,
    COVERAGE,
    _PAIRS,
)
_OVER_A_SECOND = ("rpe_1s_m", "rpe_1s_deg")
# Metrics that need stamps.
_OF_THE_CLOCK = (*_OVER_A_SECOND, *(metric.key for metric in clock_offset.METRICS))
_OF_POSITIONS = tuple(metric.key for metric in ate.METRICS)
_OF_ORIENTATIONS = ("ate_se3_deg", *_OVER_A_SECOND, "rpe_100m_percent", "kitti_t_percent", "kitti_r_deg_per_m")
# Metrics that depend on the body's axes, and not on its position alone.
OF_THE_BODY = ("ate_none_m", *_OF_ORIENTATIONS, "end_drift_percent")
# Remarks where the truth repeats one position, where an estimate repeats one pose, or leaps. It leaps where one of its
# steps is this much longer (m) than the truth's, and this many times as long as its usual step.
_STANDS = (
    "the truth stands still, all its positions are one: these are the estimate's own motion, unless it ought to stand"
)
_STAYS = "the estimate stands still, all its positions are one: its errors are the truth's own motion"
_LOOKS_ONE_WAY = (
    "the estimate's orientations are all one, as where none was written: these are the truth's own rotations"
)
_OFF = (
    "its orientations are off by one turn of {:.1f} deg, about which they scatter by {:.1f} deg: an extrinsic is off, "
    "and not the estimate alone"
)
_OTHER_AXES = "its poses are of a body with other axes than the truth's"
_LEAPS = "the estimate jumps, {} time(s), the farthest by {:.3g} m {:.1f} s after its first pose"
_LEAST_LEAP_M, _TIMES_USUAL = 0.5, 20.0
# Of the hash of a truth: significant digits that are hashed, hexadecimal digits that are kept.
_DIGITS, _LENGTH = 9, 16
_TIMES = "times.txt"  # where KITTI has the stamps of poses
# Assumed interval of frames without stamps, where only their order matters.
_FRAME_NS = NS_PER_S // 10
NO_COVARIANCE = "the file states no covariance"
_NO_CONVENTION = "the file does not say what its covariances mean: name it with --cov-convention"
_OF_TWO = (
    "the truth states covariances: differences are compared with the sum of both, and what both share is not found"
)


@dataclass(frozen=True)
class Terms:
    """How trajectories are scored.

    ``max_dt_s`` pairs each pose with the nearest one that is no farther in time, None interpolates; ``offset_s`` is
    added to the stamps of the trajectories; ``gap_s`` is the longest time between two poses that counts as covered;
    ``level`` says that the vertical is measured, as by an IMU; a run that covers less than ``least_coverage_percent``
    of the truth's time counts as failed. ``cov_convention`` is that of covariances where a file does not say it.
    """

    max_dt_s: float | None = None
    offset_s: float = 0.0
    gap_s: float = 5.0
    level: bool = False
    least_coverage_percent: float = 50.0
    cov_convention: CovConvention | None = None


@dataclass(frozen=True, eq=False)
class TruthFile:
    """The truth of a sequence, poses (N, 4, 4) on stamps (N,) ns; these are its lines where it has none.

    ``left_out`` are lines without a pose; ``cov`` (N, d, d) is there where it is another estimate, and states
    covariances.
    """

    path: Path
    t_ns: IntArray
    poses: Array
    name: str
    is_timed: bool
    left_out: str = ""
    cov: Array | None = None

    @property
    def digest(self) -> str:
        """Return a hash of the content, which another way to print it does not change."""
        return content_digest((self.t_ns, self.poses), _DIGITS)[:_LENGTH]

    @cached_property
    def reference(self) -> Reference:
        """The reference by which a trajectory is checked to be of this sequence."""
        return Reference.of_truth(self.name, self.t_ns, self.poses)

    @property
    def duration_s(self) -> float:
        return float((self.t_ns[-1] - self.t_ns[0]) / NS_PER_S)

    @property
    def path_m(self) -> float:
        return float(distance_along(self.poses[:, :3, 3])[-1])


def read_truth(name: str, path: Path, cov_convention: CovConvention | None = None) -> TruthFile:
    """Read the truth of a sequence, without the lines that hold no finite pose.

    ``cov_convention`` is that of its covariances where it has some and does not say it. Raises DataError where it is
    none, or holds fewer than two poses.
    """
    file = _with_times(read_finite_poses(path, cov_convention))
    if len(file) < 2:
        raise DataError(f"{path}: a truth of {len(file)} pose; give at least two")
    file.check_order()
    t_ns = np.arange(len(file), dtype=np.int64) * _FRAME_NS if file.t_ns is None else file.t_ns
    cov = None if file.covariances is None else file.covariances.of(file.T_world_imu)
    return TruthFile(path, t_ns, file.T_world_imu, name, file.t_ns is not None, file.not_finite, cov)


def _with_times(file: PosesFile) -> PosesFile:
    """Return the poses with the stamps of KITTI's times.txt, where a file has none and it as many lines."""
    folder = file.path.parent
    places = (folder / _TIMES, folder.parent / "sequences" / file.path.stem / _TIMES)
    times = next(filter(is_regular, places), None)
    if file.t_ns is not None or times is None:
        return file
    rows = read_rows(times, "times.txt has a stamp in seconds for each pose")
    as_many = len(rows.cells) == len(file) and rows.width == 1
    return replace(file, t_ns=rows.stamps(NS_PER_S)) if as_many else file


def _read(path: Path, truth: TruthFile, terms: Terms) -> tuple[PosesFile, Trajectory]:
    """Read a file, and return its poses on their stamps, or on the truth's where it has none but as many lines."""
    file = read_poses(path, terms.cov_convention)
    if len(file) == 0:
        raise DataError(f"{path}: it holds no poses")
    if file.t_ns is None and truth.is_timed and len(file) != len(truth.poses):
        file = _with_times(file)
    if file.t_ns is not None and truth.is_timed:
        return file, file.trajectory(file.t_ns + round(terms.offset_s * NS_PER_S))
    if file.t_ns is not None:
        raise DataError(
            f"{truth.path}: it has no stamps, and {path} has; put {_TIMES} with a stamp in seconds for each pose "
            "beside it, or give both without stamps"
        )
    if len(file) != len(truth.poses):
        what = f"{path}: {len(file)} lines without stamps, and the truth has {len(truth.poses)} poses"
        raise DataError(f"{what}; write a pose for each, or a format with stamps")
    return file, file.trajectory(truth.t_ns)


def aligned_file(path: Path, truth: TruthFile, terms: Terms) -> Matched:
    """Return the pairs that are scored, after the fit of SE(3) to all positions.

    Raises DataError where the file cannot be used, Unavailable where nothing can be fitted.
    """
    matched = _matched(path, _read(path, truth, terms)[1], truth, terms.max_dt_s)
    return replace(matched, estimate=PairsAgainstTruth(matched).se3_alignment.apply(matched.estimate))


def score_file(path: Path, truth: TruthFile, terms: Terms) -> Scores:
    """Return every metric of a trajectory file, None with the reason where one cannot be computed.

    Raises DataError where the file cannot be used or does not belong to the truth: a wrong clock, unit of time or of
    length, order of quaternions or number of lines is named.
    """
    file, estimate = _read(path, truth, terms)
    near = matched_poses(estimate, truth)
    turn = body_of(file, truth.reference, estimate.t_ns, (near.truth, near.estimate))
    matched = _matched(path, estimate, truth, terms.max_dt_s)
    scores = _score(matched, file, estimate, truth, terms)
    if not truth.is_timed:
        scores = scores.without(_OF_THE_CLOCK, "the files have no stamps")
    if turn is not None and turn.is_other_body:
        scores = scores.without((*OF_THE_BODY, *_NEES_KEYS), f"{_OTHER_AXES}: {other_axes(turn.R_truth_body)}")
    elif turn is not None and turn.is_told:
        off_deg, scatter_deg = np.degrees((turn.angle_rad, turn.scatter_rad))
        scores = scores.remarked(_OF_ORIENTATIONS, _OFF.format(off_deg, scatter_deg))
    for keys, remark in _on_standstill_and_leaps(matched):
        scores = scores.remarked(keys, remark)
    left_out = truth.left_out and f"left out of the truth: {truth.left_out}"
    paired = filter(None, (_how_matched(estimate, truth, terms.max_dt_s), left_out))
    return scores.remarked([_PAIRS.key], "; ".join(paired))


def _on_standstill_and_leaps(matched: Matched) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield remarks, with the metrics they are on: truth or estimate never moves or turns, or the estimate leaps."""
    truth, estimate = matched.truth, matched.estimate
    moves, true_moves = changes(estimate[:, :3, 3]), changes(truth[:, :3, 3])
    if moves != true_moves:
        yield _OF_POSITIONS, _STANDS if moves else _STAYS
    if moves and changes(truth[:, :3, :3]) and not changes(estimate[:, :3, :3]):
        yield _OF_ORIENTATIONS, _LOOKS_ONE_WAY
    true_m, step_m = (np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) for poses in (truth, estimate))
    leaps = (step_m > true_m + _LEAST_LEAP_M) & (step_m > _TIMES_USUAL * np.median(step_m))
    if leaps.any():
        row = int(np.argmax(np.where(leaps, step_m, 0.0)))
        at_s = float(matched.t_ns[row] - matched.t_ns[0]) / NS_PER_S
        yield _OF_POSITIONS, _LEAPS.format(int(leaps.sum()), step_m[row], at_s)


def _matched(path: Path, estimate: Trajectory, truth: TruthFile, max_dt_s: float | None) -> Matched:
    matched = matched_poses(estimate, truth) if max_dt_s is None else nearest_poses(estimate, truth, max_dt_s)
    if len(estimate) < 2:
        raise DataError(f"{path}: it has one pose, and errors are of two and more; write the whole trajectory")
    if len(matched) < 2:
        raise DataError(
            f"{path}: {len(matched)} of its poses match the truth in time; it covers "
            f"{range_s(estimate.t_ns)}, the truth {range_s(truth.t_ns)}; shift the one or the other with --offset, "
            "or allow more with --max-dt"
        )
    return matched


def time_coverage_percent(t_ns: IntArray, truth_t_ns: IntArray, gap_s: float) -> float:
    """Return the percentage of the truth's time (N,) ns that lies between stamps (n,) ns at most ``gap_s`` apart.

    Keyframes that are seconds apart cover the time between them; a lost track does not. What precedes the first pose
    and follows the last one is not covered.
    """
    begin, end = int(truth_t_ns[0]), int(truth_t_ns[-1])
    within = np.clip(t_ns, begin, end)
    gaps = np.diff(within)
    covered = float(gaps[np.diff(t_ns) <= gap_s * NS_PER_S].sum())
    return 100.0 * covered / max(end - begin, 1)


def matched_poses(estimate: Trajectory, truth: TruthFile) -> Matched:
    """Return the pairs on the stamps of the sparser of the two, between whose neighbours the other is interpolated."""
    path_m = distance_along(truth.poses[:, :3, 3])
    truth_period_ns, period_ns = median_period_ns(truth.t_ns), median_period_ns(estimate.t_ns)
    if truth_period_ns > period_ns:
        met, poses = poses_at(estimate.t_ns, estimate.T_world_imu, truth.t_ns, period_ns)
        return Matched(truth.t_ns[met], truth.poses[met], poses, path_m[met])
    met, true = poses_at(truth.t_ns, truth.poses, estimate.t_ns, truth_period_ns)
    t_ns = estimate.t_ns[met]
    return Matched(t_ns, true, estimate.T_world_imu[met], np.interp(t_ns, truth.t_ns, path_m))


def nearest_poses(estimate: Trajectory, truth: TruthFile, max_dt_s: float) -> Matched:
    """Pair each pose of the one with fewer poses with the nearest of the other, as evo does; nothing is interpolated.

    Of two that are equally near it is the earlier one; a pose may be paired twice.
    """
    path_m = distance_along(truth.poses[:, :3, 3])
    estimate_is_longer = estimate.t_ns.size > truth.t_ns.size
    few, many = (truth.t_ns, estimate.t_ns) if estimate_is_longer else (estimate.t_ns, truth.t_ns)
    nearest = _nearest(many, few)
    met = np.flatnonzero(np.abs(many[nearest] - few) <= max_dt_s * NS_PER_S)
    rows, others = (nearest[met], met) if estimate_is_longer else (met, nearest[met])
    return Matched(estimate.t_ns[rows], truth.poses[others], estimate.T_world_imu[rows], path_m[others])


def _score(matched: Matched, file: PosesFile, estimate: Trajectory, truth: TruthFile, terms: Terms) -> Scores:
    pairs = PairsAgainstTruth(matched, terms.level)
    covered = time_coverage_percent(estimate.t_ns, truth.t_ns, terms.gap_s)
    scores = Scores({COVERAGE.key: covered, _PAIRS.key: len(matched)})
    with np.errstate(all="ignore"):  # a value that is not finite becomes None, with that as its reason
        for metrics in (ate, rpe, drift, clock_offset):
            scores |= Scores.attempt(metrics.METRICS, partial(metrics.score, pairs))
        return scores | _nees_scores(file, estimate, truth, level=terms.level)


def _how_matched(estimate: Trajectory, truth: TruthFile, max_dt_s: float | None) -> str:
    """Say how poses were paired where stamps differ, which is needed to compare with numbers of other tools."""
    if not truth.is_timed:
        return "paired line by line, for the files have no stamps"
    few, many = sorted((estimate.t_ns, truth.t_ns), key=lambda t_ns: t_ns.size)
    apart_ms = np.abs(many[_nearest(many, few)] - few) / 1e6
    off = apart_ms > STAMP_TOLERANCE_NS / 1e6
    if not off.any():
        return ""
    typical = f"{float(np.median(apart_ms[off])):.3g} ms"
    if max_dt_s is None:
        return f"{int(off.sum())} of {few.size} stamps lie {typical} off the other's, and poses are interpolated there"
    return f"paired with the nearest pose, {typical} off, and not interpolated"


def _nees_scores(file: PosesFile, estimate: Trajectory, truth: TruthFile, *, level: bool) -> Scores:
    """Return the scores of the stated covariances, None with the reason.

    Errors are in the truth's world, or placed by the first pose if that is not plausible there under its own
    covariance. The remark is where their convention, by the truth, is another one.
    """
    covariances = file.covariances
    if covariances is None:
        return Scores.none(_NEES_KEYS, NO_COVARIANCE)
    met, true = poses_at(truth.t_ns, truth.poses, estimate.t_ns, median_period_ns(truth.t_ns))
    if not met.any():
        return Scores.none(_NEES_KEYS, NOT_MET)
    rows = np.flatnonzero(met)
    compared = estimate.t_ns[rows], rows, estimate.T_world_imu[rows], true

    def errors(cov: Array, *, placed: bool) -> StatedErrors:
        if truth.cov is not None:
            cov = cov[:, :6, :6] + truth.cov[_nearest(truth.t_ns, estimate.t_ns), :6, :6]
        return with_covariances(BodyErrors.between(*compared, placed=placed, level=level), cov)

    def is_in_the_truths_world(cov: Array) -> bool:
        with suppress(Unavailable):
            first = nees_of(errors(cov, placed=False))
            return bool(max(first.orientation[0], first.position[0]) <= chi2_bound(3, 1.0 - OTHER_WORLD) / 3.0)
        return False

    # The same errors for all readings: in the truth's world if any of them allows it.
    readings = (covariances.read_as(one, file.T_world_imu) for one in CONVENTIONS.values())
    placed = not any(map(is_in_the_truths_world, readings))
    likelier = likelier_reading(covariances, file.T_world_imu, partial(errors, placed=placed))
    if estimate.cov is None:
        return Scores.none(_NEES_KEYS, "; ".join(filter(None, (_NO_CONVENTION, likelier))))
    try:
        stated = errors(estimate.cov, placed=not is_in_the_truths_world(estimate.cov))
    except Unavailable as reason:
        return Scores.none(_NEES_KEYS, str(reason))
    scores = nees.of_stated(stated) | uncertainty.of_stated(stated)
    remark = "; ".join(filter(None, (likelier, "" if truth.cov is None else _OF_TWO)))
    return scores.remarked(_NEES_KEYS, remark)


def _nearest(t_ns: IntArray, at_ns: IntArray) -> IntArray:
    """Return the indices (M,) of stamps (N,) nearest to others (M,), the earlier of two that are equally near."""
    before = np.clip(np.searchsorted(t_ns, at_ns) - 1, 0, t_ns.size - 1)
    after = np.minimum(before + 1, t_ns.size - 1)
    return np.asarray(np.where(at_ns - t_ns[before] <= t_ns[after] - at_ns, before, after))
