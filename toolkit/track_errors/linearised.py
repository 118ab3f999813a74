"""Residuals of tracks about poses and landmarks, their derivatives, and what the landmarks leave of both.

A landmark is known by its own track alone, so it is eliminated: the whitened residuals lose the three directions it
explains (Triggs et al., "Bundle adjustment", 2000, section 6.1), as with a flat prior on it.
"""

from dataclasses import dataclass

import numpy as np

from toolkit.geometry import Array, se3_inverse, skew
from toolkit.models.gating import LEAST_DEPTH_M
from toolkit.sequence import StereoRig
from toolkit.track_errors.tracklets import Tracklets
from toolkit.track_noise import TrackNoise


@dataclass(frozen=True, eq=False)
class Linearised:
    """Residuals (B, n, 3) px, measured minus predicted in (c, d, v), and derivatives of what is predicted.

    ``d_landmark`` (B, n, 3, 3) by the landmark's own (c, d, v); ``d_pose`` (B, n, 3, 6) by the sighting's pose of the
    camera, perturbed on the right [rotation, position], the landmark fixed in the world.
    """

    residual_px: Array
    d_landmark: Array
    d_pose: Array


def linearised(tracks: Tracklets, T_world_middle: Array, rig: StereoRig) -> Linearised:
    """Linearise the tracks about their landmarks and the poses (K, 4, 4) of the camera in the middle of the pair."""
    T_now_first = (
        se3_inverse(T_world_middle)[tracks.frames] @ T_world_middle[tracks.first_frame][:, None]
    )  # (B, n, 4, 4)
    focal_px, centre_px = np.array([rig.fx_px, rig.fy_px]), np.array([rig.cx_px, rig.cy_px])
    landmark = tracks.landmark_cdv_px
    ray = np.ones((len(landmark), 3))
    ray[:, :2] = (landmark[:, [0, 2]] - centre_px) / focal_px
    scale_px_m = rig.fx_px * rig.baseline_m
    inverse_depth = landmark[:, 1] / scale_px_m
    # The point times its inverse depth in the first frame: finite where the point is not.
    rotation, shift = T_now_first[..., :3, :3], T_now_first[..., :3, 3]
    point = (rotation @ ray[:, None, :, None])[..., 0] + inverse_depth[:, None, None] * shift
    point[..., 2] = np.maximum(point[..., 2], LEAST_DEPTH_M * np.maximum(inverse_depth, 1e-6)[:, None])
    predicted = np.empty((*point.shape[:2], 3))
    predicted[..., [0, 2]] = focal_px * point[..., :2] / point[..., 2:] + centre_px
    predicted[..., 1] = landmark[:, None, 1] / point[..., 2]
    d_point = _d_cdv_d_point(point, landmark[:, None, 1], rig)
    by_landmark = np.empty((*point.shape[:2], 3, 3))
    by_landmark[..., 0], by_landmark[..., 2] = rotation[..., 0] / rig.fx_px, rotation[..., 1] / rig.fy_px
    by_landmark[..., 1] = shift / scale_px_m
    d_landmark = d_point @ by_landmark
    d_landmark[..., 1, 1] += 1.0 / point[..., 2]
    by_position = np.broadcast_to(-inverse_depth[:, None, None, None] * np.eye(3), by_landmark.shape)
    d_pose = d_point @ np.concatenate([skew(point), by_position], axis=-1)
    return Linearised(tracks.cdv_px - predicted, d_landmark, d_pose)


def _d_cdv_d_point(point: Array, disparity_px: Array, rig: StereoRig) -> Array:
    """Return the derivative (B, n, 3, 3) by a point (B, n, 3) that is scaled by its first inverse depth."""
    x, y, z = point[..., 0], point[..., 1], point[..., 2]
    jacobian = np.zeros((*point.shape, 3))
    jacobian[..., 0, 0], jacobian[..., 0, 2] = rig.fx_px / z, -rig.fx_px * x / z**2
    jacobian[..., 1, 2] = -disparity_px / z**2
    jacobian[..., 2, 1], jacobian[..., 2, 2] = rig.fy_px / z, -rig.fy_px * y / z**2
    return jacobian


def whitening(noise: TrackNoise, sightings: int) -> Array:
    """Return L^-1 (3, n, n) per channel, L L^T the covariance of that many sightings in successive frames."""
    cov: Array = noise.cov(np.arange(float(sightings)))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))


def whitened(per_channel: Array, values: Array) -> Array:
    """Return values (B, n, 3, ...) of the channels, whitened by (3, n, n), as rows (B, 3 n, ...)."""
    rows: Array = np.einsum("cij,bjc...->bic...", per_channel, values)
    return rows.reshape(len(values), -1, *values.shape[3:])
