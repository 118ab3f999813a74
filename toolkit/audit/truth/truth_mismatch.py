"""A truth that moves otherwise than vision: it is of another motion, or vision's scale is wrong.

Over windows of time the camera's own displacement and turn, chained from frame to frame, are held against those of the
truth. Vision's steps are too long or too short where the baseline or the focal length is wrong, or the truth is in
another unit; they go elsewhere where the truth is another recording's, runs backwards or is in other axes. Where it is
of this motion, the camera turns as it does, but for an offset of its clock.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.alignment import chained
from toolkit.audit.parts.intervals import LEAST_INTERVALS, is_comparable, moved_by
from toolkit.audit.parts.robust import Scalar, chance_sigmas, median_error
from toolkit.audit.parts.truth_clock import LEAST_OFFSET_S, OFFSET_SIGMAS
from toolkit.datasets.trajectories.exchanged_axes import exchanges
from toolkit.geometry import Array, BoolArray, IntArray, interpolate_poses, se3_inverse, so3_log
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence, Truth

# Long enough that the noise of single frames hardly counts, short enough that five seconds hold ten of them.
WINDOW_S = 0.5
LEAST_WINDOWS = 4
# What is chance less often than this, by Student's t of as many windows, counts ...
LEVEL = 1e-3
# ... beyond what sound recordings at hand have; chosen with them in view.
SYSTEMATIC = 0.06
# Motions that have nothing to do with each other differ by more than they are large; a truth that errs, by far less.
MOST_OFF = 0.5
# A scale is the difference where little is left of it after scaling; while a vehicle stands there is only noise.
MOST_SCALED_OFF = 0.25
# A truth's noise feigns motion of what hardly moves (m, rad over a window).
LEAST_MOVED_M, LEAST_TURNED_RAD = 0.02, 0.03
# A vehicle that fills the view turns vision alone, but not for a third of the time.
LEAST_TURNING = 1.0 / 3.0
# From one true pose to the next: so far (m) and so many times the usual speed (m/s) is no motion.
LEAST_LEAP_M, LEAP, LEAST_LEAP_MPS = 0.5, 10.0, 10.0
# So many times as far as counts as a motion the camera drives while the truth stands; for half of the time no vehicle
# fills the view, and no truth that was measured repeats a pose exactly while it does.
DRIVES, MOST_STANDING = 5.0, 0.5
# Root mean squares, as shares of the motion: a truth that is so far off is tried in other readings, and taken to
# be of one where it is so many times nearer then. In sound recordings at hand it never is.
LEAST_APART, TIMES_NEARER = 0.1, 3.0
# Lengths (m) that a truth is written in by mistake; millimetres and centimetres are converted (`units`).
LENGTHS = {"feet": 0.3048, "yards": 0.9144, "inches": 0.0254, "kilometres": 1000.0}
_WHERE = "check the baseline and the focal length (the camera's calibration file), and the unit of the truth"
_OTHER = "check that the truth is this recording's, in order and in the axes it is read in; distrust what rests on it"

_AXES = "write the truth in the axes it is read in: the world's, z upwards, and the body's that the samples have"


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Hold the camera's own motion against the truth's, in direction and in size."""
    truth = evidence.sequence.truth
    if truth is None or truth.t_ns.size < 2 or evidence.spoilt_by or not is_comparable(evidence.sequence):
        return None
    if evidence.camera_motion.known.sum() < LEAST_INTERVALS:
        return None
    return _broken(truth) or _by_another_clock(evidence) or _compared_with(evidence, truth)


def steps_beside_camera(sequence: Sequence, trajectory: Truth) -> Scalar | None:
    """Return how many times as long as the camera's own a trajectory's steps are, where that factor alone parts them.

    None where it is chance or no more than sound recordings have, or where the tracks do not tell.
    """
    evidence = Evidence(sequence)
    if not is_comparable(sequence) or evidence.camera_motion.known.sum() < LEAST_INTERVALS:
        return None
    both = _windows(evidence, trajectory)
    moved = _moving(both.displaced_m, LEAST_MOVED_M)
    if moved.sum() < LEAST_WINDOWS:
        return None
    scale, only_longer = _longer(*both.displaced_m[:, moved])
    if not only_longer or abs(scale.value - 1.0) < SYSTEMATIC + scale.by_chance:
        return None
    return Scalar(1.0 / scale.value, scale.error / scale.value**2)


