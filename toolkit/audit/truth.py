"""Faults of the truth, with which runs are compared, and of the direction of gravity in its world."""

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from toolkit.audit.alignment import metres
from toolkit.audit.clocks import LEAST_OFFSET_S, OFFSET_SIGMAS
from toolkit.audit.fault import Evidence, Symptom, Undecided
from toolkit.audit.intervals import LEAST_INTERVALS, chained, interval_means, is_comparable, moved_by
from toolkit.audit.robust import Scalar, chance_sigmas, median_error
from toolkit.datasets.trajectories.belonging import exchanges
from toolkit.geometry import Array, BoolArray, IntArray, interpolate_poses, se3_inverse, so3_log
from toolkit.measurements import NS_PER_S
from toolkit.models.camera_motion import CameraMotion, camera_motion
from toolkit.motion_samples import ImuSamples
from toolkit.sequence import Sequence, Truth

# Length (s) of a window: long enough for the noise of single frames to be small, and five seconds have ten of them.
WINDOW_S = 0.5
LEAST_WINDOWS = 4
# Limit of sound recordings at hand, beyond chance; chosen with them in view.
SYSTEMATIC = 0.06
# The difference is one of scale if scaling leaves less than this share of it.
MOST_SCALED_OFF = 0.25
# Least motion of a window (m, rad): the noise of a truth moves even a standing vehicle.
LEAST_MOVED_M, LEAST_TURNED_RAD = 0.02, 0.03


def steps_beside_camera(sequence: Sequence, trajectory: Truth) -> Scalar | None:
    """Return the ratio of a trajectory's steps to the camera's, where both differ by this factor alone.

    None where a ratio of 1 is within chance or the limit of sound recordings, or the tracks do not determine it.
    """
    camera = camera_motion(sequence)
    if not is_comparable(sequence) or camera.known.sum() < LEAST_INTERVALS:
        return None
    both = windows(sequence, camera, trajectory)
    moved = moving(both.displaced_m, LEAST_MOVED_M)
    if moved.sum() < LEAST_WINDOWS:
        return None
    scale, only_longer = longer(*both.displaced_m[:, moved])
    if not only_longer or abs(scale.value - 1.0) < SYSTEMATIC + scale.by_chance:
        return None
    return Scalar(1.0 / scale.value, scale.error / scale.value**2)


class Windows(NamedTuple):
    """Displacements (2, M, 3) m and rotations (2, M, 3) rad of the camera and the truth over M windows.

    Both are in the axes of the camera at the begin of each window.
    """

    displaced_m: Array
    turned_rad: Array


def windows(sequence: Sequence, camera: CameraMotion, truth: Truth) -> Windows:
    """Return both over the windows in which all intervals of the camera are known and the truth has poses nearby."""
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
    return Windows(both[..., :3, 3], so3_log(both[..., :3, :3]))


def _has_truth(truth: Truth, t_ns: IntArray, apart_ns: int) -> BoolArray:
    """Say which stamps (N,) lie between two stamps of the truth that are no farther apart than ``apart_ns``."""
    after = np.clip(np.searchsorted(truth.t_ns, t_ns, side="left"), 1, truth.t_ns.size - 1)
    close = truth.t_ns[after] - truth.t_ns[after - 1] <= apart_ns
    return np.asarray(close & (t_ns >= truth.t_ns[0]) & (t_ns <= truth.t_ns[-1]))


def moving(both: Array, least: float) -> BoolArray:
    """Say in which windows (M,) the truth moves by more than ``least``, of both motions (2, M, 3).

    Windows in which the truth stands are left out: the camera may seem to move there because a vehicle fills the view.
    """
    return np.asarray(np.linalg.norm(both[1], axis=1) > least)


class WindowMedian(NamedTuple):
    """A median over windows, its standard error, and the bound of the difference that it exceeds only by chance."""

    value: float
    error: float
    by_chance: float


def compared(each: Array) -> WindowMedian:
    """Return the median over windows (M,).

    With few windows neither the error of the median nor that of the mean is certain, so the larger one is used.
    """
    error = max(float(median_error(each[:, None])[0]), float(np.std(each)) / np.sqrt(each.size))
    return WindowMedian(float(np.median(each)), error, chance_sigmas(each.size) * error)


def off_by(both: Array) -> WindowMedian:
    return compared(np.linalg.norm(both[0] - both[1], axis=1) / np.linalg.norm(both, axis=2).max(axis=0))


