"""The report's decoupled EKF made sound: gates, landmark noise in the innovation, biases (Kang, III-C).

What it approximates: pose and landmarks are kept as if they were independent. A frame then costs a constant time per
landmark, but the filter is overconfident: its covariance does not grow with the distance driven.
"""

from filters.kalman.correction import corrected
from filters.kalman.frame_gate import FrameGate
from filters.kalman.landmark_map import TrackedMap
from filters.kalman.online_output import Filter, OnlineOutput
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Estimator, Setup
from toolkit.models.motion import motion_model, predicted
from toolkit.sequence import Packet

CITES = ("kang_vislam",)
RUNG, CHANGE = 20, "+ gate and loss, biases; pose before map, each with the other's uncertainty as noise"
DEFAULT = True


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return OnlineOutput(DecoupledEkf(setup))


class DecoupledEkf(Filter):
    """Predict, correct the pose by the known landmarks, correct the landmarks, start new ones, drop lost ones."""

    def __init__(self, setup: Setup) -> None:
        self._rig, self._outliers = setup.rig, setup.settings.outliers
        self._motion = motion_model(setup.noise, setup.gravity_world)
        self._belief = self._motion.initial_belief(setup.prior)
        self._map = TrackedMap(setup.rig)

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and return the state at its frame."""
        self._belief = predicted(self._belief, self._motion, packet.motion)
        seen, uvs_px = self._map.seen_again(packet.frame)
        gate = FrameGate(self._outliers.gate_probability, self._outliers.filter_huber)
        if len(seen):
            self._belief, seen = corrected(self._belief, seen, uvs_px, self._rig, gate)
        self._map.keep(seen, packet.frame, self._belief.T_world_imu)
        return self._belief.estimate(packet.frame.t_ns, **gate.info())

    def landmarks(self) -> Landmarks:
        """Return every landmark the filter ever had, as it last knew it."""
        return self._map.landmarks()
