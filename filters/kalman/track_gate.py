"""The gate of the windowed filters: which tracks, and which of their sightings, may correct the window.

A track is accepted or rejected as a whole, so one mismatched sighting would reject all the others of its track.
Therefore, if a track fails the gate by a wide margin, the sighting that disagrees most with the rest of the track and
with the window is left out, and the track is tested once more if at least two sightings remain. A track that fails by
little may be sound and unlucky: leaving out its worst sighting would select measurements by their agreement.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from filters.kalman import multiview
from filters.kalman.frame_gate import FrameGate
from filters.kalman.joint import JointBelief
from filters.kalman.linearisation import Linearisation
from filters.kalman.multiview import Constraints, Linearised, TrackSightings
from filters.kalman.triangulation import triangulate
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.measurements import StereoRig
from toolkit.models.gating import FEWEST_SIGHTINGS, MISMATCHED_TRACK_FACTOR, mahalanobis_squared

# Tracks are tested in separate groups where that saves this many padded places in all: about the cost of a group.
_LEAST_LEFT_OUT = 300


class WindowPoses(NamedTuple):
    """The poses (W, 4, 4) of the window, their linearisation points (W, 4, 4) and their covariance (6 W, 6 W)."""

    poses: Array
    poses_at: Array
    cov: Array

    @classmethod
    def of(cls, joint: JointBelief, at: Linearisation) -> "WindowPoses":
        """Return the window of a joint belief, linearised at the chosen points."""
        columns = joint.clone_columns
        return cls(joint.clones, at.clones(joint), joint.cov[columns, columns])

    def since(self, begin: int) -> "WindowPoses":
        """Return the window from pose ``begin`` on."""
        poses = self.poses[begin:]
        poses_at = poses if self.poses_at is self.poses else self.poses_at[begin:]
        return WindowPoses(poses, poses_at, self.cov[6 * begin :, 6 * begin :]) if begin else self


class TestedTracks(NamedTuple):
    """F tracks with landmarks (F, 3): the NIS (F,) of their constraints on the window, and those constraints.

    ``dof`` (F,) are the degrees of freedom of the NIS. ``worst`` (F,) is the sighting that disagrees most where the NIS
    is far above its bound, else -1. The whitened constraints of the tracks below their bounds are stacked: ``H`` (n, 6
    W), ``residuals`` (n,), and ``track`` (n,), the track of each row.
    """

    sightings: TrackSightings
    points: Array
    nis: Array
    dof: IntArray
    worst: IntArray
    H: Array
    residuals: Array
    track: IntArray


# Tests tracks against a window; the bounds (3 W - 2,) of the NIS are indexed by degrees of freedom.
TrackTest = Callable[[TrackSightings, WindowPoses, StereoRig, Array], TestedTracks]


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


def tested(sightings: TrackSightings, window: WindowPoses, rig: StereoRig, bounds: Array) -> TestedTracks:
    """Triangulate tracks, eliminate their landmarks and test them, all at once in NumPy: the definition.

    ``bounds`` (n,) is the gate's bound of the NIS at each number of degrees of freedom.
    """
    points, reliable = triangulate(sightings.uvs_px, sightings.seen, window.poses, rig)
    sightings, points = sightings.select(reliable), points[reliable]
    groups = list(_by_first_pose(sightings.seen))
    if len(groups) == 1 and not groups[0][0]:
        return _constrained(sightings, points, window, rig, bounds)
    parts = [
        _constrained(sightings.select(rows).since(begin), points[rows], window.since(begin), rig, bounds)
        for begin, rows in groups
    ]
    return _joined(sightings, points, groups, parts)


def _joined(
    sightings: TrackSightings, points: Array, groups: list[tuple[int, IntArray]], parts: list[TestedTracks]
) -> TestedTracks:
    """Merge the results of groups of tracks, each of which starts at a pose of its own; the rows of H stay by group."""
    count, window = sightings.seen.shape
    nis, dof, worst = np.empty(count), np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    H, end = np.zeros((sum(len(part.H) for part in parts), 6 * window)), 0
    for (begin, rows), part in zip(groups, parts, strict=True):
        nis[rows], dof[rows], worst[rows] = part.nis, part.dof, np.where(part.worst < 0, -1, part.worst + begin)
        H[end : end + len(part.H), 6 * begin :] = part.H
        end += len(part.H)
    residuals = np.concatenate([part.residuals for part in parts])
    tracks = np.concatenate([rows[part.track] for (_, rows), part in zip(groups, parts, strict=True)])
    return TestedTracks(sightings, points, nis, dof, worst, H, residuals, tracks)


def _by_first_pose(seen: BoolArray) -> Iterator[tuple[int, IntArray]]:
    """Yield groups of tracks by the pose from which on all of their sightings are (F, W): that pose, and their rows.

    All tracks of a group cost as much as its longest, so each group has the later half of the poses of the one before,
    where that saves enough to pay for a group.
    """
    first, begin, rows = seen.argmax(axis=1), 0, np.arange(len(seen))
    while True:
        middle = begin + (seen.shape[1] - begin) // 2
        late = first[rows] >= middle
        if np.count_nonzero(late) * (middle - begin) < _LEAST_LEFT_OUT:
            yield begin, rows
            return
        if not late.all():
            yield begin, rows[~late]
        begin, rows = middle, rows[late]


def _constrained(
    sightings: TrackSightings, points: Array, window: WindowPoses, rig: StereoRig, bounds: Array
) -> TestedTracks:
    """Eliminate the landmarks (F, 3) of tracks and test the tracks."""
    linearised = multiview.linearise(sightings, points, window.poses, window.poses_at, rig)
    constraints = multiview.without_landmark(linearised, sightings)
    covs = innovation_covs(constraints, window.cov)
    nis = mahalanobis_squared(constraints.residuals, covs)
    bound = bounds[constraints.dof]
    worst = np.full(len(nis), -1)
    far = np.asarray(nis > MISMATCHED_TRACK_FACTOR * bound)
    if far.any():
        basis, residuals = multiview.null_space(linearised.select(far)), constraints.residuals[far]
        worst[far] = _worst_sighting(basis, residuals, covs[far], sightings.seen[far])
    below = np.flatnonzero(nis < bound)
    H = constraints.H[below].reshape(-1, window.cov.shape[0])
    used = H.any(axis=1)
    owner = np.repeat(below, constraints.H.shape[1])
    residuals = constraints.residuals[below].reshape(-1)
    return TestedTracks(sightings, points, nis, constraints.dof, worst, H[used], residuals[used], owner[used])


def innovation_covs(constraints: Constraints, P: Array) -> Array:
    """Return the covariance (F, 3W - 3, 3W - 3) of each track's residuals, with P (6 W, 6 W) that of the window."""
    covs = constraints.H @ P @ np.swapaxes(constraints.H, 1, 2)
    variances = np.einsum("fii->fi", covs)
    variances += 1.0
    return np.asarray(covs)


