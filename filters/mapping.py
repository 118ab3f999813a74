"""Landmarks, each with a small EKF of its own, along the dead-reckoned trajectory; the pose is never corrected.

Source: Kang, III-B. The report has no gate; here a sighting outside the gate of the outlier policy corrects nothing.
"""

from filters.kalman.landmark_map import KnownPoseMapper
from filters.kalman.online_output import Filter, OnlineOutput
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Estimator, Setup
from toolkit.measurements import Packet
from toolkit.models.state import predicted

CITES = ("kang_vislam",)


def build(setup: Setup) -> Estimator:
    return OnlineOutput(Mapping(setup))


class Mapping(Filter):
    """Takes the predicted pose as exact and corrects every landmark by its sightings from it (Kang, eqs. 3-10)."""

    def __init__(self, setup: Setup) -> None:
        self._motion = setup.motion
        self._belief = self._motion.initial_belief(setup.prior)
        self._map = KnownPoseMapper(setup.rig, setup.settings.outliers.gate_probability)

    def step(self, packet: Packet) -> Estimate:
        self._belief = predicted(self._belief, self._motion, packet.motion)
        self._map.add(packet.frame, self._belief.T_world_imu)
        return self._belief.estimate(packet.frame.t_ns)

    def landmarks(self) -> Landmarks:
        return self._map.landmarks()
