"""Steps of landmarks, taken in the image of the camera that first saw each of them.

The measurement depends on a far landmark's depth so nonlinearly that a step in metres overshoots, while the disparity
is nearly linear (Civera, Davison & Montiel 2008, "Inverse depth parametrization for monocular SLAM"). One such landmark
makes Levenberg's damping grow, which damps all poses as well; in the directions that tracks and motion determine the
least, the scale of the world and its drift, a solve then converges slowly.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from toolkit.geometry import IntArray
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.factors import L, X, poses_of
from toolkit.models.stereo import CHANNELS

_FROM_CHANNELS = np.linalg.inv(CHANNELS)
# Largest growth of the logarithm of the depth in one step; it keeps disparities positive.
_MOST_FARTHER = 2.0


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
        """Return the values after a graph's own step, whose landmark parts are metres in the world.

        Each landmark moves in the image (c, d, v) px of the frame that first saw it, by its own step and the pose's. A
        landmark that is not in front of that camera has no image there, and is moved in metres.
        """
        points = np.array([values.atPoint3(L(i)) for i in self.track_ids.tolist()]).reshape(-1, 3)
        seen = stereo.predict(points, poses_of(values, self.first), self.rig)
        image = seen.uv_px @ CHANNELS.T
        front = image[:, 1] > 0.0
        image, ids, first = image[front], self.track_ids[front].tolist(), self.first[front]
        frames, row = np.unique(first, return_inverse=True)
        of_points = np.asarray(step.vector([L(i) for i in ids])).reshape(-1, 3)
        of_poses = step.vector([X(k) for k in frames.tolist()]).reshape(-1, 6)[row]
        by_pose, by_point = CHANNELS @ seen.d_uv_d_pose[front], CHANNELS @ seen.d_uv_d_point[front]
        change = np.einsum("mij,mj->mi", by_point, of_points) + np.einsum("mij,mj->mi", by_pose, of_poses)
        farther = np.clip(-change[:, 1] / image[:, 1], 0.0, _MOST_FARTHER)
        moved = image + change
        moved[:, 1] = np.where(farther > 0.0, image[:, 1] * np.exp(-farther), moved[:, 1])
        there = values.retract(step)
        places = stereo.triangulate_world(moved @ _FROM_CHANNELS.T, poses_of(there, first), self.rig)
        for track_id, place in zip(ids, places, strict=True):
            there.update(L(track_id), place)
        return there
