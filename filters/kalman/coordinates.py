"""Joint beliefs that are corrected in other coordinates than the world's errors: inverse depth, right-invariant errors.

Inverse depth: the depth of a landmark is not Gaussian, but its inverse nearly is: the stereo sighting that started it
is linear in (x / z, y / z, 1 / z) of the camera that first saw it (Civera, Davison & Montiel 2008, "Inverse depth
parametrization for monocular SLAM"). A Gauss-Newton step in metres extrapolates a far landmark along the slope of depth
at the linearisation point, overshoots, and pulls the pose along.

Right-invariant: with X = (R, p, v, l_1 ... l_L) in SE_{2+L}(3), the velocity only where it is part of the state, the
error is the xi of ``X = exp(xi) X_estimated``: one rotation theta of the whole world and a displacement rho of each of
its vectors. In terms of the other filters' errors, to first order, ``theta = R phi``, ``rho_p = R delta_p + p x
theta``, likewise for the velocity, and ``rho_l = delta_l + l x theta``. A translation or rotation of the world is then
the same vector xi at every estimate, so that Jacobians evaluated at changing estimates keep the same unobservable
directions. The biases stay outside the group and are added (the "imperfect" invariant filter).

Sources: Barrau & Bonnabel 2015, "An EKF-SLAM algorithm with consistency properties", sections III-IV; Barrau & Bonnabel
2017, "The invariant extended Kalman filter as a stable observer".
"""

from copy import copy

import numpy as np

from filters.kalman.joint import JointBelief, Linearisation
from toolkit.geometry import Array, BoolArray, IntArray, se3_adjoint, se3_inverse, skew, so3_left_jacobian, transform
from toolkit.models.state import POSE, POSITION, ROTATION, Belief


class LandmarkAnchors(JointBelief):
    """A joint belief with an anchor (4, 4) for each landmark, ``T_world_cam`` of the camera that saw it first."""

    def __init__(self, core: Belief, T_imu_cam: Array) -> None:
        super().__init__(core)
        self._T_imu_cam = T_imu_cam
        self.anchors: Array = np.empty((0, 4, 4))

    def add_landmarks(self, track_ids: IntArray, points: Array, jacobian: Array, covs: Array) -> None:
        super().add_landmarks(track_ids, points, jacobian, covs)
        anchor = self.clones[-1] @ self._T_imu_cam
        self.anchors = np.concatenate([self.anchors, np.tile(anchor, (len(track_ids), 1, 1))])

    def marginalise_landmarks(self, which: BoolArray) -> None:
        super().marginalise_landmarks(which)
        self.anchors = self.anchors[~which]


class InverseDepthBelief(LandmarkAnchors):
    """A belief whose landmarks are moved in inverse depth from anchors that stay fixed, that of `ekf-slam`.

    The anchor camera is fixed at its first estimate, so that the triple is a function of the landmark alone. With
    Jacobians at first estimates, the error in the triple is a constant matrix times the error in metres. The covariance
    can therefore be kept in metres, and unobservable directions stay unobservable. Only the path of the estimate
    differs. A correction, which is in metres, is converted where ``at`` has Jacobians evaluated.
    """

    def __init__(self, core: Belief, T_imu_cam: Array, at: Linearisation) -> None:
        super().__init__(core, T_imu_cam)
        self._at = at

    def _displace(self, delta: Array) -> None:
        to_anchor = se3_inverse(self.anchors)
        linearised, now = transform(to_anchor, self._at.points(self)), transform(to_anchor, self.points)
        own = to_anchor[:, :3, :3] @ delta[self.landmark_columns].reshape(-1, 3, 1)
        change = (inverse_depth_jacobian(linearised) @ own)[..., 0]
        super()._displace(delta)
        self.points = transform(self.anchors, inverse_depth(inverse_depth(now) + change))


