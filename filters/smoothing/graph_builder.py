"""What one packet adds to an incremental smoother's graph: new factors, initial values, and the variables involved.

Sightings of tracks that have jumped to another point are left out. With odometry, the initial value of a new state is
the pose that best fits its sightings of known landmarks, not the prediction by the measured motion alone. The
prediction may be off by many sigmas of a sighting's innovation, and linearised there the loss would give every sighting
the weight of an outlier.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np

from filters.smoothing.outlier_check import KnownLandmarks, OutlierCheck, RefusedTracks, relative_to_its_map
from toolkit.estimate import Estimate
from toolkit.estimator import Setup
from toolkit.geometry import Array, BoolArray, se3_inverse, transform
from toolkit.measurements import Packet, StereoFrame
from toolkit.models import stereo
from toolkit.models.factors import L, StereoFactors
from toolkit.models.gating import LEAST_DISPARITY_PX
from toolkit.models.graph_state import MotionModel
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief


@dataclass
class GraphExtension:
    """New factors and values, and every state and landmark they involve.

    ``motion`` are the factors that are no sightings, ``seen`` the sightings and ``stereo`` their factors, which are
    made when they are asked for.
    """

    motion: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    seen: StereoFrame | None = None
    stereo: Iterable[gtsam.NonlinearFactor] = ()
    values: gtsam.Values = field(default_factory=gtsam.Values)
    state_keys: list[int] = field(default_factory=list)
    landmark_ids: list[int] = field(default_factory=list)

    @cached_property
    def factors(self) -> gtsam.NonlinearFactorGraph:
        """All new factors."""
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(self.motion)
        for factor in self.stereo:
            graph.add(factor)
        return graph


class GraphBuilder:
    """Turns packets into additions to a graph; remembers which landmarks the graph has."""

    def __init__(self, setup: Setup) -> None:
        self._rig, outliers = setup.rig, setup.settings.outliers
        self._stereo = StereoFactors(setup.rig, outliers.smoother_huber)
        self._outlier_check = OutlierCheck(setup.rig, outliers)
        # An IMU's prediction keeps pose and velocity consistent, and is near enough.
        self._begins_there = setup.motion_kind != "imu"
        self._refused_tracks = RefusedTracks(setup.rig, outliers.gate_probability)
        self._refused: tuple[StereoFrame, BoolArray] | None = None
        self._landmarks = KnownLandmarks(setup.rig)
        self.motion: MotionModel = motion_model(setup.noise, setup.gravity_world)
        self.belief: Belief = self.motion.initial_belief(setup.prior)

    def extend(self, packet: Packet) -> GraphExtension:
        """Return what a packet adds; the new state is predicted from the latest one."""
        extension = GraphExtension()
        expected = self._add_state(packet, extension)
        there, sound = self._outlier_check.placed(expected, packet.frame, self._landmarks)
        if self._begins_there:
            self.belief = replace(self.belief, T_world_imu=there.T_world_imu)
        self._refused = packet.frame, ~np.isin(packet.frame.track_ids, sound.track_ids)
        self.motion.insert(extension.values, self.belief.estimate(packet.frame.t_ns), packet.index)
        extension.state_keys = list(extension.values.keys())
        self._add_sightings(sound, packet.index, extension)
        return extension

    def update(self, newest: Estimate, points: Mapping[int, Array]) -> None:
        """Take the smoother's newest state and landmarks (3,) m after a packet."""
        self.belief = self.belief.at(newest)
        self._landmarks.move(points)

    def to_drop(self, seen: Mapping[int, Array]) -> dict[int, str]:
        """Return which landmarks to drop after a packet, of which it has ``seen`` some at (3,) m, and why.

        Behind the camera a sighting has no gradient. Those that later sightings of their tracks contradict are dropped
        whether or not they are seen.
        """
        assert self._refused is not None
        points = np.array(list(seen.values())).reshape(-1, 3)
        _, depth_m = stereo.images(transform(se3_inverse(self.belief.T_world_imu), points), self._rig)
        behind = [i for i, m in zip(seen, depth_m.tolist(), strict=True) if m <= 0.0]
        why = dict.fromkeys(behind, "fell behind the camera")
        contradicted = self._refused_tracks.contradicted(*self._refused, self.belief.T_world_imu)
        return why | dict.fromkeys(contradicted, "was inconsistent with its next sightings")

    def forget(self, landmark_ids: set[int]) -> None:
        """Drop landmarks that have left the graph; if seen again, they are started again."""
        self._refused_tracks.forget(landmark_ids)
        self._landmarks.forget(landmark_ids)

    def _add_state(self, packet: Packet, extension: GraphExtension) -> Belief:
        """Add the new state; return its prediction with the covariance relative to the map."""
        expected = relative_to_its_map(self.belief)
        if packet.motion is None:
            extension.motion.push_back(self.motion.hold(self.belief, packet.index))
        else:
            increment = self.motion.integrate(packet.motion, self.belief.bias)
            prediction = increment.predict(self.belief)
            self.belief, expected = self.belief.predicted(prediction), expected.predicted(prediction)
            extension.motion.push_back(increment.factors(packet.index))
        return expected

    def _add_sightings(self, frame: StereoFrame, k: int, extension: GraphExtension) -> None:
        near = stereo.disparity_px(frame.uvs_px) > LEAST_DISPARITY_PX
        known = self._landmarks.among(frame.track_ids.tolist())
        used = frame.select(known | near)
        new = frame.select(~known & near)
        points = stereo.triangulate_world(new.uvs_px, self.belief.T_world_imu, self._rig)
        placed = dict(zip(new.track_ids.tolist(), points, strict=True))
        for track_id, point in placed.items():
            extension.values.insert(L(track_id), point)
        extension.seen, extension.stereo = used, self._stereo.of(used, k)
        extension.landmark_ids = used.track_ids.tolist()
        self._landmarks.see(used, placed, self.belief.T_world_imu)
