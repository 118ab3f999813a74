"""The tracks of an MSCKF: their sightings from the poses of the window, and the gate through which they correct it.

A track is accepted or rejected as a whole, so one mismatched sighting would reject all the others of its track.
Therefore, if a track fails the gate by a wide margin, the sighting that disagrees most with the rest of the track and
with the window is left out, and the track is tested once more if at least two sightings remain. A track that fails by
little may be sound and unlucky: leaving out its worst sighting would select measurements by their agreement.

What is computed of each track is in :mod:`filters.kalman.kernels`, which is compiled.
"""

import fcntl
import sys
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from filters.kalman.frame_gate import FrameGate
from toolkit.arrays import rows_of
from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.gating import FEWEST_SIGHTINGS, LEAST_DEPTH_M, LEAST_DISPARITY_PX, MISMATCHED_TRACK_FACTOR


def load_kernels() -> tuple[str, ...]:
    """Import the kernels, and compile them where that has not been done for this version; say so in one line.

    Processes do it one after another: the second finds what the first has compiled.
    """
    if "filters.kalman.kernels" in sys.modules:
        return ()
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

    def joined(self, other: "TrackSightings") -> "TrackSightings":
        """Return the tracks of both, concatenated."""
        return TrackSightings(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


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
        """Append the frame's sightings as a new column; ids unknown so far start new tracks."""
        order = np.argsort(self.track_ids)
        at, known = rows_of(frame.track_ids, self.track_ids[order])
        before, window = self.seen.shape
        count = before + np.count_nonzero(~known)
        rows = np.empty(len(known), dtype=np.int64)
        rows[known], rows[~known] = order[at[known]], np.arange(before, count)
        uvs_px, seen, weights = (np.zeros((count, window + 1, *more), kind) for more, kind in _COLUMNS)
        uvs_px[:before, :-1], seen[:before, :-1], weights[:before, :-1] = self.uvs_px, self.seen, self.weights
        uvs_px[rows, -1], seen[rows, -1], weights[rows, -1] = frame.uvs_px, True, 1.0
        self.track_ids = np.concatenate([self.track_ids, frame.track_ids[~known]])
        self.points = np.concatenate([self.points, np.full((count - before, 3), np.nan)])
        self.uvs_px, self.seen, self.weights = uvs_px, seen, weights

    def drop_oldest(self, count: int) -> None:
        """Drop the sightings from the ``count`` oldest poses."""
        columns = self.uvs_px, self.seen, self.weights
        self.uvs_px, self.seen, self.weights = (np.ascontiguousarray(each[:, count:]) for each in columns)
        self._keep(np.asarray(self.seen.any(axis=1)))

    def ended(self) -> BoolArray:
        """Say which tracks (A,) the newest pose does not see."""
        return np.asarray(~self.seen[:, -1])

    def seen_by(self, which: BoolArray) -> BoolArray:
        """Say which tracks (A,) any of some poses (W,) has seen."""
        return np.asarray(self.seen[:, which].any(axis=1))

    def take(self, rows: BoolArray) -> TrackSightings:
        """Return those tracks (A,) and drop their sightings; a track that is still seen starts again."""
        taken = TrackSightings(self.track_ids[rows], self.uvs_px[rows], self.seen[rows])
        self._keep(~rows)
        return taken

    def forget_landmarks(self, rows: IntArray) -> None:
        """Forget the landmarks of some tracks, and what was found of their sightings."""
        self.points[rows], self.weights[rows] = np.nan, self.seen[rows]

    def _keep(self, rows: BoolArray) -> None:
        if not rows.all():
            self.track_ids, self.points, self.weights = self.track_ids[rows], self.points[rows], self.weights[rows]
            self.uvs_px, self.seen = self.uvs_px[rows], self.seen[rows]


# What a track has for each pose: further axes and type of the sightings, of whether it was seen, and of the weights.
_COLUMNS = ((3,), float), ((), bool), ((), float)


class WindowPoses(NamedTuple):
    """The poses (W, 4, 4) of the window, where they are linearised (W, 4, 4), and their covariance (6 W, 6 W)."""

    poses: Array
    poses_at: Array
    cov: Array

    def for_kernels(self, rig: StereoRig) -> tuple[Array, Array, Array]:
        """Return T_cam_world (W, 4, 4) at present and where poses are linearised, and T_world_imu there."""
        now = se3_inverse(self.poses @ rig.T_imu_cam)
        at = now if self.poses_at is self.poses else se3_inverse(self.poses_at @ rig.T_imu_cam)
        return now, at, np.ascontiguousarray(self.poses_at)


@lru_cache(maxsize=4)
def camera_for_kernels(rig: StereoRig) -> tuple[Array, Array, Array]:
    """Return intrinsics and baseline (5,), and the whiteners (3, 3) of sightings in both images and the left alone."""
    intrinsics = np.array([rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px, rig.baseline_m])
    return intrinsics, np.array(rig.whitener, order="C"), stereo.left_whitener(rig)


class AcceptedTracks(NamedTuple):
    """F tracks that passed: their accepted sightings, points (F, 3), weights (F,), and their constraints.

    The constraints on the W poses are whitened, weighted and stacked: H (n, 6 W), residuals (n,).
    """

    sightings: TrackSightings
    points: Array
    weights: Array
    H: Array
    residuals: Array

    def joined(self, other: "AcceptedTracks") -> "AcceptedTracks":
        """Return the tracks of both, concatenated."""
        pairs = zip(self[1:], other[1:], strict=True)
        return AcceptedTracks(self.sightings.joined(other.sightings), *(np.concatenate(pair) for pair in pairs))


def accepted_tracks(sightings: TrackSightings, window: WindowPoses, rig: StereoRig, gate: FrameGate) -> AcceptedTracks:
    """Return the tracks that pass, some of them without one of their sightings.

    ``gate`` counts every test, so a track that is tested twice counts twice.
    """
    accepted, again = _tested(sightings, window, rig, gate)
    return accepted.joined(_tested(again, window, rig, gate)[0]) if len(again.track_ids) else accepted


def _tested(
    sightings: TrackSightings, window: WindowPoses, rig: StereoRig, gate: FrameGate
) -> tuple[AcceptedTracks, TrackSightings]:
    """Return the tracks that pass, and without their worst sighting those that fail by a wide margin, to retest."""
    from filters.kalman import kernels

    points, reliable, nis, dof, worst, H, residuals, track = kernels.test_tracks(
        (sightings.uvs_px, sightings.seen),
        window.for_kernels(rig),
        np.ascontiguousarray(window.cov),
        camera_for_kernels(rig),
        (LEAST_DISPARITY_PX, LEAST_DEPTH_M),
        (gate.bounds(3 * sightings.seen.shape[1]), MISMATCHED_TRACK_FACTOR),
    )
    accepted = np.zeros(len(reliable), dtype=bool)
    accepted[reliable] = gate.accepts(nis[reliable], dof[reliable])
    weights = gate.weights(nis, dof, accepted)
    if gate.weighs:
        roots = np.sqrt(weights)[track]
        H, residuals = roots[:, None] * H, roots * residuals
    passed = AcceptedTracks(sightings.select(accepted), points[accepted], weights[accepted], H, residuals)
    mismatched = np.flatnonzero(reliable & (worst >= 0))
    less = sightings.select(mismatched)
    less.seen[np.arange(mismatched.size), worst[mismatched]] = False
    return passed, less.select(less.seen.sum(axis=1) >= FEWEST_SIGHTINGS)
