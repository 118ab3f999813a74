"""The multi-state constraint Kalman filter: a window of cloned poses, tied by tracks whose landmarks are eliminated.

What it approximates: a track corrects once, when it ends or the oldest pose that saw it leaves, and poses that have
left the window are never corrected again (Mourikis & Roumeliotis 2007). The answer at a frame is the state given also
the tracks still in view; these do not correct the belief itself (:mod:`filters.kalman.tracks_in_view`). A pose leaves
once it is older than the window, as a state does in the smoothers. With ``landmarks``, up to that many tracks that span
the window are kept in the state for as long as they are seen (Li & Mourikis 2013, "Optimization-based estimator design
for vision-aided inertial navigation").

If residuals along tracks turn out correlated although white noise is stated, tracks are given less weight, and so are
landmarks in the state, by their own residuals (:mod:`filters.kalman.residual_correlation`). If the rig states a track
noise model, the sightings of a track correct with their full covariance, and each landmark in the state has the error
of its track as a state beside it. What is approximated then: a track that is still seen after it was used starts again
at its age, and its error at that age is taken as independent of the earlier sightings.
"""

from collections import deque

import numpy as np

from filters.kalman import compiled, joint_landmarks, multiview, track_error_states
from filters.kalman.frame_gate import FrameGate
from filters.kalman.joint import JointBelief
from filters.kalman.linearisation import Linearisation, propagate
from filters.kalman.motion_noise import MatchedNoise
from filters.kalman.multiview import Linearised, TrackSightings
from filters.kalman.online_output import LandmarkMemory
from filters.kalman.residual_correlation import LandmarkCorrelation, ResidualCorrelation
from filters.kalman.track_error_states import TrackErrorBelief
from filters.kalman.track_gate import TrackGate
from filters.kalman.tracks_in_view import TracksInView
from toolkit.arrays import is_among, rows_of
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Setup
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models.gap_bridge import gap_bridge_for
from toolkit.models.gating import FEWEST_SIGHTINGS
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Packet, StereoFrame
from toolkit.track_noise import TrackNoise


