"""The present state given also the tracks still in view: for the answer alone, it does not enter the belief.

A windowed filter corrects by a track once, when the track ends or leaves the window. Until then the belief has no
information from its sightings, and the newest pose would follow the measured motion alone. So the answer at a frame is
the belief given all tracks in view, computed beside the belief and then discarded. No sighting counts twice, and up to
linearisation it is the answer that the filter would give if every track ended here (tested).

Landmarks are eliminated by the Schur complement of the normal equations (Triggs, McLauchlan, Hartley & Fitzgibbon 2000,
"Bundle adjustment - a modern synthesis", section 6.1), which for a track is the same as projecting its rows onto the
left null space of its landmark (Mourikis & Roumeliotis 2007, eqs. 23-24): one matrix product for all tracks. With L and
n the resulting information matrix and vector of the clones, the update in information form moves the state's error by
``P_xc (1 + L P_cc)^-1 n`` and subtracts ``P_xc (1 + L P_cc)^-1 L P_cx`` from its covariance.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from filters.kalman import multiview
from filters.kalman.frame_gate import FrameGate
from filters.kalman.joint import (
    JointBelief,
    cholesky_root,
    divided_by_root,
    regular_root,
    times_root,
    transposed_root_times,
)
from filters.kalman.linearisation import Linearisation
from filters.kalman.multiview import TrackSightings
from filters.kalman.track_gate import WindowPoses
from filters.kalman.triangulation import is_determined, lacking, nearest_view
from toolkit.arrays import is_among
from toolkit.geometry import Array, BoolArray, IntArray, se3_exp, transposed
from toolkit.measurements import StereoRig
from toolkit.models import stereo
from toolkit.models.gating import FEWEST_SIGHTINGS, LEAST_DEPTH_M, mahalanobis_squared
from toolkit.models.state import POSE, Belief
from toolkit.settings.records import Outliers


class FollowedTracks(NamedTuple):
    """F tracks in view of W clones: points (F, 3), and the weight of each sighting (F, W), 0 if rejected.

    The newest clone sees all of them.
    """

    sightings: TrackSightings
    clone_frames: IntArray
    points: Array
    weights: Array

    @property
    def counted(self) -> TrackSightings:
        """Return the sightings that were not rejected."""
        return self.sightings._replace(seen=self.sightings.seen & (self.weights > 0.0))

    @classmethod
    def none(cls) -> "FollowedTracks":
        """Return no tracks."""
        ids, nothing = np.empty(0, dtype=np.int64), np.empty((0, 0))
        sightings = TrackSightings(ids, np.empty((0, 0, 3)), nothing.astype(bool))
        return cls(sightings, ids, np.empty((0, 3)), nothing)

    def select(self, rows: BoolArray) -> "FollowedTracks":
        """Return some of the tracks (F,), nearly always all of them."""
        if rows.all():
            return self
        return FollowedTracks(self.sightings.select(rows), self.clone_frames, self.points[rows], self.weights[rows])


class RootedWindow(NamedTuple):
    """The window's poses and their linearisation points (W, 4, 4), and the root R (6 W, 6 W) of their covariance."""

    poses: Array
    poses_at: Array
    root: Array

    @classmethod
    def of(cls, window: WindowPoses) -> "RootedWindow":
        """Return a window with the root of its covariance."""
        return cls(window.poses, window.poses_at, regular_root(window.cov))


class Information(NamedTuple):
    """The information matrix (6 W, 6 W) and vector (6 W,) of F tracks on W poses, with the landmarks eliminated.

    Both are in terms of errors u of unit covariance; the poses' errors are ``R u``. Only the lower half of the matrix
    is set. ``weights`` (F,) are those of the newest sightings, ``points`` (F, 3) the landmarks after a Gauss-Newton
    step. A track is ``usable`` (F,) if it is in front of all its cameras and its landmark is determined; other tracks
    add no information.
    """

    points: Array
    weights: Array
    usable: BoolArray
    matrix: Array
    vector: Array