def _worst_sighting(basis: Array, residuals: Array, covs: Array, seen: BoolArray) -> IntArray:
    """Return the sighting (F,) of each track without which its NIS would be smallest.

    ``basis`` (F, 3W - 3, 3W) maps the residuals of a track's sightings (F, W) to ``residuals`` (F, 3W - 3), whose
    covariances are ``covs`` (F, 3W - 3, 3W - 3). Leaving a sighting out means leaving its value free: with ``W`` the
    information matrix of all coordinates and ``r`` their residuals, the NIS falls by ``(W r)_j^T W_jj^-1 (W r)_j``.
    """
    count, window = seen.shape
    informed = np.linalg.solve(covs, np.concatenate([basis, residuals[..., None]], axis=2))
    weighted = (np.swapaxes(basis, 1, 2) @ informed[..., -1:]).reshape(count, window, 3)
    own = np.swapaxes(multiview.by_pose(basis), 2, 3) @ multiview.by_pose(informed[..., :-1])
    own = np.where(seen[..., None, None], own, np.eye(3))
    fall = (weighted * np.linalg.solve(own + 1e-12 * np.eye(3), weighted[..., None])[..., 0]).sum(axis=2)
    return np.asarray(np.argmax(np.where(seen, fall, -1.0), axis=1))


class TrackGate:
    """Tests tracks against a joint belief, by the NumPy definition or an equivalent kernel."""

    def __init__(
        self,
        joint: JointBelief,
        at: Linearisation,
        rig: StereoRig,
        test: TrackTest = tested,
    ) -> None:
        self._rig, self._test = rig, test
        self._window = WindowPoses.of(joint, at)

    def accepted(self, sightings: TrackSightings, gate: FrameGate) -> AcceptedTracks:
        """Return the tracks that pass, some of them without one of their sightings.

        ``gate`` counts every test, so a track that is tested twice counts twice.
        """
        accepted, again = self._tested(sightings, gate)
        return accepted.joined(self._tested(again, gate)[0]) if len(again.track_ids) else accepted

    def linearised(self, tracks: AcceptedTracks, rows: IntArray) -> Linearised:
        """Return some rows (m,) of the accepted tracks, linearised with their landmarks and weighted."""
        sightings, points = tracks.sightings.select(rows), tracks.points[rows]
        poses, poses_at, _ = self._window
        linearised = multiview.linearise(sightings, points, poses, poses_at, self._rig)
        return linearised.scaled(np.sqrt(tracks.weights[rows]))

    def _tested(self, sightings: TrackSightings, gate: FrameGate) -> tuple[AcceptedTracks, TrackSightings]:
        """Return the tracks that pass, and without their worst sighting those that fail by a wide margin, to retest."""
        bounds = gate.bounds(3 * sightings.seen.shape[1])
        tracks = self._test(sightings, self._window, self._rig, bounds)
        accepted = gate.accepts(tracks.nis, tracks.dof)
        weights = gate.weights(tracks.nis, tracks.dof, accepted)
        H, residuals = tracks.H, tracks.residuals
        if gate.weighs:
            roots = np.sqrt(weights)[tracks.track]
            H, residuals = roots[:, None] * H, roots * residuals
        passed = AcceptedTracks(
            tracks.sightings.select(accepted), tracks.points[accepted], weights[accepted], H, residuals
        )
        mismatched = (tracks.worst >= 0).nonzero()[0]
        less = tracks.sightings.select(mismatched)
        if mismatched.size:
            less.seen[np.arange(mismatched.size), tracks.worst[mismatched]] = False
            less = less.select(less.seen.sum(axis=1) >= FEWEST_SIGHTINGS)
        return passed, less
