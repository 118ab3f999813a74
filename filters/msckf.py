"""Sliding window of cloned poses tied by tracks (Mourikis & Roumeliotis 2007).

What it approximates: a track corrects once, when it ends or the oldest pose that saw it leaves, and poses that have
left the window are never corrected again. The answer at a frame is the state given also the tracks still in view; these
do not correct the belief itself (:mod:`filters.kalman.tracks`). A pose leaves once it is older than the window, as a
state does in the smoothers.

`msckf-fej` and `msckf-slam` are this filter with other options: Jacobians at first estimates, and landmarks that stay.
"""

from bisect import bisect_left
from collections.abc import Callable

import numpy as np

from filters.kalman.joint import (
    AtLatestEstimates,
    JointBelief,
    Linearisation,
    correct_by_landmarks,
    marginalise_lost,
    propagate,
)
from filters.kalman.online_output import LandmarkMemory, OnlineOutput
from filters.kalman.thinning import Thinned
from filters.kalman.tracks import (
    TrackSightings,
    WindowPoses,
    WindowTracks,
    eliminated_tracks,
    given_tracks_in_view,
    load_kernels,
)
from toolkit.arrays import is_among
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Estimator, Setup
from toolkit.measurements import NS_PER_S, Packet
from toolkit.models.gating import FrameGate
from toolkit.models.state import Belief

CITES = ("mourikis2007msckf",)
RUNG, CHANGE = 60, "+ past poses; one update a track, at its end; usual errors, one step"
INGREDIENTS = ("landmark uncertainty", "biases", "cross-covariances", "past poses")
WITHOUT = {"biases": {"noise.biases": "fixed"}}


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return estimator(setup, AtLatestEstimates())


def estimator(
    setup: Setup, at: Linearisation, landmarks: int = 0, belief: Callable[[Belief], JointBelief] = JointBelief
) -> Estimator:
    """Return the filter of a linearisation and a number of landmarks, with states as sparse as the window demands."""
    msckf = Msckf(setup, at, landmarks, belief=belief)
    return Thinned(setup, OnlineOutput(msckf, msckf.log))


class Msckf:
    """Propagate, clone, correct by landmarks and by finished tracks, drop old poses; answer given all in view.

    Up to ``landmarks`` tracks that span the window are kept in the state for as long as they are seen (Li & Mourikis
    2013, "Optimization-based estimator design for vision-aided inertial navigation"); ``belief`` decides in which
    coordinates landmarks move.
    """

    def __init__(
        self, setup: Setup, at: Linearisation, landmarks: int = 0, belief: Callable[[Belief], JointBelief] = JointBelief
    ) -> None:
        self.log = load_kernels(setup.progress)
        self._rig, self._at, self._outliers = setup.rig, at, setup.settings.outliers
        self._motion = setup.motion
        window_s = setup.settings.window.seconds(setup.motion_kind)
        self._lag_ns, self._most_landmarks = round(window_s * NS_PER_S), landmarks
        self._clone_t_ns: list[int] = []
        self._joint = belief(self._motion.initial_belief(setup.prior))
        self._tracks, self._memory = WindowTracks(), LandmarkMemory()

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and return the state at its frame."""
        frame, outliers = packet.frame, self._outliers
        propagate(self._joint, self._motion, self._at, packet.motion)
        self._joint.clone()
        self._clone_t_ns.append(frame.t_ns)
        gate = FrameGate(outliers.gate_probability, outliers.joint_huber, self._rig.track_weight)
        marginalise_lost(self._joint, frame, self._memory)
        correct_by_landmarks(self._joint, frame, self._at, self._rig, gate)
        if len(self._joint.landmark_ids):
            frame = frame.select(~is_among(frame.track_ids, self._joint.landmark_ids))
        self._tracks.add_frame(frame)
        leaving = bisect_left(self._clone_t_ns, frame.t_ns - self._lag_ns)
        self._correct_by_tracks(leaving, gate)
        if leaving:
            self._joint.marginalise_clones(leaving)
            self._tracks.drop_oldest(leaving)
            del self._clone_t_ns[:leaving]
        gate_in_view = FrameGate(outliers.gate_probability, outliers.joint_huber)
        now = given_tracks_in_view(self._joint, self._window(), self._tracks, self._rig, gate_in_view)
        return now.estimate(frame.t_ns, **gate.info())

    def landmarks(self) -> Landmarks:
        """Return the last estimate of every landmark that was ever triangulated."""
        self._memory.remember(self._joint.landmark_ids, self._joint.points)
        return self._memory.landmarks()

    def _window(self) -> WindowPoses:
        columns = self._joint.clone_columns
        return WindowPoses(self._joint.clones, self._at.clones(self._joint), self._joint.cov[columns, columns])

    def _correct_by_tracks(self, leaving: int, gate: FrameGate) -> None:
        """Correct by the tracks that have ended, and by those seen from the oldest poses, which leave the window now.

        Both together, unless there is room for landmarks. A new landmark's linearisation point stays, so it is
        triangulated after the ended tracks have corrected the window.
        """
        used = self._tracks.ended()
        if not self._room:
            used = used | self._tracks.seen_by_oldest(leaving)
        self._correct_by(self._tracks.take(used), gate)
        if self._room and leaving:
            self._correct_by(self._tracks.take(self._tracks.seen_by_oldest(leaving)), gate)

    @property
    def _room(self) -> int:
        return max(self._most_landmarks - len(self._joint.landmark_ids), 0)

    def _correct_by(self, sightings: TrackSightings, gate: FrameGate) -> None:
        """Correct the window by tracks; add those still seen as landmarks, as many as there is room for."""
        found = eliminated_tracks(sightings, self._window(), self._rig, gate)
        if not len(found.points):
            return
        self._memory.remember(found.track_ids, found.points)
        kept = np.flatnonzero(found.seen[:, -1])[: self._room]
        if len(kept):
            self._joint.add_landmarks(*found.landmarks(kept))
        first = int(np.argmax(found.seen.any(axis=0)))
        taken = found.halves[:, :, 6 * first :].reshape(-1, found.halves.shape[2] - 6 * first)
        self._joint.inform(found.blocks[first:], taken, found.vector[6 * first :])
