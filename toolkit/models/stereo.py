"""The stereo measurement z = K_s pi(T_oi T_iw m), reduced to (uL, uR, v), with its Jacobians (Kang, eqs. 3-7, 11)."""

from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, se3_inverse, skew, transform, transposed
from toolkit.measurements import StereoRig

# (c, d, v) = CHANNELS @ (uL, uR, v): the mean column, the disparity, the row.
CHANNELS = np.array([[0.5, 0.5, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
CHANNELS.flags.writeable = False
# The least depth to divide by.
_LEAST_DIVISIBLE_M = 1e-3


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
