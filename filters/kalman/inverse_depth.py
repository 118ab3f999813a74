"""A joint belief in the world's errors whose landmarks move along their inverse depth from where they were first seen.

The depth of a landmark is not Gaussian, its inverse nearly is: the stereo sighting that started it is linear in
(x / z, y / z, 1 / z) of the camera that saw it first (Civera, Davison & Montiel 2008, "Inverse depth parametrization
for monocular SLAM"). Moved in metres by a Gauss-Newton step, a far landmark ends where that step's slope of depth
leads, and pulls the pose with it.

That camera stays where it was first estimated, a constant, so that the triple is a function of the landmark alone. With
Jacobians at first estimates the error in it is a constant matrix times that in metres: the covariance can be kept in
metres, and what is unobservable stays so. Only the way an estimate takes is another.
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
    """A belief whose landmarks move along their inverse depth from anchors that stay where they are."""

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
