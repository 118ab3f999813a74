"""Corrections that the decoupled filters share: of many landmarks by one pose, and of the pose by information.

Source: Kang, eqs. 6-14. The report leaves one problem open: its gain inverts a matrix of the size of all measurements
(eq. 12). Because the measurement noise is block diagonal, the same update in information form,
``P+ = (P^-1 + sum_k H_k^T S_k^-1 H_k)^-1``, needs only 3x3 blocks and is identical; no landmark is left out.
"""

from typing import NamedTuple

import numpy as np

from filters.kalman.landmark_map import LandmarkMap, TrackedMap
from toolkit.estimate import Landmarks
from toolkit.geometry import Array, transposed
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.gating import chi2_bound, mahalanobis_squared
from toolkit.models.state import POSE, Belief


def added_noise(noise_px2: Array, rig: StereoRig) -> Array:
    """Return what an update adds to the stated noise (..., 3, 3) px^2, so that a sighting has the weight of tracks."""
    return (1.0 / rig.track_weight - 1.0) * noise_px2


def residuals_with_jacobians(
    landmarks: LandmarkMap, uvs_px: Array, T_world_imu: Array, rig: StereoRig
) -> stereo.StereoPrediction:
    """Return the residuals (N, 3) px of sightings, with Jacobians; both are zero where uR is missing."""
    predicted = stereo.predict(landmarks.points, T_world_imu, rig)
    if not stereo.any_missing(uvs_px):
        return predicted._replace(uv_px=uvs_px - predicted.uv_px)
    return stereo.StereoPrediction(
        stereo.residuals_px(uvs_px, predicted.uv_px),
        stereo.seen_rows(uvs_px, predicted.d_uv_d_pose),
        stereo.seen_rows(uvs_px, predicted.d_uv_d_point),
        predicted.depth_m,
    )


def carried_pose_cov(H_pose: Array, pose_cov: Array) -> Array:
    """Return ``H P H^T`` (N, 3, 3) of Jacobians (N, 3, 6); the first product is one multiplication for all N."""
    carried = H_pose.reshape(-1, 6) @ pose_cov
    return np.asarray(carried.reshape(H_pose.shape) @ transposed(H_pose))


def updated_by_pose_sightings(belief: Belief, residual_px: Array, H_pose: Array, weighted: Array) -> Belief:
    """Return the EKF update by residuals (N, 3) with Jacobians (N, 3, 6) to the pose.

    ``weighted`` (N, 3, 6) are the Jacobians, each multiplied by the information matrix of its residual. They sum to the
    information matrix M (6, 6) and vector n (6,) of the pose. With P the belief's covariance and P_p its columns of the
    pose, the update subtracts ``P_p (1 + M P_pp)^-1 M P_p^T`` from P and moves the state by ``P_p (1 + M P_pp)^-1 n``.
    This equals the inverse of ``P^-1 + M`` without inverting P.
    """
    rows = weighted.reshape(-1, 6)
    matrix, vector = rows.T @ H_pose.reshape(-1, 6), rows.T @ residual_px.reshape(-1)
    cov_pose = belief.cov[:, POSE]
    information = np.column_stack([matrix @ cov_pose.T, vector])
    taken = cov_pose @ np.linalg.solve(np.eye(6) + matrix @ cov_pose[POSE], information)
    return belief.moved(taken[:, -1], belief.cov - taken[:, :-1])


class LandmarkCorrection(NamedTuple):
    """The corrected landmarks, the NIS (N,) of their sightings and their predicted depths (N,) m."""

    landmarks: LandmarkMap
    nis: Array
    depth_m: Array


def correct_landmarks(
    landmarks: LandmarkMap, uvs_px: Array, T_world_imu: Array, pose_cov: Array, rig: StereoRig
) -> LandmarkCorrection:
    """Correct N landmarks by their sightings (N, 3) px from one pose, each by its own 3x3 EKF (Kang, eqs. 6-10).

    ``pose_cov`` (6, 6), zero in the report, is added to the measurement noise, so that an uncertain pose does not make
    the map overconfident. The NIS is by the stated noise, the update has the rig's weight of tracks.
    """
    residual_px, H_pose, H_point, depth_m = residuals_with_jacobians(landmarks, uvs_px, T_world_imu, rig)
    noise_px2 = stereo.noise_px2(uvs_px, rig)
    carried = H_point @ landmarks.covs
    innovation_cov = carried @ transposed(H_point) + carried_pose_cov(H_pose, pose_cov) + noise_px2
    nis = mahalanobis_squared(residual_px, innovation_cov)
    innovation_cov = innovation_cov + added_noise(noise_px2, rig)
    weighted = np.linalg.solve(innovation_cov, np.concatenate([carried, residual_px[..., None]], axis=2))
    update = transposed(carried) @ weighted
    points, covs = landmarks.points + update[..., 3], landmarks.covs - update[..., :3]
    after = LandmarkMap(landmarks.track_ids, points, 0.5 * (covs + np.swapaxes(covs, 1, 2)))
    return LandmarkCorrection(after, nis, depth_m)


def correct_landmarks_below(
    landmarks: LandmarkMap, uvs_px: Array, T_world_imu: Array, pose_cov: Array, rig: StereoRig, nis_bound: Array
) -> LandmarkMap:
    """Correct those landmarks whose sightings have a NIS below a bound (N,); leave the others as they are."""
    after, nis, depth_m = correct_landmarks(landmarks, uvs_px, T_world_imu, pose_cov, rig)
    return landmarks.corrected((nis < nis_bound) & (depth_m > 0.0), after.points, after.covs)


class KnownPoseMapper:
    """Maps landmarks along given poses, each by its own EKF; a sighting outside the gate corrects nothing."""

    def __init__(self, rig: StereoRig, gate_probability: float | None) -> None:
        self._rig, self._map, self._probability = rig, TrackedMap(rig), gate_probability

    def add(self, frame: StereoFrame, T_world_imu: Array) -> None:
        """Correct the landmarks that the frame sees again and start its new ones, both from a pose (4, 4)."""
        seen, uvs_px = self._map.seen_again(frame)
        if len(seen):
            nis_bound = chi2_bound(stereo.degrees_of_freedom(uvs_px), self._probability)
            seen = correct_landmarks_below(seen, uvs_px, T_world_imu, np.zeros((6, 6)), self._rig, nis_bound)
        self._map.keep(seen, frame, T_world_imu)

    def landmarks(self) -> Landmarks:
        """Return the last estimate of every landmark of the run."""
        return self._map.landmarks()