def longer(seen: Array, true: Array) -> tuple[WindowMedian, bool]:
    """Return the ratio of displacements (M, 3) along the true ones, and whether scaling removes the difference."""
    scale = compared((seen * true).sum(axis=1) / (true**2).sum(axis=1))
    return scale, scale.value > 0.0 and off_by(np.stack([seen, scale.value * true])).value < MOST_SCALED_OFF


# Least angle between both directions (1 m/s^2 of mean acceleration makes six), and to the axis that gravity is set to.
LEAST_DEG, NEAR_AXIS_DEG = 30.0, 15.0
# Least length (s) of a recording, for its mean acceleration to be small, and the rate at which the truth is read.
LEAST_S, READ_HZ = 2.0, 20.0
# The rotations of truth and gyro agree if their squared difference is no more than this share of the squared rates.
MOST_LEFT = 0.25
STANDARD_MPS2 = 9.81


def gravity_direction(evidence: Evidence) -> Symptom | Undecided | None:
    sequence, truth = evidence.sequence, evidence.sequence.truth
    if not isinstance(sequence.motion, ImuSamples) or truth is None or evidence.spoilt_by:
        return None
    if not is_comparable(sequence) or (measured := _measured(sequence, truth)) is None:
        return None
    given = sequence.gravity_world
    size_mps2 = float(np.linalg.norm(given))
    if size_mps2 > 0.0 and _angle_deg(given, measured) < LEAST_DEG:
        return None
    axis = np.zeros(3)
    largest = int(np.argmax(np.abs(measured)))
    axis[largest] = np.sign(measured[largest])
    stated = f"in the truth's world, and gravity_world is {metres(given)}"
    summary = f"by the samples gravity is {metres(measured)} m/s^2 {stated}"
    if not _angle_deg(axis, measured) < NEAR_AXIS_DEG:
        return Symptom(1, summary, "no axis of the world is near: correct it", remedy=None)
    gravity_world = (size_mps2 if size_mps2 > 0.0 else STANDARD_MPS2) * axis
    return Symptom(1, summary, f"it is set to {metres(gravity_world)}", replace(sequence, gravity_world=gravity_world))


def _measured(sequence: Sequence, truth: Truth) -> Array | None:
    """Return gravity (3,) m/s^2 in the truth's world; None where the truth is short, or rotates otherwise."""
    in_order = truth.t_ns.size >= 2 and (np.diff(truth.t_ns) > 0).all() and np.isfinite(truth.T_world_imu).all()
    begin_ns = max(int(truth.t_ns[0]), int(sequence.motion.t_ns[0])) if truth.t_ns.size else 0
    end_ns = min(int(truth.t_ns[-1]), int(sequence.motion.t_ns[-1])) if truth.t_ns.size else 0
    duration_s = (end_ns - begin_ns) / NS_PER_S
    if not in_order or duration_s < LEAST_S:
        return None
    t_ns = np.linspace(begin_ns, end_ns, round(READ_HZ * duration_s) + 1).astype(np.int64)
    poses, step_s = interpolate_poses(truth.t_ns, truth.T_world_imu, t_ns), np.diff(t_ns)[:, None] / NS_PER_S
    R_world_imu = poses[:, :3, :3]
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values, t_ns)
    seen, turned = mean[:, 3:], so3_log(R_world_imu[:-1].swapaxes(1, 2) @ R_world_imu[1:]) / step_s
    apart = turned - seen
    apart, seen = apart - np.median(apart, axis=0), seen - np.median(seen, axis=0)
    if np.sum(apart**2) > MOST_LEFT * np.sum(seen**2):
        return None
    v_world = np.diff(poses[:, :3, 3], axis=0) / step_s
    faster = (np.median(v_world[-5:], axis=0) - np.median(v_world[:5], axis=0)) / duration_s
    force = np.mean((R_world_imu[:-1] @ mean[:, :3, None])[..., 0], axis=0)
    return np.asarray(faster - force)


def _angle_deg(a: Array, b: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), -1.0, 1.0))))


# Where only a larger difference (s) of the clocks would be found, half a metre of a drive, the finding is undecided.
LARGEST_S = 0.05


