"""Landmarks in a joint belief whose tracks have a random-walk error and an offset: each track's error is a state.

A track's error persists: the sightings that initialised its landmark and all later ones share it. With the error b of a
track (in :data:`toolkit.track_noise.CHANNELS`) in the state, the remaining noise of a sighting is white and independent
of all others. Over an interval of n frames the variance of b grows by n walk^2.
"""

from typing import NamedTuple

import numpy as np

from filters.kalman import joint_landmarks, multiview
from filters.kalman.frame_gate import FrameGate
from filters.kalman.joint import JointBelief
from filters.kalman.linearisation import Linearisation
from filters.kalman.multiview import Linearised, TrackSightings
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models import correlated_noise, left_only
from toolkit.models.gating import mahalanobis_squared
from toolkit.models.state import Belief
from toolkit.sequence import StereoFrame, StereoRig
from toolkit.track_noise import CHANNELS, TrackNoise


class TrackErrorBelief(JointBelief):
    """A joint belief with the errors of its landmarks' tracks after the landmarks, three per track.

    ``track_errors_px`` (L, 3) are their estimates, ``ages`` (L,) the ages of the tracks at their last sighting.
    """

    def __init__(self, core: Belief, noise: TrackNoise) -> None:
        super().__init__(core)
        self.noise = noise
        self.track_errors_px: Array = np.empty((0, 3))
        self.ages: IntArray = np.empty(0, dtype=np.int64)

    @property
    def landmark_columns(self) -> slice:
        """Return the columns of the landmarks in the error state."""
        start = self.clone_columns.stop
        return slice(start, start + 3 * len(self.points))

    @property
    def track_error_columns(self) -> slice:
        """Return the columns of the tracks' errors in the error state."""
        return slice(self.landmark_columns.stop, self.cov.shape[0])

    def add_landmarks_with_errors(self, started: "Started", ages: IntArray) -> None:
        """Add landmarks with the errors of their tracks; ``ages`` (N,) are those of the last sightings."""
        landmarks, before = self.landmark_columns, self.cov.shape[0]
        self._add_rows(started.jacobian, started.cov)
        new = np.arange(before, self.cov.shape[0]).reshape(-1, 2, 3)
        order = np.r_[0 : landmarks.stop, new[:, 0].ravel(), landmarks.stop : before, new[:, 1].ravel()]
        self._cov = self._cov[np.ix_(order, order)]
        self.landmark_ids = np.concatenate([self.landmark_ids, started.track_ids])
        self.points = np.concatenate([self.points, started.points])
        self.first_points = np.concatenate([self.first_points, started.first_points])
        self.track_errors_px = np.concatenate([self.track_errors_px, started.track_errors_px])
        self.ages = np.concatenate([self.ages, ages])

    def walk(self, ages: IntArray) -> None:
        """Propagate the tracks' errors to new ages (L,) by their random walk."""
        variance_px2 = np.square(self.noise.walk_px) * (ages - self.ages)[:, None]
        rows = np.arange(self.track_error_columns.start, self.track_error_columns.stop)
        self._cov = self._cov.copy()
        self._cov[rows, rows] += variance_px2.ravel()
        self.ages = ages

    def forget_landmarks(self, which: BoolArray) -> None:
        """Marginalise landmarks (L,) and the errors of their tracks."""
        kept = np.ones(self.cov.shape[0], dtype=bool)
        kept[self.landmark_columns.start :] = np.tile(np.repeat(~which, 3), 2)
        self._cov = self._cov[np.ix_(kept, kept)]
        self.landmark_ids = self.landmark_ids[~which]
        self.points, self.first_points = self.points[~which], self.first_points[~which]
        self.track_errors_px, self.ages = self.track_errors_px[~which], self.ages[~which]

    def _displace(self, delta: Array) -> None:
        self.track_errors_px = self.track_errors_px + delta[self.track_error_columns].reshape(-1, 3)
        super()._displace(delta)


def correct(joint: TrackErrorBelief, frame: StereoFrame, at: Linearisation, rig: StereoRig, gate: FrameGate) -> None:
    """Correct the whole state by its landmarks; the frame must show every one of them."""
    count = len(joint.landmark_ids)
    if not count:
        return
    order = np.argsort(frame.track_ids)
    rows = order[np.searchsorted(frame.track_ids, joint.landmark_ids, sorter=order)]
    joint.walk(frame.ages[rows])
    white = correlated_noise.white_rig(joint.noise, rig)
    seen = joint_landmarks.linearise_sightings(joint, frame, at, white)
    H_error = left_only.whitener(frame.uvs_px[rows], white) @ np.linalg.inv(CHANNELS)
    residuals = seen.residuals - left_only.applied(H_error, joint.track_errors_px)
    H_each = np.concatenate([seen.H_pose, seen.H_point, np.broadcast_to(H_error, (count, 3, 3))], axis=2)
    columns = _columns_each(joint)
    spread = H_each @ joint.cov[columns[:, :, None], columns[:, None, :]] @ np.swapaxes(H_each, 1, 2)
    nis = mahalanobis_squared(residuals, spread + np.eye(3))
    weights = gate.weights(nis, seen.dof, gate.accepts(nis, seen.dof, seen.depth_m > 0.0))
    used = np.flatnonzero(weights)
    if used.size:
        roots = np.sqrt(weights[used])
        first = joint.clone_columns.start
        H = np.zeros((used.size, 3, joint.cov.shape[0] - first))
        rows = np.arange(used.size)[:, None]
        H[rows, :, columns[used] - first] = np.swapaxes(roots[:, None, None] * H_each[used], 1, 2)
        joint.update(H.reshape(3 * used.size, -1), (roots[:, None] * residuals[used]).ravel(), slice(first, None))


