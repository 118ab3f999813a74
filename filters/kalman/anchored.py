"""A right-invariant joint belief whose landmarks move along their inverse depth from where they were first seen.

A landmark's depth is not Gaussian: the stereo sighting that started it is linear in the inverse depth from there. An
update that stays where it linearises hardly notices. One that iterates does: it weighs new sightings at the new
depth and the old ones as if they had been made from the old, and shortens or lengthens the world. So a landmark has
here an anchor, the camera that saw it first, and its error is one of (x / z, y / z, 1 / z) in the anchor's axes
(Civera, Davison & Montiel 2008, "Inverse depth parametrization for monocular SLAM"). The anchor is moved along
with the IMU, so the error is one of the landmark relative to the pose: the whole world's shifts and turns are
the same vectors whatever the estimate, as in the invariant belief that this one refines.
"""

import numpy as np

from filters.kalman.invariant import InvariantBelief
from filters.kalman.inverse_depth import LandmarkAnchors, inverse_depth, inverse_depth_jacobian
from filters.kalman.joint import JointBelief
from toolkit.geometry import Array, se3_inverse, skew, transform
from toolkit.models.state import POSITION, ROTATION


class AnchoredBelief(LandmarkAnchors, InvariantBelief):
    """An invariant belief whose anchors are moved along with the IMU."""

    def pulled_back(self, delta: Array, H_pose: Array, H_point: Array) -> tuple[Array, Array]:
        """Return Jacobians to the errors after a move by ``delta`` (n,) as Jacobians to ``delta``.

        Pose and anchors move as one, so a sighting depends on a move through the landmark's relative error alone.
        """
        after, turn = self.displaced(delta), self._core.T_world_imu[:3, :3]
        to_relative = H_point @ after.anchors[:, :3, :3] @ self._stretch(after)
        to_point = to_relative @ np.swapaxes(self.anchors[:, :3, :3], 1, 2)
        return np.concatenate([to_point @ skew(self._away()) @ turn, -to_point @ turn], axis=2), to_point

    def _displace(self, delta: Array) -> None:
        T_imu_world, anchored = se3_inverse(self._core.T_world_imu), self._anchored()
        change = inverse_depth_jacobian(anchored) @ self._relative(delta[:, None])
        super()._displace(delta)
        self.anchors = self._core.T_world_imu @ T_imu_world @ self.anchors
        self.points = transform(self.anchors, inverse_depth(inverse_depth(anchored) + change[..., 0]))

    def _carried(self, before: JointBelief, rows: Array) -> Array:
        assert isinstance(before, AnchoredBelief)
        result, turn = super()._carried(before, rows), self._core.T_world_imu[:3, :3]
        relative = self.anchors[:, :3, :3] @ before._stretch(self) @ before._relative(rows)
        with_imu = turn @ result[POSITION] - skew(self._away()) @ (turn @ result[ROTATION])
        result[self.landmark_columns] = (relative + with_imu).reshape(-1, rows.shape[1])
        return result

    def _relative(self, rows: Array) -> Array:
        """Return errors (n, m) as errors (L, 3, m) of the landmarks relative to the pose, in their anchors' axes."""
        turn = self._core.T_world_imu[:3, :3]
        own = rows[self.landmark_columns].reshape(len(self.points), 3, rows.shape[1])
        in_world = own - turn @ rows[POSITION] + skew(self._away()) @ (turn @ rows[ROTATION])
        return np.asarray(np.swapaxes(self.anchors[:, :3, :3], 1, 2) @ in_world)

    def _stretch(self, after: "AnchoredBelief") -> Array:
        """Return what takes relative errors here to those after a move (L, 3, 3), the error in inverse depth kept."""
        before, now = inverse_depth_jacobian(self._anchored()), inverse_depth_jacobian(after._anchored())
        return np.asarray(np.linalg.solve(now, before))

    def _away(self) -> Array:
        return np.asarray(self.points - self._core.T_world_imu[:3, 3])

    def _anchored(self) -> Array:
        return transform(se3_inverse(self.anchors), self.points)
