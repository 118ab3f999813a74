"""The tracks of an MSCKF: their sightings from the window, the gate to correct it, the answer given those in view.

A track is accepted or rejected as a whole, so one mismatched sighting would reject all the others of its track.
Therefore, if a track fails the gate by a wide margin, the sighting that disagrees most with the rest of the track and
with the window is left out, and the track is tested once more if at least two sightings remain. A track that fails by
little may be sound and unlucky: leaving out its worst sighting would select measurements by their agreement.

An MSCKF corrects by a track once, when the track ends or leaves the window. Until then the belief has no information
from its sightings, and the newest pose would follow the measured motion alone. So the answer at a frame is the belief
given all tracks in view, computed beside the belief and then discarded. No sighting counts twice, and up to
linearisation it is the answer that the filter would give if every track ended here (tested).

A landmark is triangulated at its track's second sighting and then follows by one Gauss-Newton step a frame. A sighting
is gated once, at its frame, against the window and the earlier sightings of its track; its weight then stays.

What is computed of each track is in :mod:`filters.kalman.kernels`, which is compiled.
"""

import fcntl
import sys
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from filters.kalman.joint import JointBelief, divided_by_root, regular_root, root_with_information, times_root
from toolkit.arrays import is_among
from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DEPTH_M, LEAST_DISPARITY_PX, MISMATCHED_TRACK_FACTOR, FrameGate
from toolkit.models.state import Belief
from toolkit.progress import Progress


def load_kernels(progress: Progress) -> tuple[str, ...]:
    """Import the kernels, and compile them where that has not been done for this version; say so in one line.

    It is reported while it goes on, because compiling takes many seconds. Processes do it one after another: the second
    finds what the first has compiled.
    """
    if "filters.kalman.kernels" in sys.modules:
        return ()
    progress.advance(0, 1, "loading compiled code, which is compiled the first time")
    with Path(__file__).open("rb") as own:
        with suppress(OSError):  # a file system without locks: they compile side by side
            fcntl.flock(own, fcntl.LOCK_EX)
        from filters.kalman import kernels
    compiled: tuple[str, ...] = kernels.COMPILED
    return compiled


class TrackSightings(NamedTuple):
    """F tracks seen from the W poses of a window: ids (F,), (uL, uR, v) (F, W, 3) px, and which were seen (F, W)."""

    track_ids: IntArray
    uvs_px: Array
    seen: BoolArray

    def select(self, rows: BoolArray | IntArray) -> "TrackSightings":
        """Return the tracks of a mask (F,) or of some rows."""
        return TrackSightings(self.track_ids[rows], self.uvs_px[rows], self.seen[rows])


class WindowTracks:
    """The tracks that have not corrected yet: sightings of A tracks from the W poses of the window, a column each.

    ``points`` (A, 3) are their landmarks as far as they are known while in view, else NaN, and ``weights`` (A, W) those
    of their sightings for the answer: 0 where there is none or it was rejected.
    """

    def __init__(self) -> None:
        self.track_ids: IntArray = np.empty(0, dtype=np.int64)
        self.uvs_px = np.empty((0, 0, 3))
        self.seen = np.empty((0, 0), dtype=bool)
        self.points = np.empty((0, 3))
        self.weights = np.empty((0, 0))

    def add_frame(self, frame: StereoFrame) -> None:
        """Append the frame's sightings as a new column; ids unknown so far start new tracks, tracks unseen leave."""
        kept, known = np.flatnonzero(self.seen.any(axis=1)), self.seen.shape[1]
        ids = self.track_ids[kept]
        new = frame.track_ids[~is_among(frame.track_ids, ids)]
        self.track_ids = np.concatenate([ids, new])
        order = np.argsort(self.track_ids)
        rows = order[np.searchsorted(self.track_ids, frame.track_ids, sorter=order)]

        def widened(of_tracks: Array, newest: Array | float) -> Array:
            result = np.zeros((order.size, known + 1, *of_tracks.shape[2:]), of_tracks.dtype)
            result[: ids.size, :known], result[rows, known] = of_tracks[kept], newest
            return result

        self.uvs_px, self.weights = widened(self.uvs_px, frame.uvs_px), widened(self.weights, 1.0)
        self.seen = widened(self.seen, True)
        self.points = np.concatenate([self.points[kept], np.full((new.size, 3), np.nan)])

    def drop_oldest(self, count: int) -> None:
        """Drop the sightings from the ``count`` oldest poses."""
        columns = self.uvs_px, self.seen, self.weights
        self.uvs_px, self.seen, self.weights = (np.ascontiguousarray(each[:, count:]) for each in columns)

    def ended(self) -> BoolArray:
        """Say which tracks (A,) the newest pose does not see."""
        return np.asarray(~self.seen[:, -1])

    def seen_by_oldest(self, count: int) -> BoolArray:
        """Say which tracks (A,) any of the ``count`` oldest poses has seen."""
        return np.asarray(self.seen[:, :count].any(axis=1))

    def take(self, rows: BoolArray) -> TrackSightings:
        """Return those tracks (A,) and forget their sightings; a track that is still seen starts again."""
        which = np.flatnonzero(rows)  # found once, not for each array
        taken = TrackSightings(self.track_ids[which], self.uvs_px[which], self.seen[which])
        self.seen[which] = False
        return taken