# Returns the landmarks of tracks: those known before, and new ones by triangulation.
Follow = Callable[[FollowedTracks, TrackSightings, JointBelief, StereoRig], FollowedTracks]
# Gates the newest sightings of tracks and returns the information of the tracks on a window.
InformationOf = Callable[[FollowedTracks, RootedWindow, StereoRig, FrameGate], Information]


def information(tracks: FollowedTracks, window: RootedWindow, rig: StereoRig, gate: FrameGate) -> Information:
    """Gate the newest sightings and return the information of all tracks: the definition, in NumPy, all at once."""
    rows, usable = _rows(tracks, window, rig)
    points, weights = tracks.points.copy(), np.zeros(len(usable))
    normals = _Normals.of(rows.select(usable))
    nis = normals.newest_nis(window.root)
    dof = stereo.degrees_of_freedom(tracks.sightings.uvs_px[usable, -1])
    weights[usable] = gate.weights(nis, dof, gate.accepts(nis, dof))
    normals = normals.newest_weighed(weights[usable])
    most_m = 0.2 * rows.depth_m[usable].min(axis=1)
    points[usable] += _no_longer_than(most_m, normals.point_steps())
    matrix, vector = normals.of_clones()
    matrix = transposed_root_times(window.root, times_root(matrix, window.root))
    return Information(points, weights, usable, matrix, window.root.T @ vector)


def followed(known: FollowedTracks, sightings: TrackSightings, joint: JointBelief, rig: StereoRig) -> FollowedTracks:
    """Return tracks with their landmarks, from the frame before or from a first triangulation: the definition."""
    sightings = sightings.select(sightings.seen.sum(axis=1) >= FEWEST_SIGHTINGS)
    rows, before = _rows_in(known.sightings.track_ids, sightings.track_ids)
    points, weights = np.zeros((len(rows), 3)), np.ones(sightings.seen.shape)
    still = is_among(known.clone_frames, joint.clone_frames)
    here = is_among(joint.clone_frames, known.clone_frames)
    points[before] = known.points[rows[before]]
    weights[np.ix_(before, here)] = known.weights[np.ix_(rows[before], still)]
    reliable, new = before.copy(), sightings.select(~before)
    points[~before], wide = nearest_view(new.uvs_px, new.seen, joint.clones, rig)
    reliable[~before] = wide | lacking(new.uvs_px, new.seen, wide)
    return FollowedTracks(sightings, joint.clone_frames, points, weights).select(reliable)


class Steps(NamedTuple):
    """Functions that find the landmarks of tracks with two sightings or more, and return their information."""

    follow: Follow
    information: InformationOf


NUMPY = Steps(followed, information)


class TracksInView:
    """Corrects a belief by the tracks in view, and keeps their landmarks and weights from frame to frame.

    A landmark is triangulated at its track's second sighting and then follows by one Gauss-Newton step a frame. A
    sighting is gated once, at its frame, against the window and the earlier sightings of its track; its weight then
    stays.
    """

    def __init__(self, at: Linearisation, rig: StereoRig, outliers: Outliers, steps: Steps = NUMPY) -> None:
        self._at, self._rig, self._outliers, self._steps = at, rig, outliers, steps
        self._known = FollowedTracks.none()

    def corrected(self, joint: JointBelief, sightings: TrackSightings) -> Belief:
        """Return the present state given the tracks that the newest of W poses sees and that have not corrected yet."""
        tracks = self._steps.follow(self._known, sightings, joint, self._rig)
        if not len(tracks.points):
            self._known = tracks
            return joint.core
        gate = FrameGate(self._outliers.gate_probability, self._outliers.joint_huber)
        window = RootedWindow.of(WindowPoses.of(joint, self._at))
        found = self._steps.information(tracks, window, self._rig, gate)
        tracks.weights[:, -1] = found.weights
        self._known = tracks._replace(points=found.points).select(found.usable)
        if not found.usable.any():
            return joint.core
        weight = self._rig.track_weight
        return _corrected_by_information(
            joint, window.root, np.multiply(found.matrix, weight, out=found.matrix), weight * found.vector
        )


