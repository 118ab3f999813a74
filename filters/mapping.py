"""Landmarks, each with a small EKF of its own, along the dead-reckoned trajectory; the pose is never corrected.

Source: Kang, III-B.
"""

import numpy as np

from filters.kalman.correction import correct_landmarks_below
from filters.kalman.landmark_map import TrackedMap
from filters.kalman.online_output import Filter, OnlineOutput
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Estimator, Setup
from toolkit.measurements import Packet
from toolkit.models import stereo
from toolkit.models.gating import chi2_bound
from toolkit.models.motion import motion_model, predicted

CITES = ("kang_vislam",)


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return OnlineOutput(Mapping(setup))


class Mapping(Filter):
    """Takes the predicted pose as exact and corrects every landmark by its sightings from it (Kang, eqs. 3-10).

    The report has no gate; here a sighting outside the gate of the outlier policy corrects nothing.
    """

    def __init__(self, setup: Setup) -> None:
        self._rig = setup.rig
        self._motion = motion_model(setup.noise, setup.gravity_world)
        self._belief = self._motion.initial_belief(setup.prior)
        self._map = TrackedMap(setup.rig)
        self._gate_probability = setup.settings.outliers.gate_probability

    def step(self, packet: Packet) -> Estimate:
        """Integrate the motion, then map from the pose it leads to."""
        self._belief = predicted(self._belief, self._motion, packet.motion)
        T_world_imu = self._belief.T_world_imu
        seen, uvs_px = self._map.seen_again(packet.frame)
        if len(seen):
            nis_bound = chi2_bound(stereo.degrees_of_freedom(uvs_px), self._gate_probability)
            seen = correct_landmarks_below(seen, uvs_px, T_world_imu, np.zeros((6, 6)), self._rig, nis_bound)
        self._map.keep(seen, packet.frame, T_world_imu)
        return self._belief.estimate(packet.frame.t_ns)

    def landmarks(self) -> Landmarks:
        """Return the last estimate of every landmark of the run."""
        return self._map.landmarks()
