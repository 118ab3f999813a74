"""Sightings of many landmarks from many poses as information on the poses alone: the landmarks are eliminated.

Each track is a smart factor (Carlone, Kira, Beall, Indelman & Dellaert 2014, "Eliminating conditionally independent
sets in factor graphs"; Forster et al. 2017, eqs. 47-50): its landmark's 3x3 block is eliminated by a Schur complement,
for all tracks at once. GTSAM's SmartStereoProjectionPoseFactor does the same only for noise that is equal and
independent in uL, uR and v; here the rig's full covariance is used, and each sighting has its weight by Huber's loss.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array

from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse, transform
from toolkit.measurements import StereoRig
from toolkit.models import left_only, stereo

# Norm of a point behind the camera: it has no gradient and must not cost less than one in front of it.
_BEHIND_NORM = 100.0
# A threshold of Huber's loss, in standard deviations, that no sighting reaches: no loss.
_NO_LOSS = 1e6
# Added to a landmark's 3x3 block so that it is never singular; far below the information of any sighting.
_LEAST_INFORMATION_PER_M2 = 1e-12


@dataclass(frozen=True, eq=False)
class RobustCamera:
    """A rig, and the threshold of Huber's loss of whitened sightings."""

    rig: StereoRig
    huber: float

    @classmethod
    def of(cls, rig: StereoRig, huber: float | None) -> "RobustCamera":
        """Return a camera with a threshold of the loss; None for no loss."""
        return cls(rig, _NO_LOSS if huber is None else huber)


@dataclass(frozen=True, eq=False)
class Sightings:
    """N sightings in the order of time: rows of poses (N,) and points (N,), measurements (N, 3) px."""

    pose: IntArray
    point: IntArray
    uv_px: Array

    def of_points(self, points: IntArray) -> "Sightings":
        """Return the sightings of some points (M,); their row numbers stay."""
        rows = np.isin(self.point, points)
        return Sightings(self.pose[rows], self.point[rows], self.uv_px[rows])


class PointsInView(NamedTuple):
    """The points of N sightings: attitudes (N, 3, 3) of the IMU, points (N, 3) m in its frame, depths (N,) m."""

    R_world_imu: Array
    points_imu: Array
    depth_m: Array

    @property
    def in_front(self) -> BoolArray:
        """Say which points (N,) are in front of the camera."""
        front: BoolArray = self.depth_m > 0.0
        return front


class ReducedVision(NamedTuple):
    """Information matrix (6K, 6K) and vector (6K,) on the poses, and the matrices for back-substitution of points."""

    information: Array
    vector: Array
    coupling: Array
    root: Array
    point_vector: Array

    def point_steps(self, pose_steps: Array) -> Array:
        """Return the steps (M, 3) of the points for steps (6K,) of the poses."""
        whitened = self.point_vector - (self.coupling.T @ pose_steps).reshape(-1, 3)
        return (self.root @ whitened[..., None])[..., 0]


def seen_from(poses: Array, points: Array, sightings: Sightings, rig: StereoRig) -> PointsInView:
    """Return the points (M, 3) of sightings relative to their poses (K, 4, 4) of the IMU in the world."""
    T_imu_world = se3_inverse(poses)[sightings.pose]
    with np.errstate(invalid="ignore"):
        points_imu = (T_imu_world[:, :3, :3] @ points[sightings.point, :, None])[..., 0] + T_imu_world[:, :3, 3]
        return PointsInView(poses[sightings.pose, :3, :3], points_imu, stereo.in_camera(points_imu, rig)[:, 2])