def implausible_errors(joint: TrackErrorBelief, gate: FrameGate) -> BoolArray:
    """Say which tracks (L,) have an estimated error beyond the gate's bound under the stated walk and offset.

    A point that moves slowly passes the gate at every frame, while the error of its track absorbs the movement.
    """
    variance_px2 = correlated_noise.walked_variance(joint.noise, joint.ages)
    return np.asarray((np.square(joint.track_errors_px) / variance_px2).sum(axis=1) > gate.bound(3))


def _columns_each(joint: TrackErrorBelief) -> IntArray:
    """Return the columns (L, 12) of the newest clone, of each landmark and of the error of its track."""
    newest = np.arange(joint.clone_columns.stop - 6, joint.clone_columns.stop)
    own = np.arange(joint.landmark_columns.start, joint.cov.shape[0]).reshape(2, -1, 3)
    return np.concatenate([np.tile(newest, (own.shape[1], 1)), own[0], own[1]], axis=1)


class Started(NamedTuple):
    """N landmarks (N, 3) and errors of their tracks (N, 3) px, estimated from the sightings of a window.

    Their errors, six per landmark, are ``jacobian`` (6 N, n) times the state's error plus noise of covariance ``cov``.
    ``first_points`` (N, 3) are the linearisation points. Later sightings must be linearised there too: Jacobians at two
    different points of a landmark gain information on the heading, which no measurement observes, and with a noise of a
    tenth of a pixel they gain much.
    """

    track_ids: IntArray
    points: Array
    first_points: Array
    track_errors_px: Array
    jacobian: Array
    cov: Array


def add_tracks(joint: TrackErrorBelief, sightings: TrackSightings, points: Array, linearised: Linearised) -> None:
    """Add N tracks to the state: points (N, 3) m, and their errors at the newest clone, which sees all of them."""
    joint.add_landmarks_with_errors(started(joint, sightings, points, linearised), sightings.ages[:, -1])


def started(joint: TrackErrorBelief, sightings: TrackSightings, points: Array, linearised: Linearised) -> Started:
    """Estimate N points (N, 3) m and their tracks' errors at the newest pose from a window's sightings.

    With residuals, Jacobians and noise e decorrelated, ``r = H_x x + H p + e``, the least-squares point has the error
    ``-V H^T (H_x x + e)`` with ``V = (H^T H)^-1``, and the track error b is estimated with the error
    ``b - K Q (H_x x + e)``. K is the covariance of b with e, and ``Q = 1 - H V H^T`` projects onto the part that the
    landmark does not explain. The noise in both is that of generalised least squares followed by the best linear
    prediction; it is independent of ``Q e``, by which the track corrects the window.
    """
    count, window = sightings.seen.shape
    mixing, d = linearised.decorrelation, joint.cov.shape[0]
    assert mixing is not None
    H = mixing @ linearised.H_point.reshape(count, 3 * window, 3)
    last = correlated_noise.error_of_the_last(joint.noise, sightings.ages, sightings.seen, sightings.left_only)
    cov_point = np.linalg.inv(np.swapaxes(H, 1, 2) @ H)
    to_point = cov_point @ np.swapaxes(H, 1, 2)
    unexplained = np.eye(3 * window) - H @ to_point
    pulls = np.concatenate([to_point @ mixing, last.gain @ unexplained @ mixing], axis=1)
    moves = (pulls @ linearised.residuals.reshape(count, 3 * window, 1))[..., 0]
    jacobian = np.zeros((6 * count, d))
    blocks = -np.swapaxes(multiview.by_pose(pulls) @ linearised.H_pose, 1, 2)
    jacobian[:, joint.clone_columns] = blocks.reshape(6 * count, 6 * window)
    across = -to_point @ np.swapaxes(last.gain, 1, 2)
    own = last.cov - last.gain @ unexplained @ np.swapaxes(last.gain, 1, 2)
    cov = np.zeros((count, 6, count, 6))
    each = np.concatenate(
        [np.concatenate([cov_point, across], 2), np.concatenate([np.swapaxes(across, 1, 2), own], 2)], 1
    )
    cov[np.arange(count), :, np.arange(count), :] = each
    moved, errors_px = points + moves[:, :3], moves[:, 3:]
    return Started(sightings.track_ids, moved, points, errors_px, jacobian, cov.reshape(6 * count, 6 * count))