class WindowPoses(NamedTuple):
    """The poses (W, 4, 4) of the window, where they are linearised (W, 4, 4), and their covariance (6 W, 6 W)."""

    poses: Array
    poses_at: Array
    cov: Array


@lru_cache(maxsize=4)
def camera_for_kernels(rig: StereoRig) -> tuple[Array, Array, Array, Array]:
    """Return intrinsics and baseline (5,), whiteners (3, 3) of both images and of the left alone, and T_cam_imu."""
    intrinsics = np.array([rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px, rig.baseline_m])
    return intrinsics, np.array(rig.whitener, order="C"), stereo.left_whitener(rig), se3_inverse(rig.T_imu_cam)


class EliminatedTracks(NamedTuple):
    """F tracks that passed, by which poses they were seen (F, W), their points (F, 3), and what they say of the poses.

    ``normals`` (F, 4, 4) are ``[H_f r]^T [H_f r]``, whitened and weighted; with C the root of its block ``H_f^T H_f``,
    ``halves`` (F, 3, 6 W) is ``C^-1 H_f^T H_x``. With the landmarks eliminated, the information of all tracks together
    is block diagonal with ``blocks`` (W, 6, 6), one a pose, less the sum of ``halves^T halves``; ``vector`` (6 W,)
    belongs to it.
    """

    track_ids: IntArray
    seen: BoolArray
    points: Array
    normals: Array
    halves: Array
    blocks: Array
    vector: Array

    def joined(self, other: "EliminatedTracks") -> "EliminatedTracks":
        """Return the tracks of both."""
        ids, seen, points, normals, halves = (np.concatenate(pair) for pair in zip(self[:5], other[:5], strict=True))
        blocks, vector = self.blocks + other.blocks, self.vector + other.vector
        return EliminatedTracks(ids, seen, points, normals, halves, blocks, vector)

    def landmarks(self, rows: IntArray) -> tuple[IntArray, Array, Array, Array]:
        """Return some tracks (K,) as landmarks: what :meth:`JointBelief.add_landmarks` takes.

        The error of a landmark is ``-(H_f^T H_f)^-1 H_f^T (H_x x + n)``, that of its least-squares point.
        """
        root_inverse = np.linalg.inv(np.linalg.cholesky(self.normals[rows, :3, :3]))
        to_point = np.swapaxes(root_inverse, 1, 2)
        jacobian = -(to_point @ self.halves[rows]).reshape(3 * len(rows), len(self.vector))
        return self.track_ids[rows], self.points[rows], jacobian, to_point @ root_inverse


def eliminated_tracks(
    sightings: TrackSightings, window: WindowPoses, rig: StereoRig, gate: FrameGate
) -> EliminatedTracks:
    """Return the tracks that pass, some of them without one of their sightings, with their landmarks eliminated.

    A track without two sightings is not tested. ``gate`` counts every test, so a track that is tested twice counts
    twice.
    """
    passed, again = _tested(sightings, window, rig, gate)
    return passed if again is None else passed.joined(_tested(again, window, rig, gate)[0])


