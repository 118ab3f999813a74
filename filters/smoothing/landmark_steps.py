"""Steps of landmarks, damped and taken in the image of the camera that first saw each of them.

The measurement depends on a far landmark's depth so nonlinearly that a step in metres overshoots, while the disparity
is nearly linear (Civera, Davison & Montiel 2008, "Inverse depth parametrization for monocular SLAM"). One such landmark
makes Levenberg's damping grow, which damps all poses as well; in the directions that tracks and motion determine the
least, the scale of the world and its drift, a solve then converges slowly. So landmarks alone are damped, each by a
share of the sightings' information on its own column, disparity and row (Marquardt 1963, "An algorithm for
least-squares estimation of nonlinear parameters"), and they are moved in these coordinates.
"""

from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.factors import L, X
from toolkit.models.stereo import CHANNELS

_FROM_CHANNELS = np.linalg.inv(CHANNELS)
# Largest growth of the logarithm of the depth in one step; it keeps disparities positive.
_MOST_FARTHER = 2.0


class LandmarksSeen(NamedTuple):
    """M landmarks L(track id), each in the image of the frame (M,) that first saw it.

    ``image`` (M, 3) is its (c, d, v) px there, ``by_pose`` (M, 3, 6) and ``by_point`` (M, 3, 3) the Jacobians of these.
    """

    track_ids: IntArray
    first: IntArray
    image: Array
    by_pose: Array
    by_point: Array

    @classmethod
    def at(cls, values: gtsam.Values, track_ids: IntArray, first: IntArray, rig: StereoRig) -> "LandmarksSeen":
        """Predict the images of landmarks (M,) in the frames (M,) that first saw them, at values."""
        points = np.array([values.atPoint3(L(i)) for i in track_ids.tolist()]).reshape(-1, 3)
        seen = stereo.predict(points, _poses(values, first), rig)
        by_pose, by_point = CHANNELS @ seen.d_uv_d_pose, CHANNELS @ seen.d_uv_d_point
        return cls(track_ids, first, seen.uv_px @ CHANNELS.T, by_pose, by_point)

    def moved_with_points(self, values: gtsam.Values, step: gtsam.VectorValues, rig: StereoRig) -> gtsam.Values:
        """Return the values after a step whose landmark parts are metres in the world, as in a graph's own step.

        A landmark that is not in front of its camera has no image there, and is moved in metres.
        """
        change = np.einsum("mij,mj->mi", self.by_point, _of_landmarks(step, self.track_ids))
        in_front = self.image[:, 1] > 0.0
        return self._select(in_front)._moved_by(change[in_front], values, step, rig)

    def _select(self, rows: BoolArray) -> "LandmarksSeen":
        ids, first, image, by_pose, by_point = self
        return LandmarksSeen(ids[rows], first[rows], image[rows], by_pose[rows], by_point[rows])

    def _moved_by(self, change: Array, values: gtsam.Values, step: gtsam.VectorValues, rig: StereoRig) -> gtsam.Values:
        """Return the values after a step, given the change of (c, d, v) px (M, 3) due to the points' own steps."""
        frames, row = np.unique(self.first, return_inverse=True)
        of_poses = step.vector([X(k) for k in frames.tolist()]).reshape(-1, 6)[row]
        change = change + np.einsum("mij,mj->mi", self.by_pose, of_poses)
        image, farther = self.image + change, np.clip(-change[:, 1] / self.image[:, 1], 0.0, _MOST_FARTHER)
        image[:, 1] = np.where(farther > 0.0, self.image[:, 1] * np.exp(-farther), image[:, 1])
        there = values.retract(step)
        points = stereo.triangulate_world(image @ _FROM_CHANNELS.T, _poses(there, self.first), rig)
        for track_id, point in zip(self.track_ids.tolist(), points, strict=True):
            there.update(L(track_id), point)
        return there


@dataclass(frozen=True, eq=False)
class FirstImages:
    """The M landmarks of a graph, L(track id) of ``track_ids`` (M,), and the frame X(``first``) that first saw each.

    GTSAM moves a pose in its own axes and a landmark in metres of the world. Where a step turns a stretch of road by
    0.01 rad and shifts it by 12 m, the two separate by 6 cm, which is pixels for a near landmark. Such a step raises
    the error, however well the linear system is solved. Landmarks that keep their place in the image of a pose move
    with it. ``at_once`` says that they do so from the first step on.
    """

    track_ids: IntArray
    first: IntArray
    rig: StereoRig
    at_once: bool = False

    @classmethod
    def of(cls, frames: list[StereoFrame], rig: StereoRig, at_once: bool = False) -> "FirstImages":
        """Return the landmarks that frames (K,) see."""
        of_frame = np.repeat(np.arange(len(frames)), [frame.track_ids.size for frame in frames])
        track_ids, begins = np.unique(np.concatenate([frame.track_ids for frame in frames]), return_index=True)
        return cls(track_ids, of_frame[begins], rig, at_once)

    @classmethod
    def in_graph(cls, graph: gtsam.NonlinearFactorGraph, rig: StereoRig) -> "FirstImages":
        """Return the landmarks that stereo factors of a graph see; those with linear factors alone are left out."""
        first: dict[int, int] = {}
        for factor in map(graph.at, range(graph.size())):
            if isinstance(factor, gtsam.GenericStereoFactor3D | gtsam.GenericProjectionFactorCal3_S2):
                frame, track_id = (gtsam.Symbol(key).index() for key in factor.keys())  # noqa: SIM118 - not a mapping
                first[track_id] = min(frame, first.get(track_id, frame))
        ids = sorted(first)
        return cls(np.array(ids, dtype=np.int64), np.array([first[i] for i in ids], dtype=np.int64), rig)

    def taken(self, values: gtsam.Values, step: gtsam.VectorValues) -> gtsam.Values:
        """Return the values after a graph's own step."""
        seen = LandmarksSeen.at(values, self.track_ids, self.first, self.rig)
        return seen.moved_with_points(values, step, self.rig)


def _of_landmarks(step: gtsam.VectorValues, track_ids: IntArray) -> Array:
    """Return the landmarks' parts (M, 3) of a step."""
    return np.asarray(step.vector([L(i) for i in track_ids.tolist()])).reshape(-1, 3)


def _poses(values: gtsam.Values, frames: IntArray) -> Array:
    """Return the poses (M, 4, 4) of frames (M,), of which many are the same."""
    unique, row = np.unique(frames, return_inverse=True)
    return np.array([values.atPose3(X(k)).matrix() for k in unique.tolist()]).reshape(-1, 4, 4)[row]