class SlidingWindowFilter:
    """Propagate, clone, correct by landmarks and by finished tracks, drop old poses; answer given all in view.

    ``landmarks`` is the number of long-lived landmarks the state may have; ``window_s`` the length of the window in
    seconds, by default that of the settings; ``scores_tracks`` whether the tracks' scores for a drift may lower their
    weight.
    """

    def __init__(
        self,
        setup: Setup,
        linearisation: Linearisation,
        landmarks: int = 0,
        window_s: float | None = None,
        scores_tracks: bool = True,
    ) -> None:
        self._rig, self._at = setup.rig, linearisation
        self._outliers, model = setup.settings.outliers, motion_model(setup.noise, setup.gravity_world)
        compiled.share_windowed(setup.noise, setup.compilation)
        self._motion = compiled.integrator(setup.noise, setup.gravity_world, setup.compilation)
        if window_s is None:
            window_s = setup.settings.window.seconds(setup.motion_kind)
        self._lag_ns, self._most_landmarks = round(window_s * NS_PER_S), landmarks
        self._clone_t_ns: IntArray = np.empty(0, dtype=np.int64)
        self._joint = _joint_belief(model.initial_belief(setup.prior), setup.rig.track_noise)
        self._joint.exponentials = compiled.exponentials(setup.compilation)
        self._tracks, self._frames = WindowTracks(), deque[StereoFrame]()
        self._track_test, self._images = compiled.track_test(setup.compilation), compiled.images(setup.compilation)
        self._in_view = TracksInView(
            linearisation, setup.rig, self._outliers, compiled.steps_in_view(setup.compilation)
        )
        self._memory = LandmarkMemory()
        self._noise = MatchedNoise.of(setup, compiled.correction_test(setup.compilation))
        self._correlation = ResidualCorrelation.of(setup)
        # With odometry, scores that lower the weight of tracks leave the pose to the landmarks in the state: with
        # scores msckf-slam has 0.99 +- 0.07 times the ATE on the UTIAS drives, and loses a quarter on the longest.
        self._scores_tracks = scores_tracks and (setup.motion_kind == "imu" or not landmarks)
        self._learn = compiled.learning(setup.compilation)
        self._landmark_correlation = LandmarkCorrelation.of(setup)
        self.bridge = gap_bridge_for(setup.noise, window_s) if setup.settings.noise.bridge_gaps else None

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and return the state at its frame."""
        propagate(self._joint, self._motion, self._at, self._noise.applied(packet).motion)
        predicted = self._joint.core
        self._joint.clone(packet.index)
        self._frames.append(packet.frame)
        self._clone_t_ns = np.append(self._clone_t_ns, packet.frame.t_ns)
        gate = FrameGate(self._outliers.gate_probability, self._outliers.joint_huber)
        joint_landmarks.forget_lost(self._joint, packet.frame, self._memory)
        self._correct_by_landmarks(packet.frame, gate)
        self._tracks.add_frame(_without_landmarks(packet.frame, self._joint))
        leaving = self._clone_t_ns < packet.frame.t_ns - self._lag_ns
        self._correct_by_tracks(leaving, gate)
        self._correct_by_bridge(packet)
        self._noise.learn(packet.frame.t_ns, predicted, self._joint.core)
        self._forget_clones(leaving)
        now = self._in_view.corrected(self._joint, self._tracks.unused(), self._correlation.share)
        if self.bridge is not None:
            self.bridge.learn(now.T_world_imu)
        return now.estimate(packet.frame.t_ns, **gate.info(), **self._noise.info)

    def landmarks(self) -> Landmarks:
        """Return the last estimate of every landmark that was ever triangulated."""
        self._memory.remember(self._joint.landmark_ids, self._joint.points)
        return self._memory.landmarks()

    def log(self) -> tuple[str, ...]:
        """Return the log lines for the user."""
        return self._noise.messages + self._correlation.messages + self._landmark_correlation.messages

    def _correct_by_landmarks(self, frame: StereoFrame, gate: FrameGate) -> None:
        gate.share = self._landmark_correlation.share
        if isinstance(self._joint, TrackErrorBelief):
            track_error_states.correct(self._joint, frame, self._at, self._rig, gate)
            joint_landmarks.forget(self._joint, track_error_states.implausible_errors(self._joint, gate), self._memory)
        else:
            joint_landmarks.correct(self._joint, frame, self._at, self._rig, gate, self._images)
        joint = self._joint
        if self._most_landmarks:
            self._landmark_correlation.learn_frame(
                frame, joint.landmark_ids, joint.points, joint.clones[-1], self._images
            )

    def _correct_by_tracks(self, leaving: BoolArray, gate: FrameGate) -> None:
        """Correct by the tracks that have ended, and by those seen from poses (C,) that leave the window now.

        Both together, unless there is room for landmarks. A new landmark's linearisation point stays, so it is
        triangulated after the ended tracks have corrected the window.
        """
        gate.share, used = self._correlation.share, self._tracks.ended()
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
        track_gate = TrackGate(joint, self._at, self._rig, self._track_test, self._images)
        accepted = track_gate.accepted(sightings, gate)
        if not len(accepted.points):
            return
        self._memory.remember(accepted.sightings.track_ids, accepted.points)
        kept = np.flatnonzero(accepted.sightings.seen[:, -1])[: self._room]
        if len(kept):
            self._add_landmarks(
                accepted.sightings.select(kept), accepted.points[kept], track_gate.linearised(accepted, kept)
            )
        first = 6 * int(np.argmax(accepted.sightings.seen.any(axis=0)))
        self._update(accepted.H[:, first:], accepted.residuals)
        self._learn(self._correlation, accepted.sightings, accepted.points, joint.clones, self._rig)

    def _update(self, H: Array, residuals: Array) -> None:
        """Correct the whole state by whitened residuals (m,) with Jacobian (m, k) to the newest clones."""
        joint, (count, size) = self._joint, H.shape
        end = joint.clone_columns.stop
        if count > size and end == joint.cov.shape[0]:
            joint.inform(H.T @ H, H.T @ residuals)
            return
        # With landmarks after the clones in the error state, an update by fewer rows is cheaper.
        joint.update(*multiview.compressed(H, residuals), slice(end - size, end))

    def _correct_by_bridge(self, packet: Packet) -> None:
        """Correct the last three poses where no track links one of them to the next."""
        if self.bridge is None:
            return
        kept, joint = self.bridge.added(packet.frame, packet.motion), self._joint
        if kept is not None:
            H = kept.derivatives(self._at.clones(joint)[-3:]) / kept.sigmas[:, None]
            residual = -kept.change(joint.clones[-3:]) / kept.sigmas
            end = joint.clone_columns.stop
            joint.update(H, residual, slice(end - H.shape[1], end))

    def _add_landmarks(self, sightings: TrackSightings, points: Array, linearised: Linearised) -> None:
        if isinstance(self._joint, TrackErrorBelief):
            track_error_states.add_tracks(self._joint, sightings, points, linearised)
        else:
            joint_landmarks.add_tracks(self._joint, sightings.track_ids, points, linearised)

    def _forget_clones(self, which: BoolArray) -> None:
        """Marginalise poses (C,), which are the oldest."""
        if which.any():
            for T_world_imu in self._joint.clones[which]:
                frame = self._frames.popleft()
                if self._scores_tracks:
                    self._correlation.settle(frame, T_world_imu)
            self._joint.forget_clones(which)
            self._tracks.drop_oldest(int(which.sum()))
            self._clone_t_ns = self._clone_t_ns[~which]


class WindowTracks:
    """The tracks not yet used: sightings of A tracks from the W poses of the window, one column per clone."""

    def __init__(self) -> None:
        self._ids: IntArray = np.empty(0, dtype=np.int64)
        self._uvs_px = np.empty((0, 0, 3))
        self._seen = np.empty((0, 0), dtype=bool)
        self._ages: IntArray = np.empty((0, 0), dtype=np.int64)

    def add_frame(self, frame: StereoFrame) -> None:
        """Append the frame's sightings as a new column; ids unknown so far start new tracks."""
        order = np.argsort(self._ids)
        at, known = rows_of(frame.track_ids, self._ids[order])
        new = frame.track_ids[~known]
        before, count, window = len(self._ids), len(self._ids) + len(new), self._seen.shape[1] + 1
        rows = np.empty(len(known), dtype=np.int64)
        rows[known], rows[~known] = order[at[known]], np.arange(before, count)
        uvs_px, seen = np.zeros((count, window, 3)), np.zeros((count, window), dtype=bool)
        ages = np.zeros((count, window), dtype=np.int64)
        uvs_px[:before, :-1], seen[:before, :-1], ages[:before, :-1] = self._uvs_px, self._seen, self._ages
        uvs_px[rows, -1], seen[rows, -1], ages[rows, -1] = frame.uvs_px, True, frame.ages
        self._ids, self._uvs_px, self._seen, self._ages = np.concatenate([self._ids, new]), uvs_px, seen, ages

    def drop_oldest(self, count: int) -> None:
        """Drop the sightings from the ``count`` oldest poses."""
        self._uvs_px, self._seen, self._ages = self._uvs_px[:, count:], self._seen[:, count:], self._ages[:, count:]
        self._keep(np.asarray(self._seen.any(axis=1)))

    def ended(self) -> BoolArray:
        """Say which tracks (A,) the newest pose does not see."""
        return np.asarray(~self._seen[:, -1])

    def seen_by(self, which: BoolArray) -> BoolArray:
        """Say which tracks (A,) any of some poses (W,) has seen."""
        return np.asarray(self._seen[:, which].any(axis=1))

    def unused(self) -> TrackSightings:
        """Return the sightings of all A tracks."""
        return TrackSightings(self._ids, self._uvs_px, self._seen, self._ages)

    def take(self, rows: BoolArray) -> TrackSightings:
        """Return those tracks (A,) and drop their sightings; a track that is still seen starts again."""
        tracks = self.unused()
        self._keep(np.logical_not(rows))
        return tracks.select(rows)

    def _keep(self, rows: BoolArray) -> None:
        self._ids, self._uvs_px, self._seen, self._ages = self.unused().select(rows)


def _joint_belief(core: Belief, noise: TrackNoise | None) -> JointBelief:
    return JointBelief(core) if noise is None else TrackErrorBelief(core, noise)


def _without_landmarks(frame: StereoFrame, joint: JointBelief) -> StereoFrame:
    """Return the frame without the sightings of landmarks in the state."""
    if not len(joint.landmark_ids):
        return frame
    return frame.select(~is_among(frame.track_ids, joint.landmark_ids))
