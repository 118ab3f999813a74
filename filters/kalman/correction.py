"""EKF corrections of the pose by many landmarks and of many landmarks by one pose (Kang, eqs. 6-14).

The report leaves one problem open: its gain inverts a matrix of the size of all measurements (eq. 12). The
matrix is block diagonal but for the pose's own six dimensions, so the same update in information form,
``P+ = (P^-1 + sum_k H_k^T S_k^-1 H_k)^-1``, needs only 3x3 blocks and is identical; no landmark is left out.
"""

from typing import NamedTuple

import numpy as np

from filters.kalman.belief import POSE, Belief
from filters.kalman.gate import STEREO_GATE, huber_weights, mahalanobis_squared
from filters.kalman.landmarks import LandmarkMap
from toolkit.geometry import Array, BoolArray
from toolkit.models import stereo
from toolkit.sequence import StereoRig


class PoseCorrection(NamedTuple):
    """The corrected belief, who passed the gate (N,), and the sum of their NIS with its degrees of freedom."""

    belief: Belief
    accepted: BoolArray
    nis: float
    nis_dof: int


def correct_pose(belief: Belief, landmarks: LandmarkMap, uvs_px: Array, rig: StereoRig) -> PoseCorrection:
    """Correct the pose by sightings (N, 3) px of N landmarks, each with its own uncertainty in the innovation."""
    predicted = stereo.predict(landmarks.points, belief.T_world_imu, rig)
    residual_px, d_uv_d_pose, d_uv_d_point = uvs_px - predicted.uv_px, predicted.d_uv_d_pose, predicted.d_uv_d_point
    own_cov = d_uv_d_point @ landmarks.covs @ np.swapaxes(d_uv_d_point, 1, 2) + rig.cov_uv_px2
    d_pose_uv = np.swapaxes(d_uv_d_pose, 1, 2)
    whole_cov = own_cov + d_uv_d_pose @ belief.cov[POSE, POSE] @ d_pose_uv
    nis = mahalanobis_squared(residual_px, whole_cov)
    accepted = (nis < STEREO_GATE) & (predicted.depth_m > 0.0)
    information = np.linalg.inv(own_cov)
    own_nis = np.einsum("ni,nij,nj->n", residual_px, information, residual_px)
    weights = np.where(accepted, huber_weights(own_nis), 0.0)
    weighted = weights[:, None, None] * (d_pose_uv @ information)
    delta, cov = information_update(
        belief.cov, (weighted @ d_uv_d_pose).sum(axis=0), np.einsum("nij,nj->i", weighted, residual_px)
    )
    return PoseCorrection(belief.moved(delta, cov), accepted, float(nis[accepted].sum()), 3 * int(accepted.sum()))


def information_update(cov: Array, pose_information: Array, pose_gradient: Array) -> tuple[Array, Array]:
    """Return the error (d,) and covariance (d, d) after adding information about the pose.

    ``pose_information`` (6, 6) is sum H^T S^-1 H and ``pose_gradient`` (6,) is sum H^T S^-1 r.
    """
    information = np.linalg.inv(cov)
    information[POSE, POSE] += pose_information
    updated = np.linalg.inv(information)
    return updated[:, POSE] @ pose_gradient, updated


def correct_landmarks(landmarks: LandmarkMap, uvs_px: Array, belief: Belief, rig: StereoRig) -> LandmarkMap:
    """Correct N landmarks by their sightings (N, 3) px from one pose, each by its own 3x3 EKF (Kang, eqs. 6-10).

    The pose's uncertainty counts as measurement noise, so that a doubtful pose does not harden the map.
    """
    predicted = stereo.predict(landmarks.points, belief.T_world_imu, rig)
    residual_px, H_point, H_pose = uvs_px - predicted.uv_px, predicted.d_uv_d_point, predicted.d_uv_d_pose
    pose_noise = H_pose @ belief.cov[POSE, POSE] @ np.swapaxes(H_pose, 1, 2)
    innovation_cov = H_point @ landmarks.covs @ np.swapaxes(H_point, 1, 2) + rig.cov_uv_px2 + pose_noise
    gain = np.swapaxes(np.linalg.solve(innovation_cov, H_point @ landmarks.covs), 1, 2)
    points = landmarks.points + (gain @ residual_px[..., None])[..., 0]
    covs = landmarks.covs - gain @ H_point @ landmarks.covs
    accepted = (mahalanobis_squared(residual_px, innovation_cov) < STEREO_GATE) & (predicted.depth_m > 0.0)
    return landmarks.corrected(accepted, points, 0.5 * (covs + np.swapaxes(covs, 1, 2)))
