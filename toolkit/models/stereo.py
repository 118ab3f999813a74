"""The stereo measurement z = K_s pi(T_oi T_iw m), reduced to (uL, uR, v), with its Jacobians (Kang, eqs. 3-7, 11)."""

from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, se3_inverse, skew, transform
from toolkit.sequence import StereoRig


class StereoPrediction(NamedTuple):
    """Predicted measurements of N points from one pose, with Jacobians.

    ``uv_px`` (N, 3); ``d_uv_d_pose`` (N, 3, 6) for a right perturbation [rotation, position] of T_world_imu;
    ``d_uv_d_point`` (N, 3, 3) for the point in the world; ``depth_m`` (N,): where it is not positive the
    point is not in front of the camera and the rest of its row means nothing.
    """

    uv_px: Array
    d_uv_d_pose: Array
    d_uv_d_point: Array
    depth_m: Array


def project(points_cam: Array, rig: StereoRig) -> Array:
    """Project points (..., 3) in left-camera coordinates to (uL, uR, v) (..., 3) px (Kang, eq. 3)."""
    x, y, z = points_cam[..., 0], points_cam[..., 1], points_cam[..., 2]
    u_left_px = rig.fx_px * x / z + rig.cx_px
    u_right_px = rig.fx_px * (x - rig.baseline_m) / z + rig.cx_px
    v_px = rig.fy_px * y / z + rig.cy_px
    return np.stack([u_left_px, u_right_px, v_px], axis=-1)


def projection_jacobian(points_cam: Array, rig: StereoRig) -> Array:
    """Return d(uL, uR, v)/d(point) (..., 3, 3) in camera coordinates: K_s dpi/dq (Kang, eq. 7)."""
    x, y, inverse_z = points_cam[..., 0], points_cam[..., 1], 1.0 / points_cam[..., 2]
    jacobian = np.zeros((*points_cam.shape, 3))
    jacobian[..., 0, 0] = jacobian[..., 1, 0] = rig.fx_px * inverse_z
    jacobian[..., 0, 2] = -rig.fx_px * x * inverse_z**2
    jacobian[..., 1, 2] = -rig.fx_px * (x - rig.baseline_m) * inverse_z**2
    jacobian[..., 2, 1] = rig.fy_px * inverse_z
    jacobian[..., 2, 2] = -rig.fy_px * y * inverse_z**2
    return jacobian


def predict(points_world: Array, T_world_imu: Array, rig: StereoRig) -> StereoPrediction:
    """Predict the measurements of points (N, 3) from one pose (4, 4) or from a pose each (N, 4, 4)."""
    T_cam_imu = se3_inverse(rig.T_imu_cam)
    points_imu = transform(se3_inverse(T_world_imu), points_world)
    points_cam = transform(T_cam_imu, points_imu)
    d_uv_d_point_imu = projection_jacobian(points_cam, rig) @ T_cam_imu[:3, :3]
    # Moving the IMU by exp([phi, rho]) on the right moves a fixed point by [p]x phi - rho in the IMU frame.
    d_uv_d_pose = np.concatenate([d_uv_d_point_imu @ skew(points_imu), -d_uv_d_point_imu], axis=-1)
    d_uv_d_point = d_uv_d_point_imu @ np.swapaxes(T_world_imu[..., :3, :3], -1, -2)
    return StereoPrediction(project(points_cam, rig), d_uv_d_pose, d_uv_d_point, points_cam[..., 2])


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
