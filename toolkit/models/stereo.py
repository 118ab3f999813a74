"""The stereo measurement z = K_s pi(T_oi T_iw m), reduced to (uL, uR, v), with its Jacobians (Kang, eqs. 3-7, 11).

A sighting by the left image alone lacks uR (NaN). It is treated as measured with an infinite variance: its rows of
residual and Jacobian are zero, the noise of uL and v does not depend on it, and the sighting has two degrees of
freedom. A sighting thus keeps three rows, and code that works on whole frames needs no second path.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse, skew, transform, transposed
from toolkit.measurements import StereoRig, is_left_only

# (c, d, v) = CHANNELS @ (uL, uR, v): the mean column, the disparity, the row.
CHANNELS = np.array([[0.5, 0.5, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
CHANNELS.flags.writeable = False
# The least depth to divide by.
_LEAST_DIVISIBLE_M = 1e-3
_U_RIGHT = 1
_SEEN = np.ix_([0, 2], [0, 2])


class StereoPrediction(NamedTuple):
    """Predicted measurements of points, with Jacobians; the leading axes (...) are those of the points.

    ``uv_px`` (..., 3); ``d_uv_d_pose`` (..., 3, 6) for a right perturbation [rotation, position] of T_world_imu;
    ``d_uv_d_point`` (..., 3, 3) for the point in the world; ``depth_m`` (...): where it is not positive the point is
    not in front of the camera and the rest of its row has no meaning.
    """

    uv_px: Array
    d_uv_d_pose: Array
    d_uv_d_point: Array
    depth_m: Array


def project(points_cam: Array, rig: StereoRig) -> Array:
    """Project points (..., 3) in left-camera coordinates to (uL, uR, v) (..., 3) px (Kang, eq. 3)."""
    x, y, z = points_cam[..., 0], points_cam[..., 1], points_cam[..., 2]
    uv_px = np.empty(points_cam.shape)
    uv_px[..., 0] = rig.fx_px * x / z + rig.cx_px
    uv_px[..., 1] = rig.fx_px * (x - rig.baseline_m) / z + rig.cx_px
    uv_px[..., 2] = rig.fy_px * y / z + rig.cy_px
    return uv_px


def projection_jacobian(points_cam: Array, rig: StereoRig) -> Array:
    """Return d(uL, uR, v)/d(point) (..., 3, 3) in camera coordinates: K_s dpi/dq (Kang, eq. 7)."""
    x, y, inverse_z = points_cam[..., 0], points_cam[..., 1], 1.0 / points_cam[..., 2]
    across_px, down_px = rig.fx_px * inverse_z, rig.fy_px * inverse_z
    jacobian = np.zeros((*points_cam.shape, 3))
    jacobian[..., 0, 0] = jacobian[..., 1, 0] = across_px
    jacobian[..., 2, 1] = down_px
    across_px = across_px * inverse_z
    jacobian[..., 0, 2] = -across_px * x
    jacobian[..., 1, 2] = -across_px * (x - rig.baseline_m)
    jacobian[..., 2, 2] = -down_px * inverse_z * y
    return jacobian


def predict(points_world: Array, T_world_imu: Array, rig: StereoRig) -> StereoPrediction:
    """Predict the measurements of points (N, 3) from one pose (4, 4) or from one pose each (N, 4, 4)."""
    return linearise(transform(se3_inverse(T_world_imu), points_world), T_world_imu[..., :3, :3], rig)


def linearise(points_imu: Array, R_world_imu: Array, rig: StereoRig) -> StereoPrediction:
    """Predict the measurements of points (..., 3) given in the IMU frame, whose attitudes are (..., 3, 3).

    A point within a millimetre of the camera's plane is predicted as if it were a millimetre in front of it.
    """
    points_cam, depth_m = _divisible(in_camera(points_imu, rig))
    d_uv_d_point_imu = projection_jacobian(points_cam, rig) @ transposed(rig.T_imu_cam[:3, :3])
    # Moving the IMU by exp([phi, rho]) on the right moves a fixed point by [p]x phi - rho in the IMU frame.
    d_uv_d_pose = np.empty((*points_imu.shape, 6))
    d_uv_d_pose[..., :3], d_uv_d_pose[..., 3:] = d_uv_d_point_imu @ skew(points_imu), -d_uv_d_point_imu
    d_uv_d_point = d_uv_d_point_imu @ transposed(R_world_imu)
    return StereoPrediction(project(points_cam, rig), d_uv_d_pose, d_uv_d_point, depth_m)


def images(points_imu: Array, rig: StereoRig) -> tuple[Array, Array]:
    """Return the measurements (..., 3) px and depths (...) m that :func:`linearise` predicts, without Jacobians."""
    points_cam, depth_m = _divisible(in_camera(points_imu, rig))
    return project(points_cam, rig), depth_m


def _divisible(points_cam: Array) -> tuple[Array, Array]:
    """Return points (..., 3), those too near to the camera's plane moved in front of it, and the original depths."""
    depth_m = points_cam[..., 2].copy()
    points_cam[..., 2] = np.where(np.abs(depth_m) < _LEAST_DIVISIBLE_M, _LEAST_DIVISIBLE_M, depth_m)
    return points_cam, depth_m