def truth_clock(evidence: Evidence) -> Symptom | Undecided | None:
    if evidence.spoilt_by or evidence.sequence.truth is None:
        return None
    clock = evidence.truth_clock
    if clock is None:
        return None
    if clock.rate is not None and clock.runs_otherwise:
        fast = f"{1.0 + clock.rate.value:.4f} +- {clock.rate.error:.4f} times as fast by the truth's stamps"
        return Symptom.warning(
            f"the camera turns as the truth does when time passes {fast} as by the frames'",
            "stamp both by one clock: position errors include the distance moved in the time by which they differ",
        )
    if clock.unseen_s < LARGEST_S:
        return None
    hidden = f"one that is off by less than {clock.unseen_s:.2g} s would not show"
    if not np.isfinite(clock.unseen_s):
        hidden = "whether it is the frames' is unknown"
    return Undecided(f"too little change of rotation to determine the truth's clock: {hidden}")


# Least difference, as a share of the larger motion: unrelated motions differ by more than their size.
MOST_OFF = 0.5
# Rotations are compared if the truth has them in this share of the windows: a vehicle fills the view for less long.
LEAST_TURNING = 1.0 / 3.0
# Limits of a step between true poses: a distance (m), a multiple of the usual speed, and a speed (m/s).
LEAST_LEAP_M, LEAP, LEAST_LEAP_MPS = 0.5, 10.0, 10.0
# The camera drives if it moves by this many times LEAST_MOVED_M in a window; the truth must stand in this share.
DRIVES, MOST_STANDING = 5.0, 0.5
# From this difference on, as a share of the motion, other readings are tried; one must make it this much smaller.
LEAST_APART, TIMES_NEARER = 0.1, 3.0
_WHERE = "check the baseline and the focal length (the camera's calibration file), and the unit of the truth"
_OTHER = (
    "check that the truth is this recording's, in order and in the axes it is read in; do not rely on errors against it"
)

_AXES = "write the truth in the axes it is read in: the world's, z upwards, and the body's that the samples have"