class _Rows(NamedTuple):
    """Independent rows of F tracks, by sighting: residuals (F, W, 3), Jacobians to the landmark and to poses.

    ``H_point`` is (F, W, 3, 3). ``H_pose`` (F, W, 3, k) is to the pose of the sighting, k = 6, or to all poses, k = 6
    W.
    """

    residuals: Array
    H_point: Array
    H_pose: Array
    depth_m: Array

    def select(self, tracks: BoolArray) -> "_Rows":
        """Return the rows of the tracks of a mask (F,)."""
        return _Rows(self.residuals[tracks], self.H_point[tracks], self.H_pose[tracks], self.depth_m[tracks])

    def scaled(self, factors: Array) -> "_Rows":
        """Return the rows of each sighting multiplied by its factor (F, W)."""
        by = factors[..., None]
        return _Rows(by * self.residuals, by[..., None] * self.H_point, by[..., None] * self.H_pose, self.depth_m)


def _rows(tracks: FollowedTracks, window: RootedWindow, rig: StereoRig) -> tuple[_Rows, BoolArray]:
    """Return the tracks' rows, zero where rejected, and which tracks (F,) are in front of all their cameras.

    Where right images are missing, the sightings before the newest must determine the landmark.
    """
    counted = tracks.counted
    seen = multiview.linearise(counted, tracks.points, window.poses, window.poses_at, rig)
    rows = _Rows(seen.residuals, seen.H_point, seen.H_pose, seen.depth_m)
    if ((tracks.weights > 0.0) & (tracks.weights < 1.0)).any():
        rows = rows.scaled(np.sqrt(tracks.weights))
    nearest_m = seen.depth_m.min(axis=1)
    usable, some = nearest_m > LEAST_DEPTH_M, np.flatnonzero(counted.left_only.any(axis=1))
    if some.size:
        H_before = rows.H_point[some, :-1]
        usable[some] &= is_determined((np.swapaxes(H_before, 2, 3) @ H_before).sum(axis=1), nearest_m[some])
    return rows, np.asarray(usable)


class _Normals(NamedTuple):
    """The normal equations of F tracks, by sighting: ``N x = b`` of the landmark, and ``B``, of landmark and poses.

    N (F, W, 3, 3), b (F, W, 3), B (F, W, 3, k), with the rows that they are formed of.
    """

    rows: _Rows
    N: Array
    b: Array
    B: Array

    @classmethod
    def of(cls, rows: _Rows) -> "_Normals":
        """Return the normal equations of some rows."""
        H_transposed = np.swapaxes(rows.H_point, 2, 3)
        right = (H_transposed @ rows.residuals[..., None])[..., 0]
        return cls(rows, transposed(rows.H_point) @ rows.H_point, right, H_transposed @ rows.H_pose)

    def newest_nis(self, root: Array) -> Array:
        """Return the NIS (F,) of the newest sightings, each given the window and the others of its track.

        ``root`` (6 W, 6 W) is that of the covariance of the poses. The others place the landmark at ``V (b + B x)``
        with ``V = N^-1``, and the newest sighting measures ``H V (b + B x)`` of it.
        """
        rows, (tracks, window) = self.rows, self.b.shape[:2]
        toward = -rows.H_point[:, -1] @ np.linalg.inv(self.N[:, :-1].sum(axis=1))
        others = self.B.copy()
        others[:, -1] = 0.0
        H = toward @ _to_all_poses(others)
        H[..., -rows.H_pose.shape[3] :] += rows.H_pose[:, -1]
        innovations = rows.residuals[:, -1] + (toward @ self.b[:, :-1].sum(axis=1)[..., None])[..., 0]
        by_root = times_root(H.reshape(3 * tracks, 6 * window), root).reshape(H.shape)
        noise = np.eye(3) - toward @ np.swapaxes(rows.H_point[:, -1], 1, 2)
        return mahalanobis_squared(innovations, by_root @ np.swapaxes(by_root, 1, 2) + noise)

    def newest_weighed(self, weights: Array) -> "_Normals":
        """Return the normal equations with each track's newest sighting multiplied by its weight (F,)."""
        factors = np.ones(self.b.shape[:2])
        factors[:, -1] = weights
        by = factors[..., None]
        rows = self.rows.scaled(np.sqrt(factors))
        return _Normals(rows, by[..., None] * self.N, by * self.b, by[..., None] * self.B)

    def point_steps(self) -> Array:
        """Return the Gauss-Newton step (F, 3) m of each landmark with the poses fixed."""
        return np.asarray(np.linalg.solve(self.N.sum(axis=1), self.b.sum(axis=1)[..., None])[..., 0])

    def of_clones(self) -> tuple[Array, Array]:
        """Return the information matrix (6 W, 6 W) and vector (6 W,) on the clones, the landmarks eliminated."""
        tracks, window = self.b.shape[:2]
        both = np.concatenate([_to_all_poses(self.B), self.b.sum(axis=1)[..., None]], axis=2)
        inverse_roots = np.linalg.inv(np.linalg.cholesky(self.N.sum(axis=1)))
        by_root = (inverse_roots @ both).reshape(3 * tracks, 6 * window + 1)
        eliminated = by_root[:, :-1].T @ by_root
        matrix, vector = _of_poses(self.rows)
        return matrix - eliminated[:, :-1], vector - eliminated[:, -1]