class CloneAnchoredBelief(JointBelief):
    """A belief whose landmarks are moved in inverse depth from the camera of a clone, their anchor.

    The error of a landmark is that of (x / z, y / z, 1 / z) in its anchor, which is a state too: a correction moves
    both and the landmark follows. To first order this error and that of the anchor are a linear function of the errors
    in metres, evaluated where ``at`` has Jacobians evaluated. The covariance is kept in metres, and changes with that
    function as the estimates move; at first estimates it is constant. The anchor is the newest clone, and the newest
    again once it leaves the window, which changes no covariance.

    Sources: Geneva et al. 2020, "OpenVINS" (ANCHORED_INVERSE_DEPTH); Cohen, Korotkine & Forbes 2026, "Observability and
    consistency analysis for visual-inertial navigation with anchored feature parameterizations" (arXiv 2606.19307): the
    unobservable directions do not depend on the estimates of landmarks, but still on those of poses.
    """

    def __init__(self, core: Belief, T_imu_cam: Array, at: Linearisation) -> None:
        super().__init__(core)
        self._T_imu_cam, self._at = T_imu_cam, at
        self.anchors: IntArray = np.empty(0, dtype=np.int64)

    def add_landmarks(self, track_ids: IntArray, points: Array, jacobian: Array, covs: Array) -> None:
        super().add_landmarks(track_ids, points, jacobian, covs)
        self.anchors = np.append(self.anchors, np.full(len(track_ids), len(self.clones) - 1))

    def marginalise_landmarks(self, which: BoolArray) -> None:
        super().marginalise_landmarks(which)
        self.anchors = self.anchors[~which]

    def marginalise_clones(self, count: int) -> None:
        """Marginalise the oldest clones; landmarks anchored there are anchored in the newest."""
        super().marginalise_clones(count)
        self.anchors = np.where(self.anchors < count, len(self.clones) - 1, self.anchors - count)

    def move(self, delta: Array) -> None:
        """Move every estimate by an error (n,); the covariance of anchored errors stays."""
        before = self._d_triple_d_error()
        self._displace(delta)
        now = self._d_triple_d_error()
        if not np.array_equal(now, before):
            carried = self._carried(before, now, self._carried(before, now, self._cov).T)
            self._cov = 0.5 * (carried + carried.T)

    def triples(self) -> Array:
        """Return (x / z, y / z, 1 / z) of each landmark in its anchor, (L, 3)."""
        return inverse_depth(transform(se3_inverse(self.clones[self.anchors] @ self._T_imu_cam), self.points))

    def _displace(self, delta: Array) -> None:
        change = self._d_triple_d_error() @ self._own(delta[:, None])
        triples = self.triples() + change[..., 0]
        super()._displace(delta)
        self.points = transform(self.clones[self.anchors] @ self._T_imu_cam, inverse_depth(triples))

    def _carried(self, before: Array, now: Array, rows: Array) -> Array:
        """Return errors (n, m) in metres before a move as those after it, for the same anchored errors."""
        result, own = rows.copy(), self._own(rows)
        relative = before @ own - now[:, :, 3:] @ own[:, 3:]
        result[self.landmark_columns] = np.linalg.solve(now[:, :, :3], relative).reshape(-1, rows.shape[1])
        return result

    def _own(self, rows: Array) -> Array:
        """Return the errors (L, 9, m) of each landmark and its anchor, of the errors (n, m) of the state."""
        of_points = rows[self.landmark_columns].reshape(len(self.points), 3, rows.shape[1])
        of_clones = rows[self.clone_columns].reshape(len(self.clones), 6, rows.shape[1])
        return np.concatenate([of_points, of_clones[self.anchors]], axis=1)

    def _d_triple_d_error(self) -> Array:
        """Return the Jacobians (L, 3, 9) of the triples to the errors of each landmark and its anchor."""
        anchors, points = self._at.clones(self)[self.anchors], self._at.points(self)
        to_camera = se3_inverse(anchors @ self._T_imu_cam)
        of_point = inverse_depth_jacobian(transform(to_camera, points)) @ to_camera[:, :3, :3]
        turn, in_imu = anchors[:, :3, :3], transform(se3_inverse(anchors), points)
        return np.concatenate([of_point, of_point @ turn @ skew(in_imu), -of_point @ turn], axis=2)


