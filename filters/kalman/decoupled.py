"""The decoupled visual-inertial EKF of the report made sound: pose first, then each landmark by itself.

What it approximates: pose and landmarks are kept as if independent. That makes a frame cost a constant time
per landmark, and makes the filter too sure of itself: its covariance does not grow with the distance driven.
"""

import numpy as np

from filters.kalman.belief import Belief, initial_belief
from filters.kalman.correction import correct_landmarks, correct_pose
from filters.kalman.landmarks import Archive, LandmarkMap, first_sighting
from filters.kalman.prediction import predictor
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Setup
from toolkit.sequence import Packet


class DecoupledEkf:
    """Predict, correct the pose by the known landmarks, correct the landmarks, start new ones, forget lost ones."""

    def __init__(self, setup: Setup) -> None:
        self._rig = setup.rig
        self._predict = predictor(setup)
        self._belief = initial_belief(setup.prior, setup.motion_kind)
        self._map = LandmarkMap.empty()
        self._archive = Archive()

    @property
    def belief(self) -> Belief:
        """Return what the filter believes of the IMU now."""
        return self._belief

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and say where the IMU is."""
        if packet.motion is not None:
            self._belief = self._predict(self._belief, packet.motion)
        frame = packet.frame
        slots, rows = self._map.match(frame.track_ids)
        seen, uvs_px = self._map.select(slots), frame.uvs_px[rows]
        self._archive.add(self._map.select(np.setdiff1d(np.arange(len(self._map)), slots, assume_unique=True)))
        nis, nis_dof = np.nan, 0
        if len(seen):
            self._belief, accepted, nis, nis_dof = correct_pose(self._belief, seen, uvs_px, self._rig)
            seen = self._corrected_map(seen, uvs_px, accepted)
        unseen = np.setdiff1d(np.arange(frame.track_ids.size), rows, assume_unique=True)
        self._map = seen.merged(first_sighting(frame, unseen, self._belief.T_world_imu, self._rig))
        return self._belief.estimate(frame.t_ns, nis=nis, nis_dof=nis_dof)

    def _corrected_map(self, seen: LandmarkMap, uvs_px: np.ndarray, accepted: np.ndarray) -> LandmarkMap:
        corrected = correct_landmarks(seen, uvs_px, self._belief, self._rig)
        return seen.corrected(accepted, corrected.points, corrected.covs)

    def landmarks(self) -> Landmarks:
        """Return every landmark the filter ever had, as it last knew it."""
        return self._archive.with_current(self._map)
