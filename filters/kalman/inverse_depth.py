"""A joint belief in the world's errors whose landmarks are moved in inverse depth from the camera that first saw them.

The depth of a landmark is not Gaussian, but its inverse nearly is: the stereo sighting that started it is linear in (x
/ z, y / z, 1 / z) of the camera that first saw it (Civera, Davison & Montiel 2008, "Inverse depth parametrization for
monocular SLAM"). A Gauss-Newton step in metres extrapolates a far landmark along the slope of depth at the
linearisation point, overshoots, and pulls the pose along.

The anchor camera is fixed at its first estimate, so that the triple is a function of the landmark alone. With Jacobians
at first estimates, the error in the triple is a constant matrix times the error in metres. The covariance can therefore
be kept in metres, and unobservable directions stay unobservable. Only the path of the estimate differs.
"""

import numpy as np
from scipy.sparse import csr_array

from filters.kalman.joint import JointBelief
from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse, transform
from toolkit.models.state import Belief


class LandmarkAnchors(JointBelief):
    """A joint belief with an anchor (4, 4) for each landmark, ``T_world_cam`` of the camera that saw it first."""

    def __init__(self, core: Belief, T_imu_cam: Array) -> None:
        super().__init__(core)
        self._T_imu_cam = T_imu_cam
        self.anchors: Array = np.empty((0, 4, 4))

    def add_landmarks(self, track_ids: IntArray, points: Array, jacobian: Array | csr_array, cov: Array) -> None:
        """Add N landmarks as :meth:`JointBelief.add_landmarks` does, anchored in the newest clone."""
        super().add_landmarks(track_ids, points, jacobian, cov)
        anchor = self.clones[-1] @ self._T_imu_cam
        self.anchors = np.concatenate([self.anchors, np.tile(anchor, (len(track_ids), 1, 1))])

    def forget_landmarks(self, which: BoolArray) -> None:
        """Marginalise landmarks (L,)."""
        super().forget_landmarks(which)
        self.anchors = self.anchors[~which]


class InverseDepthBelief(LandmarkAnchors):
    """A belief whose landmarks are moved in inverse depth from anchors that stay fixed."""

    def _displace(self, delta: Array) -> None:
        to_anchor = se3_inverse(self.anchors)
        first, now = transform(to_anchor, self.first_points), transform(to_anchor, self.points)
        own = to_anchor[:, :3, :3] @ delta[self.landmark_columns].reshape(-1, 3, 1)
        change = (inverse_depth_jacobian(first) @ own)[..., 0]
        super()._displace(delta)
        self.points = transform(self.anchors, inverse_depth(inverse_depth(now) + change))


def inverse_depth(points: Array) -> Array:
    """Return (x / z, y / z, 1 / z) of points (..., 3); applied to such a triple it returns the point."""
    return np.concatenate([points[..., :2], np.ones_like(points[..., 2:])], axis=-1) / points[..., 2:]


def inverse_depth_jacobian(points: Array) -> Array:
    """Return the Jacobian (..., 3, 3) of :func:`inverse_depth`."""
    per_depth = 1.0 / points[..., 2]
    result = np.zeros((*points.shape, 3))
    result[..., 0, 0] = result[..., 1, 1] = per_depth
    result[..., :, 2] = -inverse_depth(points) * per_depth[..., None]
    return result
