"""How an incremental smoother's graph grows by one packet: new factors, first values, and what they concern.

Sightings of tracks that have gone over to another point are left out.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np

from filters.smoothing.outlier_check import OutlierCheck, relative_to_its_map
from toolkit.estimate import Estimate
from toolkit.estimator import Setup
from toolkit.geometry import Array
from toolkit.models import stereo
from toolkit.models.factors import L, StereoFactors
from toolkit.models.gating import LEAST_DISPARITY_PX
from toolkit.models.motion import MotionModel, motion_model
from toolkit.models.state import Belief
from toolkit.sequence import Packet, StereoFrame


@dataclass
class Grown:
    """New factors and values, and the keys of every state and landmark they concern."""

    factors: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    values: gtsam.Values = field(default_factory=gtsam.Values)
    state_keys: list[int] = field(default_factory=list)
    landmark_ids: list[int] = field(default_factory=list)


class Growth:
    """Turns packets into what they add to a graph; remembers which landmarks the graph has."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._outliers = setup.settings.outliers
        huber = gtsam.noiseModel.mEstimator.Huber.Create(self._outliers.smoother_huber)
        self._stereo = StereoFactors(setup.rig, huber)
        self._points: dict[int, Array] = {}
        self.motion: MotionModel = motion_model(setup.noise, setup.gravity_world)
        self.belief: Belief = self.motion.initial_belief(setup.prior)

    def by(self, packet: Packet) -> Grown:
        """Return what a packet adds, the new state being predicted from the latest known."""
        grown = Grown()
        expected = self._add_state(packet, grown)
        check = OutlierCheck(self._setup.rig, self._outliers.gate_probability)
        self._add_sightings(check.without_outliers(packet.frame, self._points, expected), packet.index, grown)
        return grown

    def solved(self, newest: Estimate, points: Mapping[int, Array]) -> None:
        """Take note of the newest state and of landmarks (3,) m as the smoother has them after a packet."""
        self.belief = self.belief.at(newest)
        self._points.update(points)

    def forget(self, landmark_ids: set[int]) -> None:
        """Take note that landmarks have left the graph; seen again, they start anew."""
        for i in landmark_ids:
            self._points.pop(i, None)

    def _add_state(self, packet: Packet, grown: Grown) -> Belief:
        """Add the new state; return it as expected against the map."""
        expected = relative_to_its_map(self.belief)
        if packet.motion is None:
            grown.factors.push_back(self.motion.hold(self.belief, packet.index))
        else:
            increment = self.motion.integrate(packet.motion, self.belief.bias)
            prediction = increment.predict(self.belief)
            self.belief, expected = self.belief.predicted(prediction), expected.predicted(prediction)
            grown.factors.push_back(increment.factors(packet.index))
        self._add_values(packet, grown)
        return expected

    def _add_values(self, packet: Packet, grown: Grown) -> None:
        self.motion.insert(grown.values, self.belief.estimate(packet.frame.t_ns), packet.index)
        grown.state_keys = list(grown.values.keys())

    def _add_sightings(self, frame: StereoFrame, k: int, grown: Grown) -> None:
        near = stereo.disparity_px(frame.uvs_px) > LEAST_DISPARITY_PX
        known = np.array([i in self._points for i in frame.track_ids.tolist()], dtype=bool)
        used = frame.select(known | near)
        new = frame.select(~known & near)
        points = stereo.triangulate_world(new.uvs_px, self.belief.T_world_imu, self._setup.rig)
        for track_id, point in zip(new.track_ids.tolist(), points, strict=True):
            grown.values.insert(L(track_id), point)
        for factor in self._stereo.of(used, k):
            grown.factors.add(factor)
        grown.landmark_ids = used.track_ids.tolist()
        self._points |= dict(zip(new.track_ids.tolist(), points, strict=True))
