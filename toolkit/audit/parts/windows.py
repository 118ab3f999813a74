"""Displacements and rotations over windows of time, by the stereo tracks alone and by a trajectory.

Both are chained from frame to frame, in the axes of the camera at the start of each window. Their difference is a
median over the windows, with its standard error and the bound that it exceeds only by chance.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.alignment import chained
from toolkit.audit.parts.intervals import LEAST_INTERVALS, is_comparable, moved_by
from toolkit.audit.parts.robust import Scalar, chance_sigmas, median_error
from toolkit.geometry import Array, BoolArray, IntArray, interpolate_poses, se3_inverse, so3_log
from toolkit.models.camera_motion import CameraMotion, camera_motion
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence, Truth

# Length (s) of a window: long enough for the noise of single frames to be small, and five seconds have ten of them.
WINDOW_S = 0.5
LEAST_WINDOWS = 4
# Level of significance, by Student's t of as many windows, ...
LEVEL = 1e-3
# ... and limit of sound recordings at hand, beyond chance; chosen with them in view.
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
    return WindowMedian(float(np.median(each)), error, chance_sigmas(each.size, LEVEL) * error)


def off_by(both: Array) -> WindowMedian:
    """Return the difference of both motions (2, M, 3), as a share of the larger."""
    return compared(np.linalg.norm(both[0] - both[1], axis=1) / np.linalg.norm(both, axis=2).max(axis=0))


def longer(seen: Array, true: Array) -> tuple[WindowMedian, bool]:
    """Return the ratio of displacements (M, 3) along the true ones, and whether scaling removes the difference."""
    scale = _ratio(seen, true)
    return scale, scale.value > 0.0 and off_by(np.stack([seen, scale.value * true])).value < MOST_SCALED_OFF


def _ratio(seen: Array, true: Array) -> WindowMedian:
    """Return the ratio of displacements (M, 3) along the true ones."""
    return compared((seen * true).sum(axis=1) / (true**2).sum(axis=1))
