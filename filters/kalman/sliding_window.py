"""The multi-state constraint Kalman filter: a window of cloned poses, tied by tracks whose landmarks are eliminated.

What it approximates: a track speaks once, when it ends or spans the window, and poses that left the window are
never corrected again (Mourikis & Roumeliotis 2007). With ``landmarks`` the tracks that span the window stay in
the state, up to that many, for as long as they are seen (Li & Mourikis 2013, "Optimization-based estimator
design for vision-aided inertial navigation").
"""

from dataclasses import dataclass

import numpy as np

from filters.kalman import joint_landmarks, multiview
from filters.kalman.diagnostics import Innovation, LandmarkMemory
from filters.kalman.joint import JointBelief
from filters.kalman.linearisation import Linearisation, propagate
from filters.kalman.multiview import Constraints, Sightings
from filters.kalman.track_gate import FEWEST_SIGHTINGS, TrackGate
from filters.kalman.tracks import WindowTracks
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Setup
from toolkit.geometry import Array
from toolkit.models.motion import motion_model
from toolkit.sequence import Packet, StereoFrame

# An IMU ties poses over a second so well that tracks may take as long to speak. A measured twist is a
# hundred times looser: a track that waits lets the pose run off, and its linearisation with it.
CLONES = {"imu": 12, "twist": 5}


@dataclass(frozen=True)
class WindowSize:
    """How many past poses are kept and how many long-lived landmarks."""

    clones: int
    landmarks: int = 0


class SlidingWindowFilter:
    """Propagate, clone, correct by landmarks and by finished tracks, drop the oldest pose."""

    def __init__(self, setup: Setup, linearisation: Linearisation, size: WindowSize) -> None:
        self._rig, self._size, self._at = setup.rig, size, linearisation
        self._motion = motion_model(setup.noise, setup.gravity_world)
        self._joint = JointBelief(self._motion.initial_belief(setup.prior))
        self._tracks = WindowTracks()
        self._memory = LandmarkMemory()

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and say where the IMU is."""
        if packet.motion is not None:
            propagate(self._joint, self._motion, self._at, packet.motion)
        self._joint.clone(packet.index)
        innovation = Innovation()
        joint_landmarks.forget_lost(self._joint, packet.frame, self._memory)
        joint_landmarks.correct(self._joint, packet.frame, self._at, self._rig, innovation)
        self._tracks.add_frame(_without(packet.frame, self._joint))
        self._correct_by_tracks(innovation)
        if len(self._joint.clones) > self._size.clones:
            self._forget_oldest_clone()
        return self._joint.core.estimate(packet.frame.t_ns, **innovation.info())

    def landmarks(self) -> Landmarks:
        """Return every landmark that was ever triangulated, as last known."""
        self._memory.remember(self._joint.landmark_ids, self._joint.points)
        return self._memory.landmarks()

    def _correct_by_tracks(self, innovation: Innovation) -> None:
        """Let the tracks that ended speak, and those that span a full window, for its oldest pose leaves next.

        All at once, unless there is room for landmarks: what a landmark is linearised at for life is triangulated
        after the window has been corrected by the others.
        """
        speaking = self._tracks.ended()
        full = len(self._joint.clones) > self._size.clones
        if full and not self._room:
            speaking = speaking | self._tracks.spanning()
        self._speak(self._tracks.take(speaking), innovation)
        if full and self._room:
            self._speak(self._tracks.take(self._tracks.spanning()), innovation)

    @property
    def _room(self) -> int:
        return max(self._size.landmarks - len(self._joint.landmark_ids), 0)

    def _speak(self, sightings: Sightings, innovation: Innovation) -> None:
        """Correct the window by tracks; keep as many of those still seen as landmarks as there is room for."""
        joint = self._joint
        sightings = sightings.select(sightings.seen.sum(axis=1) >= FEWEST_SIGHTINGS)
        heard = TrackGate(joint, self._at, self._rig).passed(sightings, innovation)
        if not len(heard.points):
            return
        self._memory.remember(heard.track_ids, heard.points)
        kept = heard.select(np.flatnonzero(heard.seen[:, -1])[: self._room])
        if len(kept.points):
            joint_landmarks.keep(joint, kept.track_ids, kept.points, kept.linearised)
        H, residuals = multiview.compressed(*_stacked(heard.said))
        joint.update(H, residuals, joint.clone_columns)

    def _forget_oldest_clone(self) -> None:
        self._joint.forget_clones(np.arange(len(self._joint.clones)) == 0)
        self._tracks.drop_column(0)


def _without(frame: StereoFrame, joint: JointBelief) -> StereoFrame:
    """Return the frame without the sightings of the state's landmarks."""
    rows = ~np.isin(frame.track_ids, joint.landmark_ids)
    return StereoFrame(frame.t_ns, frame.track_ids[rows], frame.uvs_px[rows])


def _stacked(said: Constraints) -> tuple[Array, Array]:
    """Return the rows of all tracks that say anything, under each other."""
    H = said.H.reshape(-1, said.H.shape[2])
    speaks = H.any(axis=1)
    return H[speaks], said.residuals.reshape(-1)[speaks]
