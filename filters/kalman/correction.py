"""EKF corrections of the pose by many landmarks and of many landmarks by one pose (Kang, eqs. 6-14).

The report leaves one problem open: its gain inverts a matrix of the size of all measurements (eq. 12). The
measurement noise is block diagonal, so the same update in information form,
``P+ = (P^-1 + sum_k H_k^T S_k^-1 H_k)^-1``, needs only 3x3 blocks and is identical; no landmark is left out.
"""

from typing import NamedTuple

import numpy as np

from filters.kalman.gate import STEREO_GATE, huber_weights, mahalanobis_squared
from filters.kalman.landmarks import LandmarkMap
from toolkit.geometry import Array, BoolArray
from toolkit.models import stereo
from toolkit.models.state import POSE, Belief
from toolkit.sequence import StereoRig


class PoseCorrection(NamedTuple):
    """The corrected belief, who passed the gate (N,), and the NIS (N,) of every sighting, of three degrees each."""

    belief: Belief
    accepted: BoolArray
    nis: Array


def correct_pose(belief: Belief, landmarks: LandmarkMap, uvs_px: Array, rig: StereoRig) -> PoseCorrection:
    """Correct the pose by sightings (N, 3) px of N landmarks, each with its own uncertainty in the innovation.

    A sighting outside the 95 % gate is left out, one that strains it is given Huber's weight.
    """
    predicted = stereo.predict(landmarks.points, belief.T_world_imu, rig)
    residual_px, H_pose, H_point = uvs_px - predicted.uv_px, predicted.d_uv_d_pose, predicted.d_uv_d_point
    own_cov = H_point @ landmarks.covs @ np.swapaxes(H_point, 1, 2) + rig.cov_uv_px2
    nis = mahalanobis_squared(residual_px, own_cov + H_pose @ belief.cov[POSE, POSE] @ np.swapaxes(H_pose, 1, 2))
    accepted = (nis < STEREO_GATE) & (predicted.depth_m > 0.0)
    weights = np.where(accepted, huber_weights(mahalanobis_squared(residual_px, own_cov)), 0.0)
    corrected = updated_by_pose_sightings(belief, residual_px, H_pose, weights[:, None, None] * np.linalg.inv(own_cov))
    return PoseCorrection(corrected, accepted, nis)


def updated_by_pose_sightings(belief: Belief, residual_px: Array, H_pose: Array, information: Array) -> Belief:
    """Return the EKF update by residuals (N, 3) with Jacobians (N, 3, 6) and information matrices (N, 3, 3)."""
    weighted = np.swapaxes(H_pose, 1, 2) @ information
    posterior = np.linalg.inv(belief.cov)
    posterior[POSE, POSE] += (weighted @ H_pose).sum(axis=0)
    cov = np.linalg.inv(posterior)
    return belief.moved(cov[:, POSE] @ np.einsum("nij,nj->i", weighted, residual_px), cov)


class LandmarkCorrection(NamedTuple):
    """The corrected landmarks, the NIS (N,) of their sightings and the depths (N,) m they were predicted at."""

    landmarks: LandmarkMap
    nis: Array
    depth_m: Array


def correct_landmarks(
    landmarks: LandmarkMap, uvs_px: Array, T_world_imu: Array, pose_cov: Array, rig: StereoRig
) -> LandmarkCorrection:
    """Correct N landmarks by their sightings (N, 3) px from one pose, each by its own 3x3 EKF (Kang, eqs. 6-10).

    ``pose_cov`` (6, 6), zero in the report, counts as measurement noise: a doubtful pose does not harden the map.
    """
    predicted = stereo.predict(landmarks.points, T_world_imu, rig)
    residual_px, H_pose, H_point = uvs_px - predicted.uv_px, predicted.d_uv_d_pose, predicted.d_uv_d_point
    noise_px2 = rig.cov_uv_px2 + H_pose @ pose_cov @ np.swapaxes(H_pose, 1, 2)
    innovation_cov = H_point @ landmarks.covs @ np.swapaxes(H_point, 1, 2) + noise_px2
    gain = np.swapaxes(np.linalg.solve(innovation_cov, H_point @ landmarks.covs), 1, 2)
    points = landmarks.points + (gain @ residual_px[..., None])[..., 0]
    covs = landmarks.covs - gain @ H_point @ landmarks.covs
    corrected = LandmarkMap(landmarks.track_ids, points, 0.5 * (covs + np.swapaxes(covs, 1, 2)))
    return LandmarkCorrection(corrected, mahalanobis_squared(residual_px, innovation_cov), predicted.depth_m)


def correct_landmarks_gated(
    landmarks: LandmarkMap, uvs_px: Array, T_world_imu: Array, pose_cov: Array, rig: StereoRig, trusted: BoolArray
) -> LandmarkMap:
    """Correct the trusted (N,) landmarks whose sightings also pass the gate; leave the others as they are."""
    corrected, nis, depth_m = correct_landmarks(landmarks, uvs_px, T_world_imu, pose_cov, rig)
    accepted = trusted & (nis < STEREO_GATE) & (depth_m > 0.0)
    return landmarks.corrected(accepted, corrected.points, corrected.covs)
