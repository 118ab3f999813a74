"""The multi-state constraint Kalman filter: a window of cloned poses, tied by tracks whose landmarks are eliminated.

What it approximates: a track corrects once, when it ends or the oldest pose that saw it leaves, and poses that have
left the window are never corrected again (Mourikis & Roumeliotis 2007). The answer at a frame is the state given also
the tracks still in view; these do not correct the belief itself (:mod:`filters.kalman.tracks_in_view`). A pose leaves
once it is older than the window, as a state does in the smoothers. With ``landmarks``, up to that many tracks that span
the window are kept in the state for as long as they are seen (Li & Mourikis 2013, "Optimization-based estimator design
for vision-aided inertial navigation").
"""

import numpy as np

from filters.kalman import compiled, joint_landmarks, multiview
from filters.kalman.frame_gate import FrameGate
from filters.kalman.joint import JointBelief
from filters.kalman.linearisation import Linearisation, propagate
from filters.kalman.multiview import TrackSightings
from filters.kalman.online_output import LandmarkMemory
from filters.kalman.track_gate import TrackGate
from filters.kalman.tracks_in_view import TracksInView
from toolkit.arrays import is_among, rows_of
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Setup
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.measurements import NS_PER_S, Packet, StereoFrame
from toolkit.models.gating import FEWEST_SIGHTINGS
from toolkit.models.motion import motion_model


