"""What the decoupled filters share: a map of landmarks, each with a small Gaussian of its own, and its correction.

Source: Kang, eqs. 3-14. The report leaves one problem open: the gain of its pose inverts a matrix of the size of all
measurements (eq. 12). Its noise is block diagonal: with R_k the covariance of a sighting's noise and of its landmark,
the same update in information form, ``P+ = (P^-1 + sum_k H_k^T R_k^-1 H_k)^-1``, needs only 3x3 blocks and is
identical; no landmark is left out.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from toolkit.arrays import is_among, rows_of
from toolkit.estimate import Landmarks
from toolkit.geometry import Array, BoolArray, IntArray, transposed
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DISPARITY_PX, chi2_bound, mahalanobis_squared
from toolkit.models.state import POSE, Belief


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """The landmarks in the state: ids (M,) ascending, points in the world (M, 3) m, covariances (M, 3, 3)."""

    track_ids: IntArray
    points: Array
    covs: Array

    @classmethod
    def empty(cls) -> Self:
        return cls(np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))

    def __len__(self) -> int:
        return self.track_ids.size

    def select(self, slots: IntArray | BoolArray) -> "LandmarkMap":
        """Return the landmarks of some rows (m,), or of a mask (M,); the ids must stay ascending."""
        return LandmarkMap(self.track_ids[slots], self.points[slots], self.covs[slots])

    def merged(self, other: "LandmarkMap") -> "LandmarkMap":
        """Return the union of both maps, which must not share an id."""
        ids = np.concatenate([self.track_ids, other.track_ids])
        order = np.argsort(ids)
        points, covs = np.concatenate([self.points, other.points]), np.concatenate([self.covs, other.covs])
        return LandmarkMap(ids[order], points[order], covs[order])


def first_sighting(new: StereoFrame, T_world_imu: Array, rig: StereoRig) -> LandmarkMap:
    """Triangulate the landmarks of a frame from its pose (4, 4), but for those of too small a disparity (Kang, 3-5).

    The covariances are those of the measurements by the rig's weight of tracks, propagated through the triangulation.
    """
    near = new.select(stereo.disparity_px(new.uvs_px) > LEAST_DISPARITY_PX)
    points_cam, T_world_cam = stereo.triangulate(near.uvs_px, rig), T_world_imu @ rig.T_imu_cam
    d_point_d_uv = T_world_cam[:3, :3] @ np.linalg.inv(stereo.projection_jacobian(points_cam, rig))
    points = points_cam @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    covs = d_point_d_uv @ (rig.cov_uv_px2 / rig.track_weight) @ np.swapaxes(d_point_d_uv, 1, 2)
    return LandmarkMap(near.track_ids, points, covs)


def residuals_with_jacobians(
    landmarks: LandmarkMap, uvs_px: Array, T_world_imu: Array, rig: StereoRig
) -> tuple[Array, Array, Array, Array]:
    """Return residuals (N, 3) px of sightings (N, 3) px from a pose (4, 4), zero where uR is missing.

    With them their Jacobians to the pose (N, 3, 6) and to the landmarks (N, 3, 3), and the predicted depths (N,) m.
    """
    seen = stereo.predict(landmarks.points, T_world_imu, rig)
    H_pose, H_point = (stereo.seen_rows(uvs_px, H) for H in (seen.d_uv_d_pose, seen.d_uv_d_point))
    return stereo.residuals_px(uvs_px, seen.uv_px), H_pose, H_point, seen.depth_m


def projected_cov(H_pose: Array, pose_cov: Array) -> Array:
    """Return ``H P H^T`` (N, 3, 3) of Jacobians (N, 3, 6); the first product is one multiplication for all N."""
    rows = H_pose.reshape(-1, 6) @ pose_cov
    return np.asarray(rows.reshape(H_pose.shape) @ transposed(H_pose))


def information_update(belief: Belief, matrix: Array, vector: Array) -> Belief:
    """Return the EKF update by an information matrix M (6, 6) and vector n (6,) of the pose.

    With P the belief's covariance and P_p its columns of the pose, the update subtracts ``P_p (1 + M P_pp)^-1 M P_p^T``
    from P and moves the state by ``P_p (1 + M P_pp)^-1 n``. This equals the inverse of ``P^-1 + M`` without inverting
    P.
    """
    cov_pose = belief.cov[:, POSE]
    information = np.column_stack([matrix @ cov_pose.T, vector])
    taken = cov_pose @ np.linalg.solve(np.eye(6) + matrix @ cov_pose[POSE], information)
    return belief.moved(taken[:, -1], belief.cov - taken[:, :-1])


def correct_landmarks(
    landmarks: LandmarkMap, uvs_px: Array, T_world_imu: Array, pose_cov: Array, rig: StereoRig
) -> tuple[LandmarkMap, Array, Array]:
    """Correct N landmarks by their sightings (N, 3) px from one pose, each by its own 3x3 EKF (Kang, eqs. 6-10).

    ``pose_cov`` (6, 6), zero in the report, is added to the measurement noise, so that an uncertain pose does not make
    the map overconfident. Return also the NIS (N,) of the sightings and their predicted depths (N,) m. The NIS is by
    the stated noise, the update has the rig's weight of tracks.
    """
    residual_px, H_pose, H_point, depth_m = residuals_with_jacobians(landmarks, uvs_px, T_world_imu, rig)
    noise_px2 = stereo.noise_px2(uvs_px, rig)
    point_rows = H_point @ landmarks.covs
    predicted_px2 = point_rows @ transposed(H_point) + projected_cov(H_pose, pose_cov)
    nis = mahalanobis_squared(residual_px, predicted_px2 + noise_px2)
    right = np.concatenate([point_rows, residual_px[..., None]], axis=2)
    update = transposed(point_rows) @ np.linalg.solve(predicted_px2 + noise_px2 / rig.track_weight, right)
    points, covs = landmarks.points + update[..., 3], landmarks.covs - update[..., :3]
    after = LandmarkMap(landmarks.track_ids, points, 0.5 * (covs + np.swapaxes(covs, 1, 2)))
    return after, nis, depth_m


def correct_gated_landmarks(
    landmarks: LandmarkMap, uvs_px: Array, T_world_imu: Array, pose_cov: Array, rig: StereoRig, nis_bound: Array
) -> LandmarkMap:
    """Correct those landmarks whose sightings have a NIS below a bound (N,); leave the others as they are."""
    after, nis, depth_m = correct_landmarks(landmarks, uvs_px, T_world_imu, pose_cov, rig)
    passed = (nis < nis_bound) & (depth_m > 0.0)
    points = np.where(passed[:, None], after.points, landmarks.points)
    return LandmarkMap(landmarks.track_ids, points, np.where(passed[:, None, None], after.covs, landmarks.covs))


class TrackedMap:
    """The landmarks in view, updated frame by frame: lost ones move from the state to an archive, new ones start."""

    def __init__(self, rig: StereoRig) -> None:
        self._rig = rig
        self._in_view = LandmarkMap.empty()
        self._left: list[LandmarkMap] = []

    def seen_again(self, frame: StereoFrame) -> tuple[LandmarkMap, Array]:
        """Return the landmarks that the frame sees again and their measurements (N, 3) px; archive the others."""
        slots, known = rows_of(frame.track_ids, self._in_view.track_ids)
        slots = slots[known]
        lost = np.ones(len(self._in_view), dtype=bool)
        lost[slots] = False
        self._left.append(self._in_view.select(lost))
        return self._in_view.select(slots), frame.uvs_px[known]

    def keep(self, seen: LandmarkMap, frame: StereoFrame, T_world_imu: Array) -> None:
        """Keep the updated landmarks seen again; start the frame's other tracks from its pose (4, 4)."""
        new = frame.select(~is_among(frame.track_ids, seen.track_ids))
        self._in_view = seen.merged(first_sighting(new, T_world_imu, self._rig))

    def landmarks(self) -> Landmarks:
        parts = [*self._left, self._in_view]
        ids = np.concatenate([p.track_ids for p in parts])
        points, covs = np.concatenate([p.points for p in parts]), np.concatenate([p.covs for p in parts])
        last = ids.size - 1 - np.unique(ids[::-1], return_index=True)[1]
        return Landmarks(ids[last], points[last], covs[last])


class KnownPoseMapper:
    """Maps landmarks along given poses, each by its own EKF; a sighting outside the gate corrects nothing."""

    def __init__(self, rig: StereoRig, gate_probability: float | None) -> None:
        self._rig, self._map, self._probability = rig, TrackedMap(rig), gate_probability

    def add(self, frame: StereoFrame, T_world_imu: Array) -> None:
        """Correct the landmarks that the frame sees again and start its new ones, both from a pose (4, 4)."""
        seen, uvs_px = self._map.seen_again(frame)
        if len(seen):
            nis_bound = chi2_bound(stereo.degrees_of_freedom(uvs_px), self._probability)
            seen = correct_gated_landmarks(seen, uvs_px, T_world_imu, np.zeros((6, 6)), self._rig, nis_bound)
        self._map.keep(seen, frame, T_world_imu)

    def landmarks(self) -> Landmarks:
        return self._map.landmarks()
