"""The decoupled visual-inertial EKF of the report made sound: pose first, then each landmark by itself.

What it approximates: pose and landmarks are kept as if independent. A frame then costs a constant time per
landmark, and the filter is too sure of itself: its covariance does not grow with the distance driven.
"""

import numpy as np

from filters.kalman.correction import correct_landmarks_gated, correct_pose
from filters.kalman.diagnostics import Innovation
from filters.kalman.landmarks import TrackedMap
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Setup
from toolkit.models.motion import motion_model, predicted
from toolkit.models.state import POSE
from toolkit.sequence import Packet


class DecoupledEkf:
    """Predict, correct the pose by the known landmarks, correct the landmarks, start new ones, forget lost ones."""

    def __init__(self, setup: Setup) -> None:
        self._rig = setup.rig
        self._motion = motion_model(setup.noise, setup.gravity_world)
        self._belief = self._motion.initial_belief(setup.prior)
        self._map = TrackedMap(setup.rig)

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and say where the IMU is."""
        self._belief = predicted(self._belief, self._motion, packet.motion)
        seen, uvs_px = self._map.seen_again(packet.frame)
        innovation = Innovation()
        if len(seen):
            self._belief, accepted, nis = correct_pose(self._belief, seen, uvs_px, self._rig)
            innovation.add(nis, np.full(len(seen), 3), accepted)
            pose, pose_cov = self._belief.T_world_imu, self._belief.cov[POSE, POSE]
            seen = correct_landmarks_gated(seen, uvs_px, pose, pose_cov, self._rig, accepted)
        self._map.keep(seen, packet.frame, self._belief.T_world_imu)
        return self._belief.estimate(packet.frame.t_ns, **innovation.info())

    def landmarks(self) -> Landmarks:
        """Return every landmark the filter ever had, as it last knew it."""
        return self._map.landmarks()