class AnchoredBelief(LandmarkAnchors):
    """A joint belief that is corrected on the group, with inverse-depth landmarks whose anchors move with the IMU.

    The covariance is kept in the coordinates of every joint belief, so that it can be read, propagated and extended by
    landmarks without conversion: to first order the two errors are linear functions of each other and propagate alike.
    They differ only where an estimate moves. An update yields the covariance of the right-invariant error; moving the
    estimate leaves that covariance unchanged, and the one kept here changes by the change of coordinates.

    A landmark's depth is not Gaussian, while the stereo sighting that started it is linear in inverse depth. For an
    update of one step this hardly matters. An iterated update would weight new sightings at the new depth, but the
    prior, which stands for the old sightings, as if they had been made from the old depth; it would shrink or stretch
    the world. So a landmark has an anchor here, the camera that first saw it, and its error is one of (x / z, y / z, 1
    / z) in the anchor's axes (Civera, Davison & Montiel 2008, "Inverse depth parametrization for monocular SLAM"). The
    anchor moves with the IMU, so the error is that of the landmark relative to the pose. Translations and rotations of
    the whole world are therefore the same vectors at every estimate.
    """

    def move(self, delta: Array) -> None:
        """Move every estimate by ``exp(xi)`` on the left, where xi is ``delta`` (n,) in invariant coordinates."""
        before = copy(self)
        self._displace(delta)
        carried = self._carried(before, self._carried(before, self._cov).T)
        self._cov = 0.5 * (carried + carried.T)

    def pulled_back(self, delta: Array, H_pose: Array, H_point: Array) -> tuple[Array, Array]:
        """Return Jacobians to the errors after a move by ``delta`` (n,) as Jacobians to ``delta``.

        Pose and anchors move together, so a sighting depends on a move only through the landmark's relative error.
        """
        after, turn = self.displaced(delta), self._core.T_world_imu[:3, :3]
        to_relative = H_point @ after.anchors[:, :3, :3] @ self._stretch(after)
        to_point = to_relative @ np.swapaxes(self.anchors[:, :3, :3], 1, 2)
        return np.concatenate([to_point @ skew(self._away()) @ turn, -to_point @ turn], axis=2), to_point

    def _displace(self, delta: Array) -> None:
        T_imu_world, anchored = se3_inverse(self._core.T_world_imu), self._anchored()
        change = inverse_depth_jacobian(anchored) @ self._relative(delta[:, None])
        on_the_group, velocity = delta.copy(), self._core.layout.velocity
        if velocity is not None:
            # exp(theta) v + J(theta) (delta_v + v x theta) = v + J(theta) delta_v: the vector turns as it grows.
            on_the_group[velocity] = so3_left_jacobian(delta[ROTATION]) @ delta[velocity]
        super()._displace(on_the_group)
        self.anchors = self._core.T_world_imu @ T_imu_world @ self.anchors
        self.points = transform(self.anchors, inverse_depth(inverse_depth(anchored) + change[..., 0]))

    def _carried(self, before: "AnchoredBelief", rows: Array) -> Array:
        """Return errors (n, m) at the estimates before a move as errors at the present estimates, for the same xi.

        Only differences of positions enter, so no precision is lost far from the origin.
        """
        result, old, new = rows.copy(), before.core, self._core
        result[POSE] = se3_adjoint(se3_inverse(new.T_world_imu) @ old.T_world_imu) @ rows[POSE]
        velocity, turn = old.layout.velocity, new.T_world_imu[:3, :3]
        if velocity is not None:
            theta = old.T_world_imu[:3, :3] @ rows[ROTATION]
            in_world = old.T_world_imu[:3, :3] @ rows[velocity] - skew(new.v_world - old.v_world) @ theta
            result[velocity] = turn.T @ in_world
        turns = se3_adjoint(se3_inverse(self.clones) @ before.clones)
        of_clones = turns @ rows[self.clone_columns].reshape(len(turns), 6, rows.shape[1])
        result[self.clone_columns] = of_clones.reshape(-1, rows.shape[1])
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
        """Return the matrices (L, 3, 3) from relative errors to those after a move, for equal inverse-depth error."""
        before, now = inverse_depth_jacobian(self._anchored()), inverse_depth_jacobian(after._anchored())
        return np.asarray(np.linalg.solve(now, before))

    def _away(self) -> Array:
        return np.asarray(self.points - self._core.T_world_imu[:3, 3])

    def _anchored(self) -> Array:
        return transform(se3_inverse(self.anchors), self.points)


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