def in_camera(points_imu: Array, rig: StereoRig) -> Array:
    """Return points (..., 3) of the IMU frame in the left camera."""
    return np.asarray(points_imu @ rig.T_cam_imu[:3, :3].T + rig.T_cam_imu[:3, 3])


def triangulate(uvs_px: Array, rig: StereoRig) -> Array:
    """Return the points (..., 3) in left-camera coordinates of measurements with a positive disparity (Kang, eq. 4)."""
    z = rig.fx_px * rig.baseline_m / (uvs_px[..., 0] - uvs_px[..., 1])
    x = (uvs_px[..., 0] - rig.cx_px) * z / rig.fx_px
    y = (uvs_px[..., 2] - rig.cy_px) * z / rig.fy_px
    return np.stack([x, y, z], axis=-1)


def triangulate_world(uvs_px: Array, T_world_imu: Array, rig: StereoRig) -> Array:
    """Return the points (N, 3) in the world of measurements (N, 3) made from a pose (4, 4) or poses (N, 4, 4)."""
    return transform(T_world_imu @ rig.T_imu_cam, triangulate(uvs_px, rig))


def disparity_px(uvs_px: Array) -> Array:
    """Return uL - uR (...,) px."""
    disparity: Array = uvs_px[..., 0] - uvs_px[..., 1]
    return disparity


def degrees_of_freedom(uvs_px: Array) -> int | IntArray:
    """Return how many coordinates sightings (..., 3) px have: 3 if all are complete, else 2 or 3 for each (...)."""
    missing = is_left_only(uvs_px)
    return 3 - missing.astype(np.int64) if missing.any() else 3


def residuals_px(uvs_px: Array, predicted_px: Array) -> Array:
    """Return measured minus predicted (..., 3) px, zero where uR is missing."""
    residuals: Array = uvs_px - predicted_px
    missing = is_left_only(uvs_px)
    if missing.any():
        residuals[..., _U_RIGHT] = np.where(missing, 0.0, residuals[..., _U_RIGHT])
    return residuals


def seen_rows(uvs_px: Array, jacobian: Array) -> Array:
    """Return Jacobians (..., 3, k) of predicted sightings with the row of uR zero where it is missing."""
    missing = is_left_only(uvs_px)
    if not missing.any():
        return jacobian
    result: Array = jacobian.copy()
    result[missing, _U_RIGHT] = 0.0
    return result


def noise_px2(uvs_px: Array, rig: StereoRig) -> Array:
    """Return the noise of sightings: the rig's (3, 3), or one each (..., 3, 3), uncorrelated with a missing uR.

    It is to be used with the rows of :func:`residuals_px` and :func:`seen_rows`, which are zero for a missing uR.
    """
    return _each(uvs_px, rig.cov_uv_px2, left_noise_px2, rig)


def whitener(uvs_px: Array, rig: StereoRig) -> Array:
    """Return the matrices, (3, 3) or (..., 3, 3), that whiten residuals and Jacobians and set a missing row to zero.

    They do not set a row of NaN to zero: residuals must be those of :func:`residuals_px`.
    """
    return _each(uvs_px, rig.whitener, left_whitener, rig)


def left_whitener(rig: StereoRig) -> Array:
    """Return the matrix (3, 3) that whitens a sighting without the right image, the row and column of uR zero."""
    result = np.zeros((3, 3))
    result[_SEEN] = np.linalg.inv(np.linalg.cholesky(left_noise_px2(rig)[_SEEN]))
    return result


def whitened_residuals(uvs_px: Array, predicted_px: Array, rig: StereoRig) -> Array:
    """Return measured minus predicted (..., 3) in standard deviations, zero where uR is missing."""
    return applied(whitener(uvs_px, rig), residuals_px(uvs_px, predicted_px))


def applied(matrix: Array, values: Array) -> Array:
    """Return the product of a matrix (3, 3), or one each (..., 3, 3), with values (..., 3)."""
    return np.asarray(values @ matrix.T if matrix.ndim == 2 else (matrix @ values[..., None])[..., 0])


def left_cov_px2(rig: StereoRig) -> Array:
    """Return the covariance (2, 2) px^2 of (uL, v) in a sighting by the left image alone."""
    return np.asarray(left_noise_px2(rig)[_SEEN])


def left_noise_px2(rig: StereoRig) -> Array:
    """Return the noise (3, 3) with uR uncorrelated. If v is the mean of two rows, one row has the variance of uL."""
    cov_px2 = rig.cov_uv_px2.copy()
    cov_px2[_U_RIGHT, [0, 2]] = cov_px2[[0, 2], _U_RIGHT] = 0.0
    cov_px2[2, 2] = max(cov_px2[2, 2], cov_px2[0, 0])
    return cov_px2


def _each(uvs_px: Array, whole: Array, left: Callable[[StereoRig], Array], rig: StereoRig) -> Array:
    """Return ``whole`` if no right image is missing; else one matrix each, for left-only sightings that of ``left``."""
    missing: BoolArray = is_left_only(uvs_px)
    return np.where(missing[..., None, None], left(rig), whole) if missing.any() else whole
