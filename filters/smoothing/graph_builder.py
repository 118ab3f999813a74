"""What one packet adds to an incremental smoother's graph: new factors, initial values, and the variables involved.

Sightings of tracks that have jumped to another point are left out. With odometry, and with a track noise model, the
initial value of a new state is the pose that best fits its sightings of known landmarks, not the prediction by the
measured motion alone. The prediction may be off by many sigmas of a sighting's innovation, and linearised there the
loss would give every sighting the weight of an outlier.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import gtsam
import msgspec
import numpy as np

from filters.kalman.motion_noise import MatchedNoise
from filters.smoothing.discounted_tracks import DiscountedTracks, discounted_past, seen_often
from filters.smoothing.known_landmarks import KnownLandmarks
from filters.smoothing.outlier_check import OutlierCheck, RefusedTracks, relative_to_its_map
from toolkit.estimate import Estimate
from toolkit.estimator import Setup
from toolkit.geometry import Array, BoolArray
from toolkit.models import stereo
from toolkit.models.factors import L, StereoFactors, huber_loss
from toolkit.models.gap_bridge import gap_bridge_for, kept_twist
from toolkit.models.gating import LEAST_DISPARITY_PX
from toolkit.models.motion import MotionModel, motion_model
from toolkit.models.state import Belief
from toolkit.sequence import Packet, StereoFrame

# A frame's residuals are used for the weight of tracks once this many frames have followed: its landmarks are then
# seen from enough poses.
LEARNT_AFTER_FRAMES = 5
# The largest ratio between the weight of sightings in the graph and their present weight, or its inverse.
_MOST_OUTDATED = 1.25


@dataclass
class GraphExtension:
    """New factors and values, and every state and landmark they involve.

    ``chained`` is the frame and its number if the errors of its sightings are correlated with earlier ones; the
    smoother then makes their factors itself.
    """

    factors: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    values: gtsam.Values = field(default_factory=gtsam.Values)
    state_keys: list[int] = field(default_factory=list)
    landmark_ids: list[int] = field(default_factory=list)
    chained: tuple[StereoFrame, int] | None = None


class GraphBuilder:
    """Turns packets into additions to a graph; remembers which landmarks the graph has."""

    def __init__(self, setup: Setup) -> None:
        self._rig, outliers = setup.rig, setup.settings.outliers
        self._tracks, self._used = DiscountedTracks(setup), dict[int, StereoFrame]()
        self._stereo, self._share = StereoFactors(setup.rig, huber_loss(outliers.smoother_huber)), 1.0
        # The weight of the oldest sightings in the graph, and whether all others have the same weight.
        self._share_in_graph, self._count_alike = 1.0, True
        # With a track noise model, a sighting's innovation is tested by the filters' gate, not a multiple of it.
        if setup.rig.track_noise is not None:
            outliers = msgspec.structs.replace(outliers, smoother_gate_factor=1.0)
        self._outlier_check = OutlierCheck(setup.rig, outliers)
        # An IMU's prediction keeps pose and velocity consistent, and is near enough for tracks with white noise.
        self._begins_there = setup.motion_kind != "imu" or setup.rig.track_noise is not None
        self._bridge = None
        if setup.settings.noise.bridge_gaps:
            self._bridge = gap_bridge_for(setup.noise, setup.settings.window.seconds(setup.motion_kind))
        self._refused_tracks = RefusedTracks(setup.rig, outliers.gate_probability)
        self._refused: tuple[StereoFrame, BoolArray] | None = None
        self._landmarks = KnownLandmarks(setup.rig)
        self.motion: MotionModel = motion_model(setup.noise, setup.gravity_world)
        self.belief: Belief = self.motion.initial_belief(setup.prior)
        self._noise, self._predicted = MatchedNoise.of(setup), self.belief

    def extend(self, packet: Packet) -> GraphExtension:
        """Return what a packet adds; the new state is predicted from the latest one."""
        extension = GraphExtension()
        expected = self._add_state(self._noise.applied(packet), extension)
        there, sound = self._outlier_check.placed(expected, packet.frame, self._landmarks, self._tracks.share)
        if self._begins_there:
            self.belief = replace(self.belief, T_world_imu=there.T_world_imu)
        self._refused = packet.frame, ~np.isin(packet.frame.track_ids, sound.track_ids)
        self._add_values(packet, extension)
        self._add_sightings(sound, packet.index, extension)
        if self._bridge is not None:
            kept = self._bridge.added(sound, packet.motion)
            if kept is not None:
                extension.factors.add(kept_twist(kept, packet.index))
        return extension

    def update(self, newest: Estimate, points: Mapping[int, Array]) -> None:
        """Take the smoother's newest state and landmarks (3,) m after a packet."""
        self.belief = self.belief.at(newest)
        self._noise.learn(newest.t_ns, self._predicted, self.belief)
        if self._bridge is not None:
            self._bridge.learn(newest.T_world_imu)
        self._landmarks.move(points)

    def learn(self, k: int, T_world_imu: Array) -> None:
        """Use frame k for the weight of tracks; ``T_world_imu`` (2, 4, 4) are present poses of frames k and k + 1."""
        known = self._landmarks.points
        points = {i: known[i] for i in seen_often(self._used.values()) if i in known}
        self._tracks.learn([self._used.pop(k), self._used[k + 1]], T_world_imu, points)

    def learn_from_all(self, frames: list[StereoFrame], T_world_imu: Array, points: Mapping[int, Array]) -> bool:
        """Use all sightings in the graph for the weight of tracks, at the final poses (K, 4, 4) and points (3,) m.

        Return whether it fell. Of the weight measured during the run and this one, the smaller holds: each misses some
        of the correlation, the first because few sightings have determined a landmark yet.
        """
        points = {i: points[i] for i in seen_often(frames) if i in points}
        anew = self._tracks.relearned(frames, T_world_imu, points)
        fell = anew.share < self._tracks.share
        if fell:
            self._tracks = anew
        return fell

    @property
    def is_outdated(self) -> bool:
        """Say whether the weight of sightings in the graph differs much from their present weight."""
        return not 1.0 / _MOST_OUTDATED < self._tracks.share / self._share_in_graph < _MOST_OUTDATED

    def brought_up_to_date(self, graph: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
        """Return the graph with all sightings at their present weight; other factors are unchanged."""
        if self._count_alike and self._tracks.share == self._share_in_graph:
            return graph
        factors = self._factors()
        self._share_in_graph, self._count_alike = self._share, True
        return factors.remade(graph)

    @property
    def info(self) -> dict[str, float]:
        """Return the noise scale of the newest prediction, under its key in an Estimate's info."""
        return self._noise.info

    def window_brought_up_to_date(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values
    ) -> gtsam.NonlinearFactorGraph:
        """Return a window's graph with all sightings at their present weight; ``values`` has all its variables.

        If the weight has fallen, the landmarks' part of the marginals is reduced by the same factor. Otherwise old
        landmarks would be too certain and would outweigh new ones, and the poses between them.
        """
        before = self._share_in_graph
        graph = self.brought_up_to_date(graph)
        fallen = self._share_in_graph / before
        return discounted_past(graph, values, fallen) if fallen < 1.0 else graph

    def log(self) -> tuple[str, ...]:
        """Return the log lines about motion noise and tracks."""
        return self._noise.messages + self._tracks.messages

    def contradicted(self) -> set[int]:
        """Return the landmarks to drop after a packet, because later sightings of their tracks contradict them."""
        assert self._refused is not None
        return self._refused_tracks.contradicted(*self._refused, self.belief.T_world_imu)

    def forget(self, landmark_ids: set[int]) -> None:
        """Drop landmarks that have left the graph; if seen again, they are started again."""
        self._refused_tracks.forget(landmark_ids)
        self._landmarks.forget(landmark_ids)

    def _add_state(self, packet: Packet, extension: GraphExtension) -> Belief:
        """Add the new state; return its prediction with the covariance relative to the map."""
        expected = relative_to_its_map(self.belief)
        if packet.motion is None:
            extension.factors.push_back(self.motion.hold(self.belief, packet.index))
        else:
            increment = self.motion.integrate(packet.motion, self.belief.bias)
            prediction = increment.predict(self.belief)
            self.belief, expected = self.belief.predicted(prediction), expected.predicted(prediction)
            self._predicted = self.belief
            extension.factors.push_back(increment.factors(packet.index))
        return expected

    def _add_values(self, packet: Packet, extension: GraphExtension) -> None:
        self.motion.insert(extension.values, self.belief.estimate(packet.frame.t_ns), packet.index)
        extension.state_keys = list(extension.values.keys())

    def _add_sightings(self, frame: StereoFrame, k: int, extension: GraphExtension) -> None:
        near = stereo.disparity_px(frame.uvs_px) > LEAST_DISPARITY_PX
        known = self._landmarks.among(frame.track_ids.tolist())
        used = frame.select(known | near)
        new = frame.select(~known & near)
        points = stereo.triangulate_world(new.uvs_px, self.belief.T_world_imu, self._rig)
        placed = dict(zip(new.track_ids.tolist(), points, strict=True))
        for track_id, point in placed.items():
            extension.values.insert(L(track_id), point)
        if self._rig.track_noise is not None:
            extension.chained = used, k
        else:
            for factor in self._factors().of(used, k):
                extension.factors.add(factor)
        self._used[k] = used
        extension.landmark_ids = used.track_ids.tolist()
        self._landmarks.see(used, placed, self.belief.T_world_imu, self._tracks.share)

    def _factors(self) -> StereoFactors:
        """Return the maker of stereo factors at the present weight of sightings."""
        if self._share != self._tracks.share:
            rig, huber = self._tracks.now
            self._stereo, self._share = StereoFactors(rig, huber_loss(huber)), self._tracks.share
            self._count_alike = False
        return self._stereo