def _to_all_poses(by_sighting: Array) -> Array:
    """Return sums over sightings (F, W, 3, k) as columns of all poses, (F, 3, 6 W)."""
    tracks, window, _, k = by_sighting.shape
    if k == 6 * window:
        return np.asarray(by_sighting.sum(axis=1))
    return np.swapaxes(by_sighting, 1, 2).reshape(tracks, 3, 6 * window)


def _of_poses(rows: _Rows) -> tuple[Array, Array]:
    """Return the normal equations (6 W, 6 W), (6 W,) of the poses alone."""
    tracks, window, _, k = rows.H_pose.shape
    if k == 6 * window:
        stacked = rows.H_pose.reshape(-1, k)
        return stacked.T @ stacked, stacked.T @ rows.residuals.reshape(-1)
    H = np.swapaxes(rows.H_pose, 0, 1).reshape(window, 3 * tracks, 6)
    H_transposed = np.swapaxes(H, 1, 2)
    matrix = np.zeros((window, 6, window, 6))
    matrix[np.arange(window), :, np.arange(window)] = H_transposed @ H
    vector = H_transposed @ np.swapaxes(rows.residuals, 0, 1).reshape(window, 3 * tracks, 1)
    return matrix.reshape(6 * window, 6 * window), vector.reshape(6 * window)


def _corrected_by_information(joint: JointBelief, root: Array, matrix: Array, vector: Array) -> Belief:
    """Return the present state given information (6 W, 6 W), (6 W,) on errors of which the clones' are ``root`` times.

    The matrix is overwritten.
    """
    core = joint.core
    to_core = divided_by_root(root, joint.cov[joint.clone_columns, : core.layout.size].copy())
    matrix.flat[:: len(matrix) + 1] += 1.0
    halves = divided_by_root(cholesky_root(matrix), np.column_stack([to_core, vector]))
    half = halves[:, :-1]
    delta, cov = half.T @ halves[:, -1], core.cov - to_core.T @ to_core + half.T @ half
    moved = core.displaced(delta, se3_exp(delta[POSE]))
    return replace(moved, cov=0.5 * (cov + cov.T))


def _no_longer_than(most_m: Array, steps: Array) -> Array:
    """Return steps (F, 3) shortened to a length (F,) where they are longer."""
    lengths = np.linalg.norm(steps, axis=1)
    return np.asarray(steps * np.minimum(1.0, most_m / np.maximum(lengths, 1e-9))[:, None])


def _rows_in(ids: IntArray, wanted: IntArray) -> tuple[IntArray, BoolArray]:
    """Return the row (N,) of each wanted id (N,) among ids, and whether (N,) it is there."""
    order = np.argsort(ids)
    places = np.searchsorted(ids, wanted, sorter=order)
    rows = np.append(order, 0)[places]
    there = np.append(ids, -1)[np.where(places < len(ids), rows, len(ids))] == wanted
    return rows, np.asarray(there)