def _tested(
    sightings: TrackSightings, window: WindowPoses, rig: StereoRig, gate: FrameGate
) -> tuple[EliminatedTracks, TrackSightings | None]:
    """Return the tracks that pass, and without their worst sighting those that fail by a wide margin, if any."""
    from filters.kalman import kernels

    count, width = sightings.seen.shape
    points, reliable, nis, dof, worst, weights, (normals, halves, of_halves, blocks, vector) = kernels.eliminate_tracks(
        (sightings.uvs_px, sightings.seen),
        (window.poses, window.poses_at),
        np.ascontiguousarray(window.cov),
        camera_for_kernels(rig),
        (LEAST_DISPARITY_PX, LEAST_DEPTH_M),
        gate.limits(3 * width),
        (MISMATCHED_TRACK_FACTOR, gate.track_weight),
    )
    accepted = weights > 0.0
    gate.count(nis[reliable], dof[reliable], accepted[reliable])
    passed = EliminatedTracks(
        sightings.track_ids[accepted],
        sightings.seen[accepted],
        points[accepted],
        normals[accepted],
        halves.reshape(count, 3, 6 * width)[accepted],
        blocks,
        vector - halves.T @ of_halves,
    )
    mismatched = np.flatnonzero(worst >= 0)
    if not mismatched.size:
        return passed, None
    less = sightings.select(mismatched)
    less.seen[np.arange(mismatched.size), worst[mismatched]] = False
    return passed, less


def given_tracks_in_view(
    joint: JointBelief, window: WindowPoses, tracks: WindowTracks, rig: StereoRig, gate: FrameGate
) -> Belief:
    """Return the present state given also the tracks that the newest of W poses sees and that have not corrected yet.

    Their landmarks and the weights of their newest sightings are kept in ``tracks``; ``gate`` counts nothing.
    """
    from filters.kalman import kernels

    in_view = tracks.uvs_px, tracks.seen, tracks.weights, tracks.points
    poses, limits = (window.poses, window.poses_at), (LEAST_DISPARITY_PX, LEAST_DEPTH_M)
    counting, *of_tracks, between, H_newest, blocks, vector, widths = kernels.normals_in_view(
        in_view, poses, camera_for_kernels(rig), limits
    )
    if not counting.size:
        return joint.core
    count = len(window.poses)
    root = regular_root(window.cov.reshape(count, 6, count, 6)[::-1, :, ::-1].reshape(6 * count, 6 * count))
    # Long tracks come first: in the second half the last columns are zero, and so they are in its product with R.
    half, width = 3 * (counting.size // 2), widths[counting.size // 2 :].max()
    between[:half] = times_root(between[:half], root)
    between[half:, :width] = times_root(between[half:, :width], root[:width, :width])
    normals, by_root = (counting, *of_tracks, H_newest, blocks, vector), (H_newest @ root[:6, :6], between, widths)
    eliminated = kernels.add_newest(in_view, normals, by_root, gate.limits(3))
    matrix_root = root_with_information(root, blocks, between[:half], rig.track_weight, between[half:, :width])
    return _corrected(joint, root, matrix_root, rig.track_weight * (root.T @ vector - between.T @ eliminated))


def _corrected(joint: JointBelief, root: Array, matrix_root: Array, vector: Array) -> Belief:
    """Return the present state given an information matrix L and a vector n (6 W,) on errors u of the clones.

    The errors of the clones, newest first, are R u, with R the root of their covariance; ``matrix_root`` is that of
    1 + L. With ``Y = R^-1 P_cx`` the update moves the state's error by ``Y^T (1 + L)^-1 n`` and its covariance becomes
    ``P_xx - Y^T Y + Y^T (1 + L)^-1 Y``.
    """
    core = joint.core
    of_clones = joint.cov[joint.clone_columns, : core.layout.size].reshape(-1, 6, core.layout.size)
    to_core = divided_by_root(root, of_clones[::-1].reshape(len(root), core.layout.size))
    halves = divided_by_root(matrix_root, np.concatenate([to_core, vector[:, None]], axis=1))
    half = halves[:, :-1]
    delta, cov = half.T @ halves[:, -1], core.cov - to_core.T @ to_core + half.T @ half
    return core.moved(delta, cov)