def _broken(truth: Truth) -> Symptom | None:
    """Tell of poses that are not finite, or between which nothing can have moved: a reset, a flipped bit."""
    finite = np.isfinite(truth.T_world_imu).all(axis=(1, 2))
    if not finite.all():
        return _symptom(
            f"{int((~finite).sum())} of {finite.size} true poses are not finite", "leave them out of the file"
        )
    step_s = np.maximum(np.diff(truth.t_ns), 1) / NS_PER_S
    step_m = np.linalg.norm(np.diff(truth.T_world_imu[:, :3, 3], axis=0), axis=1)
    usual_mps = float(np.quantile(step_m / step_s, 0.9))
    leaps = (step_m > LEAST_LEAP_M) & (step_m / step_s > max(LEAP * usual_mps, LEAST_LEAP_MPS))
    if not leaps.any():
        return None
    row = int(np.argmax(np.where(leaps, step_m, 0.0)))
    at_s = (truth.t_ns[row] - truth.t_ns[0]) / NS_PER_S
    return _symptom(
        f"the truth leaps {int(leaps.sum())} time(s), the farthest by {step_m[row]:.3g} m at {at_s:.1f} s of it",
        "cut it there, or leave the pose out: every position error holds the leap",
    )


def _compared_with(evidence: Evidence, truth: Truth) -> Symptom | Undecided | None:
    both = _windows(evidence, truth)
    moved, turned = _moving(both.displaced_m, LEAST_MOVED_M), _moving(both.turned_rad, LEAST_TURNED_RAD)
    if (stands := _standing(both, moved) or _looking_one_way(truth, both)) is not None:
        return stands
    if moved.sum() < LEAST_WINDOWS:
        return Undecided(
            f"the truth moves by {LEAST_MOVED_M:g} m and more, and the camera's own motion is known, in {moved.sum()} "
            f"windows of {WINDOW_S:g} s; {LEAST_WINDOWS} are needed"
        )
    if (other := _read_otherwise(evidence, truth, both)) is not None:
        return other
    off = {"moves": _off(both.displaced_m[:, moved])}
    if turned.sum() >= max(LEAST_WINDOWS, LEAST_TURNING * moved.sum()):
        off["turns"] = _off(both.turned_rad[:, turned])
    elsewhere = {
        how: f"it {how} otherwise, by {100.0 * share.value:.0f} +- {100.0 * share.error:.0f} % of the larger of both"
        for how, share in off.items()
        if share.value - share.by_chance > MOST_OFF
    }
    seen, true = both.displaced_m[:, moved]
    scale, only_longer = _longer(seen, true)
    if "turns" in elsewhere or (elsewhere and not only_longer):
        return _symptom(f"the truth's motion is not the camera's: {' and '.join(elsewhere.values())}", _OTHER)
    if not only_longer or abs(scale.value - 1.0) < SYSTEMATIC + scale.by_chance:
        return _doubtful(scale) if only_longer else None
    unit = "".join(f", as of one in {name}" for name, m in LENGTHS.items() if abs(scale.value / m - 1.0) < SYSTEMATIC)
    return _symptom(f"vision's steps are {scale.value:.3f} +- {scale.error:.3f} times the truth's{unit}", _WHERE)


def _doubtful(scale: "_Compared") -> Undecided | None:
    """Say of a scale that it is more than chance and no more than sound recordings have."""
    if abs(scale.value - 1.0) <= scale.by_chance:
        return None
    return Undecided(
        f"vision's steps are {scale.value:.3f} +- {scale.error:.3f} times the truth's, which is more than chance and "
        "no more than in sound recordings: the truth's unit, the baseline or the focal length may be off by it"
    )