class SlidingWindowFilter:
    """Propagate, clone, correct by landmarks and by finished tracks, drop old poses; answer given all in view.

    ``landmarks`` is the number of long-lived landmarks the state may have; ``window_s`` the length of the window in
    seconds, by default that of the settings.
    """

    def __init__(
        self, setup: Setup, linearisation: Linearisation, landmarks: int = 0, window_s: float | None = None
    ) -> None:
        self._rig, self._at = setup.rig, linearisation
        self._outliers, self._motion = setup.settings.outliers, motion_model(setup.noise, setup.gravity_world)
        compiled.share_windowed(setup.compilation)
        if window_s is None:
            window_s = setup.settings.window.seconds(setup.motion_kind)
        self._lag_ns, self._most_landmarks = round(window_s * NS_PER_S), landmarks
        self._clone_t_ns: IntArray = np.empty(0, dtype=np.int64)
        self._joint = JointBelief(self._motion.initial_belief(setup.prior))
        self._tracks = WindowTracks()
        self._track_test = compiled.track_test(setup.compilation)
        self._in_view = TracksInView(
            linearisation, setup.rig, self._outliers, compiled.steps_in_view(setup.compilation)
        )
        self._memory = LandmarkMemory()

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and return the state at its frame."""
        propagate(self._joint, self._motion, self._at, packet.motion)
        self._joint.clone(packet.index)
        self._clone_t_ns = np.append(self._clone_t_ns, packet.frame.t_ns)
        gate = FrameGate(self._outliers.gate_probability, self._outliers.joint_huber, self._rig.track_weight)
        joint_landmarks.forget_lost(self._joint, packet.frame, self._memory)
        joint_landmarks.correct(self._joint, packet.frame, self._at, self._rig, gate)
        self._tracks.add_frame(_without_landmarks(packet.frame, self._joint))
        leaving = self._clone_t_ns < packet.frame.t_ns - self._lag_ns
        self._correct_by_tracks(leaving, gate)
        self._forget_clones(leaving)
        now = self._in_view.corrected(self._joint, self._tracks.unused())
        return now.estimate(packet.frame.t_ns, **gate.info())

    def landmarks(self) -> Landmarks:
        """Return the last estimate of every landmark that was ever triangulated."""
        self._memory.remember(self._joint.landmark_ids, self._joint.points)
        return self._memory.landmarks()

    def _correct_by_tracks(self, leaving: BoolArray, gate: FrameGate) -> None:
        """Correct by the tracks that have ended, and by those seen from poses (C,) that leave the window now.

        Both together, unless there is room for landmarks. A new landmark's linearisation point stays, so it is
        triangulated after the ended tracks have corrected the window.
        """
        used = self._tracks.ended()
        if not self._room:
            used = used | self._tracks.seen_by(leaving)
        self._correct_by(self._tracks.take(used), gate)
        if self._room and leaving.any():
            self._correct_by(self._tracks.take(self._tracks.seen_by(leaving)), gate)

    @property
    def _room(self) -> int:
        return max(self._most_landmarks - len(self._joint.landmark_ids), 0)

    def _correct_by(self, sightings: TrackSightings, gate: FrameGate) -> None:
        """Correct the window by tracks; add those still seen as landmarks, as many as there is room for."""
        joint = self._joint
        sightings = sightings.select(sightings.seen.sum(axis=1) >= FEWEST_SIGHTINGS)
        track_gate = TrackGate(joint, self._at, self._rig, self._track_test)
        accepted = track_gate.accepted(sightings, gate)
        if not len(accepted.points):
            return
        self._memory.remember(accepted.sightings.track_ids, accepted.points)
        kept = np.flatnonzero(accepted.sightings.seen[:, -1])[: self._room]
        if len(kept):
            ids, points = accepted.sightings.track_ids[kept], accepted.points[kept]
            joint_landmarks.add_tracks(joint, ids, points, track_gate.linearised(accepted, kept))
        first = 6 * int(np.argmax(accepted.sightings.seen.any(axis=0)))
        self._update(accepted.H[:, first:], accepted.residuals)

    def _update(self, H: Array, residuals: Array) -> None:
        """Correct the whole state by whitened residuals (m,) with Jacobian (m, k) to the newest clones."""
        joint, (count, size) = self._joint, H.shape
        end = joint.clone_columns.stop
        if count > size and end == joint.cov.shape[0]:
            joint.inform(H.T @ H, H.T @ residuals)
            return
        # With landmarks after the clones in the error state, an update by fewer rows is cheaper.
        joint.update(*multiview.compressed(H, residuals), slice(end - size, end))

    def _forget_clones(self, which: BoolArray) -> None:
        """Marginalise poses (C,), which are the oldest."""
        if which.any():
            self._joint.forget_clones(which)
            self._tracks.drop_oldest(int(which.sum()))
            self._clone_t_ns = self._clone_t_ns[~which]


class WindowTracks:
    """The tracks not yet used: sightings of A tracks from the W poses of the window, one column per clone."""

    def __init__(self) -> None:
        self._ids: IntArray = np.empty(0, dtype=np.int64)
        self._uvs_px = np.empty((0, 0, 3))
        self._seen = np.empty((0, 0), dtype=bool)

    def add_frame(self, frame: StereoFrame) -> None:
        """Append the frame's sightings as a new column; ids unknown so far start new tracks."""
        order = np.argsort(self._ids)
        at, known = rows_of(frame.track_ids, self._ids[order])
        new = frame.track_ids[~known]
        before, count, window = len(self._ids), len(self._ids) + len(new), self._seen.shape[1] + 1
        rows = np.empty(len(known), dtype=np.int64)
        rows[known], rows[~known] = order[at[known]], np.arange(before, count)
        uvs_px, seen = np.zeros((count, window, 3)), np.zeros((count, window), dtype=bool)
        uvs_px[:before, :-1], seen[:before, :-1] = self._uvs_px, self._seen
        uvs_px[rows, -1], seen[rows, -1] = frame.uvs_px, True
        self._ids, self._uvs_px, self._seen = np.concatenate([self._ids, new]), uvs_px, seen

    def drop_oldest(self, count: int) -> None:
        """Drop the sightings from the ``count`` oldest poses."""
        self._uvs_px, self._seen = self._uvs_px[:, count:], self._seen[:, count:]
        self._keep(np.asarray(self._seen.any(axis=1)))

    def ended(self) -> BoolArray:
        """Say which tracks (A,) the newest pose does not see."""
        return np.asarray(~self._seen[:, -1])

    def seen_by(self, which: BoolArray) -> BoolArray:
        """Say which tracks (A,) any of some poses (W,) has seen."""
        return np.asarray(self._seen[:, which].any(axis=1))

    def unused(self) -> TrackSightings:
        """Return the sightings of all A tracks."""
        return TrackSightings(self._ids, self._uvs_px, self._seen)

    def take(self, rows: BoolArray) -> TrackSightings:
        """Return those tracks (A,) and drop their sightings; a track that is still seen starts again."""
        tracks = self.unused()
        self._keep(np.logical_not(rows))
        return tracks.select(rows)

    def _keep(self, rows: BoolArray) -> None:
        self._ids, self._uvs_px, self._seen = self.unused().select(rows)


def _without_landmarks(frame: StereoFrame, joint: JointBelief) -> StereoFrame:
    """Return the frame without the sightings of landmarks in the state."""
    if not len(joint.landmark_ids):
        return frame
    return frame.select(~is_among(frame.track_ids, joint.landmark_ids))