@dataclass(frozen=True, eq=False)
class Vision:
    """Sightings evaluated at poses (K, 4, 4) and points (M, 3): their cost, and on demand their normal equations."""

    counts: tuple[int, int]
    sightings: Sightings
    seen: PointsInView
    camera: RobustCamera

    @classmethod
    def at(cls, poses: Array, points: Array, sightings: Sightings, camera: RobustCamera) -> "Vision":
        """Evaluate sightings at poses (K, 4, 4) of the IMU in the world and points (M, 3) m in the world."""
        seen = seen_from(poses, points, sightings, camera.rig)
        return cls((len(poses), len(points)), sightings, seen, camera)

    @property
    def loss(self) -> float:
        """The sum of Huber's losses of the whitened residuals, half a square each where small, by tracks' weight."""
        return float(self._losses.sum())

    @property
    def loss_of_points(self) -> Array:
        """The part (M,) of the loss due to the sightings of each point."""
        return np.asarray(np.bincount(self.sightings.point, self._losses, minlength=self.counts[1]), dtype=np.float64)

    @property
    def _losses(self) -> Array:
        norm = np.where(self.seen.in_front, self._norm, _BEHIND_NORM)
        huber = self.camera.huber
        beyond = huber * (norm - huber / 2)
        return self.camera.rig.track_weight * np.where(norm <= huber, 0.5 * norm**2, beyond)

    def reduced(self) -> ReducedVision:
        """Linearise and eliminate the points; the poses' errors are GTSAM's: [rotation, position] in the body."""
        weights = self._root_weights
        weighted = weights[:, None, None] * left_only.whitener(self.sightings.uv_px, self.camera.rig)
        J_pose, J_point = weighted @ self._predicted.d_uv_d_pose, weighted @ self._predicted.d_uv_d_point
        return _eliminated(weights[:, None] * self.whitened, J_pose, J_point, self.sightings, self.counts)

    @property
    def _root_weights(self) -> Array:
        """The roots of Huber's weights (N,) times the weight of tracks; 0 behind the camera."""
        huber, weight = self.camera.huber, self.camera.rig.track_weight
        return np.where(self.seen.in_front, np.sqrt(weight * huber / np.maximum(self._norm, huber)), 0.0)

    @cached_property
    def _predicted(self) -> stereo.StereoPrediction:
        """The predicted images; points behind the camera are replaced by one that has an image."""
        in_front, somewhere = self.seen.in_front, transform(self.camera.rig.T_imu_cam, np.array([0.0, 0.0, 1.0]))
        points_imu = np.where(in_front[:, None], self.seen.points_imu, somewhere)
        return stereo.linearise(points_imu, self.seen.R_world_imu, self.camera.rig)

    @property
    def H_pose(self) -> Array:
        """The whitened Jacobians (N, 3, 6) to the pose of each sighting."""
        whitener = left_only.whitener(self.sightings.uv_px, self.camera.rig)
        return np.asarray(whitener @ left_only.seen_rows(self.sightings.uv_px, self._predicted.d_uv_d_pose))

    @property
    def residual_px(self) -> Array:
        """Measured less predicted (N, 3) px, zero where uR is missing."""
        return left_only.residuals_px(self.sightings.uv_px, self._predicted.uv_px)

    @cached_property
    def whitened(self) -> Array:
        """Measured less predicted, whitened by the stated noise (N, 3)."""
        return left_only.whitened_residuals(self.sightings.uv_px, self._predicted.uv_px, self.camera.rig)

    @cached_property
    def _norm(self) -> Array:
        return np.asarray(np.linalg.norm(self.whitened, axis=1))


def _eliminated(
    residual: Array, J_pose: Array, J_point: Array, seen: Sightings, counts: tuple[int, int]
) -> ReducedVision:
    (pose_count, point_count), point, pose = counts, seen.point, seen.pose
    # Small matrix products are several times as fast on contiguous arrays.
    to_point = np.ascontiguousarray(np.swapaxes(J_point, 1, 2))
    per_point = _summation(point, point_count)
    information_point = (per_point @ (to_point @ J_point).reshape(-1, 9)).reshape(-1, 3, 3)
    information_point += _LEAST_INFORMATION_PER_M2 * np.eye(3)
    vector_point = per_point @ (to_point @ residual[..., None])[..., 0]
    root = np.ascontiguousarray(np.swapaxes(np.linalg.inv(np.linalg.cholesky(information_point)), 1, 2))
    whitened_vector = (np.swapaxes(root, 1, 2) @ vector_point[..., None])[..., 0]
    coupling, vector = np.zeros((pose_count, 6, point_count, 3)), np.zeros((pose_count, 6))
    to_pose, per_pose = np.ascontiguousarray(np.swapaxes(J_pose, 1, 2)), _summation(pose, pose_count)
    coupling[pose, :, point, :] += to_pose @ (J_point @ root[point])
    vector += per_pose @ (to_pose @ residual[..., None])[..., 0]
    across = coupling.reshape(6 * pose_count, 3 * point_count)
    information = -(across @ across.T)
    own = (per_pose @ (to_pose @ J_pose).reshape(-1, 36)).reshape(pose_count, 6, 6)
    information.reshape(pose_count, 6, pose_count, 6)[np.arange(pose_count), :, np.arange(pose_count)] += own
    return ReducedVision(information, vector.ravel() - across @ whitened_vector.ravel(), across, root, whitened_vector)


def _summation(groups: IntArray, count: int) -> csc_array:
    """Return the matrix (count, N) that sums the rows (N, d) of each group."""
    return csc_array((np.ones(groups.size), groups, np.arange(groups.size + 1)), shape=(count, groups.size))