def _standing(both: "_Windows", moved: BoolArray) -> Symptom | None:
    """Tell of a truth that stands in more than chance of the windows while the camera drives, or in most of them."""
    drives_m = np.linalg.norm(both.displaced_m[0], axis=1)
    frozen = (both.displaced_m[1] == 0.0).all(axis=1) & (both.turned_rad[1] == 0.0).all(axis=1)
    apart = ~moved & (drives_m > DRIVES * LEAST_MOVED_M)
    in_most = apart.sum() >= max(LEAST_WINDOWS, MOST_STANDING * moved.size)
    if not in_most and (apart & frozen).sum() < LEAST_WINDOWS:
        return None
    speed_mps = float(np.median(drives_m[apart])) / WINDOW_S
    return _symptom(
        f"the truth stands still in {apart.sum()} of {moved.size} windows of {WINDOW_S:g} s in which the camera moves "
        f"at {speed_mps:.2g} m/s",
        "it is no truth of this motion, or was frozen: leave it out, for errors and consistency against it say nothing",
    )


def _looking_one_way(truth: Truth, both: "_Windows") -> Symptom | None:
    """Tell of a truth whose orientations are all one, as where none was written, in windows in which the camera turns.

    A truth that was measured repeats no orientation exactly, so that noise of the camera alone has to be less.
    """
    turns_rad = np.linalg.norm(both.turned_rad[0], axis=1)
    turns = turns_rad > LEAST_TURNED_RAD
    if np.ptp(truth.T_world_imu[:, :3, :3], axis=0).max() > 0.0 or turns.sum() < LEAST_WINDOWS:
        return None
    return _symptom(
        f"all orientations of the truth are one, and in {turns.sum()} of {turns.size} windows of {WINDOW_S:g} s the "
        f"camera turns by {float(np.median(turns_rad[turns])):.2g} rad (median)",
        "write the orientations, or leave the truth out: errors of orientation and NEES against it say nothing",
    )


def _read_otherwise(evidence: Evidence, truth: Truth, both: "_Windows") -> Symptom | None:
    """Tell of a truth that moves as the camera does backwards, or in other axes, and not as given, as ``both`` are."""
    given = _apart(both)
    if not given > LEAST_APART:
        return None
    for reading, remedy, T_world_imu in _readings(truth.T_world_imu):
        apart = _apart(_windows(evidence, replace(truth, T_world_imu=T_world_imu)))
        if apart < given / TIMES_NEARER:
            summary = (
                f"the truth's motion is not the camera's, but for one {reading}, by which they differ by {apart:.1%}"
            )
            return _symptom(f"{summary} and not by {given:.0%}", remedy)
    return None


def _readings(T_world_imu: Array) -> Iterator[tuple[str, str, Array]]:
    """Yield what a truth may be in the place of what it is: in words, what to do about it, and the poses."""
    yield "whose poses run backwards", "write them in the order of their stamps", T_world_imu[::-1]
    for exchange in exchanges():
        yield f"with {exchange.description}", _AXES, exchange.reread(T_world_imu)


def _apart(both: "_Windows") -> float:
    """Return how far the two of windows are apart, as a share of what the truth moves and turns: root mean squares."""
    squared = [
        np.mean((x[0] - x[1]) ** 2) / max(float(np.mean(x[1] ** 2)), least**2)
        for x, least in ((both.displaced_m, LEAST_MOVED_M), (both.turned_rad, LEAST_TURNED_RAD))
    ]
    return float(np.sqrt(sum(squared)))


def _by_another_clock(evidence: Evidence) -> Symptom | None:
    """Tell of a truth that turns as the camera does at other times, unless by a clock of another pace."""
    clock = evidence.truth_clock
    if clock is None or clock.offset is None or clock.runs_otherwise:
        return None
    found = clock.offset
    if abs(found.value) < max(LEAST_OFFSET_S, OFFSET_SIGMAS * found.error):
        return None
    return _symptom(
        f"the camera turns as the truth does when the truth's stamps are shifted by {-1e3 * found.value:.0f} +- "
        f"{1e3 * found.error:.0f} ms",
        "stamp both by one clock: every position error holds the way that is gone in that time",
    )