def truth_mismatch(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare the camera's own motion with the truth's over windows, in direction and in size.

    Vision's steps have another length with a wrong baseline or focal length, or a truth in another unit, and another
    direction with a truth of another recording, order or axes. Rotations that agree at shifted times show its clock.
    """
    truth = evidence.sequence.truth
    if truth is None or truth.t_ns.size < 2 or evidence.spoilt_by or not is_comparable(evidence.sequence):
        return None
    if evidence.camera_motion.known.sum() < LEAST_INTERVALS:
        return None
    return _broken(truth) or _by_another_clock(evidence) or _compared_with(evidence, truth)


def _broken(truth: Truth) -> Symptom | None:
    finite = np.isfinite(truth.T_world_imu).all(axis=(1, 2))
    if not finite.all():
        return Symptom.warning(
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
    return Symptom.warning(
        f"the truth jumps {int(leaps.sum())} time(s), the farthest by {step_m[row]:.3g} m at {at_s:.1f} s of it",
        "cut it there, or leave the pose out: every position error includes the jump",
    )


def _compared_with(evidence: Evidence, truth: Truth) -> Symptom | Undecided | None:
    both = windows(evidence.sequence, evidence.camera_motion, truth)
    moved, turned = moving(both.displaced_m, LEAST_MOVED_M), moving(both.turned_rad, LEAST_TURNED_RAD)
    if (stands := _standing(both, moved) or _looking_one_way(truth, both)) is not None:
        return stands
    if moved.sum() < LEAST_WINDOWS:
        return Undecided(
            f"the truth moves by {LEAST_MOVED_M:g} m and more, and the camera's own motion is known, in {moved.sum()} "
            f"windows of {WINDOW_S:g} s; {LEAST_WINDOWS} are needed"
        )
    if (other := _read_otherwise(evidence, truth, both)) is not None:
        return other
    off = {"moves": off_by(both.displaced_m[:, moved])}
    if turned.sum() >= max(LEAST_WINDOWS, LEAST_TURNING * moved.sum()):
        off["turns"] = off_by(both.turned_rad[:, turned])
    elsewhere = {
        how: f"it {how} differently, by {100.0 * share.value:.0f} +- {100.0 * share.error:.0f} % of the larger of both"
        for how, share in off.items()
        if share.value - share.by_chance > MOST_OFF
    }
    seen, true = both.displaced_m[:, moved]
    scale, only_longer = longer(seen, true)
    if "turns" in elsewhere or (elsewhere and not only_longer):
        return Symptom.warning(f"the truth's motion is not the camera's: {' and '.join(elsewhere.values())}", _OTHER)
    steps = f"vision's steps are {scale.value:.3f} +- {scale.error:.3f} times the truth's"
    if not only_longer or abs(scale.value - 1.0) < SYSTEMATIC + scale.by_chance:
        within = "which is more than chance and no more than in recordings without faults"
        doubt = f"{steps}, {within}: the truth's unit, the baseline or the focal length may be off by it"
        return Undecided(doubt) if only_longer and abs(scale.value - 1.0) > scale.by_chance else None
    return Symptom.warning(steps, _WHERE)


def _standing(both: Windows, moved: BoolArray) -> Symptom | None:
    """Report a truth that stands in half of the windows while the camera drives, or repeats a pose exactly."""
    drives_m = np.linalg.norm(both.displaced_m[0], axis=1)
    frozen = (both.displaced_m[1] == 0.0).all(axis=1) & (both.turned_rad[1] == 0.0).all(axis=1)
    apart = ~moved & (drives_m > DRIVES * LEAST_MOVED_M)
    in_most = apart.sum() >= max(LEAST_WINDOWS, MOST_STANDING * moved.size)
    if not in_most and (apart & frozen).sum() < LEAST_WINDOWS:
        return None
    speed_mps = float(np.median(drives_m[apart])) / WINDOW_S
    return Symptom.warning(
        f"the truth stands still in {apart.sum()} of {moved.size} windows of {WINDOW_S:g} s in which the camera moves "
        f"at {speed_mps:.2g} m/s",
        "it is no truth of this motion, or was frozen: leave it out; errors and consistency against it are meaningless",
    )


def _looking_one_way(truth: Truth, both: Windows) -> Symptom | None:
    """Report a truth whose orientations are all equal, as if none was written, while the camera rotates.

    A measured truth does not repeat an orientation exactly, so the camera's rotation only has to exceed its noise.
    """
    turns_rad = np.linalg.norm(both.turned_rad[0], axis=1)
    turns = turns_rad > LEAST_TURNED_RAD
    if np.ptp(truth.T_world_imu[:, :3, :3], axis=0).max() > 0.0 or turns.sum() < LEAST_WINDOWS:
        return None
    return Symptom.warning(
        f"all orientations of the truth are equal, and in {turns.sum()} of {turns.size} windows of {WINDOW_S:g} s the "
        f"camera turns by {float(np.median(turns_rad[turns])):.2g} rad (median)",
        "write the orientations, or leave the truth out: errors of orientation and NEES against it are meaningless",
    )


def _read_otherwise(evidence: Evidence, truth: Truth, both: Windows) -> Symptom | None:
    """Report a truth that agrees with the camera if read backwards or in other axes, and not as given (``both``)."""
    given = _apart(both)
    if not given > LEAST_APART:
        return None
    poses = truth.T_world_imu
    backwards = ("whose poses run backwards", "write them in the order of their stamps", poses[::-1])
    exchanged = ((f"with {one.description}", _AXES, one.reread(poses)) for one in exchanges())
    for reading, remedy, T_world_imu in (backwards, *exchanged):
        apart = _apart(windows(evidence.sequence, evidence.camera_motion, replace(truth, T_world_imu=T_world_imu)))
        if apart < given / TIMES_NEARER:
            only = f"only for a truth {reading}, with a difference of {apart:.1%} in place of {given:.0%}"
            return Symptom.warning(f"the truth's motion agrees with the camera's {only}", remedy)
    return None


def _apart(both: Windows) -> float:
    """Return the root mean square difference over windows, as a share of the truth's displacements and rotations."""
    squared = [
        np.mean((x[0] - x[1]) ** 2) / max(float(np.mean(x[1] ** 2)), least**2)
        for x, least in ((both.displaced_m, LEAST_MOVED_M), (both.turned_rad, LEAST_TURNED_RAD))
    ]
    return float(np.sqrt(sum(squared)))


def _by_another_clock(evidence: Evidence) -> Symptom | None:
    """Report an offset of the truth's clock, unless the clock has another rate (`truth_clock`)."""
    clock = evidence.truth_clock
    if clock is None or clock.offset is None or clock.runs_otherwise:
        return None
    found = clock.offset
    if abs(found.value) < max(LEAST_OFFSET_S, OFFSET_SIGMAS * found.error):
        return None
    return Symptom.warning(
        f"the camera turns as the truth does when the truth's stamps are shifted by {-1e3 * found.value:.0f} +- "
        f"{1e3 * found.error:.0f} ms",
        "stamp both by one clock: every position error includes the distance moved in that time",
    )