def _symptom(detail: str, treatment: str) -> Symptom:
    return Symptom.warning(count=1, detail=detail, treatment=treatment)


class _Windows(NamedTuple):
    """What the camera and the truth (2, ...) move (2, M, 3) m and turn (2, M, 3) rad by over M windows, in the axes
    that the camera has where each begins."""

    displaced_m: Array
    turned_rad: Array


def _windows(evidence: Evidence, truth: Truth) -> _Windows:
    """Return both over windows in which every interval of the camera is known and the truth has poses close by."""
    sequence, camera = evidence.sequence, evidence.camera_motion
    t_ns = sequence.frames_t_ns
    window_ns = max(round(WINDOW_S * NS_PER_S), int(np.median(np.diff(t_ns))))
    edges = np.searchsorted(t_ns, np.arange(t_ns[0], t_ns[-1] + 1, window_ns))
    begin, end = np.array(list(pairwise(np.unique(edges).tolist())), dtype=int).reshape(-1, 2).T
    unknown = np.concatenate([[0], np.cumsum(~camera.known)])
    near = _has_truth(truth, t_ns, 2 * window_ns)
    usable = (unknown[begin] == unknown[end]) & near[begin] & near[end]
    begin, end = begin[usable], end[usable]
    path = chained(moved_by(camera, sequence))
    true = [
        interpolate_poses(truth.t_ns, truth.T_world_imu, t_ns[k]) @ sequence.rig.T_imu_cam if k.size else path[k]
        for k in (begin, end)
    ]
    both = np.stack([se3_inverse(path[begin]) @ path[end], se3_inverse(true[0]) @ true[1]])
    return _Windows(both[..., :3, 3], so3_log(both[..., :3, :3]))


def _has_truth(truth: Truth, t_ns: IntArray, apart_ns: int) -> BoolArray:
    """Say of stamps (N,) whether they lie within the truth's and between two of them that are no farther apart."""
    after = np.clip(np.searchsorted(truth.t_ns, t_ns, side="left"), 1, truth.t_ns.size - 1)
    close = truth.t_ns[after] - truth.t_ns[after - 1] <= apart_ns
    return np.asarray(close & (t_ns >= truth.t_ns[0]) & (t_ns <= truth.t_ns[-1]))


def _moving(both: Array, least: float) -> BoolArray:
    """Say in which windows (M,) the truth does enough, of what camera and truth do (2, M, 3).

    Where it stands and the camera seems to move, a vehicle fills the view as often as the truth is wrong.
    """
    return np.asarray(np.linalg.norm(both[1], axis=1) > least)


class _Compared(NamedTuple):
    """A median over some windows with its standard error, and beyond which distance it is no chance."""

    value: float
    error: float
    by_chance: float


def _compared(each: Array) -> _Compared:
    """Return the median of what windows (M,) show; of few windows neither its error by the median nor the mean's is
    sure, so the larger one counts."""
    error = max(float(median_error(each[:, None])[0]), float(np.std(each)) / np.sqrt(each.size))
    return _Compared(float(np.median(each)), error, chance_sigmas(each.size, LEVEL) * error)


def _off(both: Array) -> _Compared:
    """Return the share by which the two of (2, M, 3) differ, of the larger."""
    return _compared(np.linalg.norm(both[0] - both[1], axis=1) / np.linalg.norm(both, axis=2).max(axis=0))


def _longer(seen: Array, true: Array) -> tuple[_Compared, bool]:
    """Return the ratio of displacements (M, 3) along the true ones, and whether it is all by which they differ."""
    scale = _ratio(seen, true)
    return scale, scale.value > 0.0 and _off(np.stack([seen, scale.value * true])).value < MOST_SCALED_OFF


def _ratio(seen: Array, true: Array) -> _Compared:
    """Return the ratio of displacements (M, 3) along the true ones."""
    return _compared((seen * true).sum(axis=1) / (true**2).sum(axis=1))


FAULT = Fault(
    "truth-mismatch",
    "a truth that moves otherwise than vision: of another motion or unit, or beside a wrong baseline or focal length",
    check,
    after=("disagreement",),
)
