"""A track's sightings compiled: their images and Jacobians."""

import math

import numpy as np

from filters.kalman.kernels.algebra import moved, solved_3
from filters.kalman.kernels.compiling import compiled
from filters.kalman.kernels.signatures import Arrays
from toolkit.geometry import Array, BoolArray, IntArray


@compiled
def sighted(seen: BoolArray, f: int) -> IntArray:
    """Return the indices of the poses that saw a track."""
    count = 0
    for j in range(seen.shape[1]):
        count += seen[f, j]
    where = np.empty(count, dtype=np.int64)
    count = 0
    for j in range(seen.shape[1]):
        if seen[f, j]:
            where[count] = j
            count += 1
    return where


@compiled
def first_guess(uvs_px: Array, seen: BoolArray, f: int, T_world_cam: Array, intrinsics: Array, points: Array) -> float:
    """Write to ``points[f]`` the stereo point of a track's sighting with the largest disparity; return that disparity.

    A disparity of at most ``points[f, 0]`` px is replaced by one pixel, in the centre of the image.
    """
    least_px, nearest, largest = points[f, 0], seen.shape[1] - 1, -np.inf
    for j in range(seen.shape[1]):
        disparity = uvs_px[f, j, 0] - uvs_px[f, j, 1]
        if seen[f, j] and disparity > largest:
            nearest, largest = j, disparity
    fx, fy, cx, cy, baseline_m = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3], intrinsics[4]
    if largest > least_px:
        z = fx * baseline_m / largest
        x, y = (uvs_px[f, nearest, 0] - cx) * z / fx, (uvs_px[f, nearest, 2] - cy) * z / fy
    else:
        x, y, z = baseline_m, 0.0, fx * baseline_m
    points[f, 0], points[f, 1], points[f, 2] = moved(T_world_cam, nearest, x, y, z)
    return largest


@compiled
def project(intrinsics: Array, x: float, y: float, z: float, J: Array) -> None:
    """Write the Jacobian of (uL, uR, v) to a point in camera coordinates to J (4, 4), the image to its last column.

    Within a millimetre of the camera's plane the point is taken to be a millimetre in front, as in
    ``stereo.linearise``.
    """
    z = z if abs(z) >= 1e-3 else 1e-3
    across, down, right = intrinsics[0] / z, intrinsics[1] / z, x - intrinsics[4]
    J[0, 0], J[0, 1], J[0, 2], J[0, 3] = across, 0.0, -across * x / z, across * x + intrinsics[2]
    J[1, 0], J[1, 1], J[1, 2], J[1, 3] = across, 0.0, -across * right / z, across * right + intrinsics[2]
    J[2, 0], J[2, 1], J[2, 2], J[2, 3] = 0.0, down, -down * y / z, down * y + intrinsics[3]


@compiled
def linearise(points: Array, f: int, uvs_px: Array, where: IntArray, window: Arrays, eye: Arrays, out: Arrays) -> float:
    """Linearise the sightings of a track from the poses ``where`` (m,); return its least depth.

    ``window`` has the inverses of the poses, the poses to linearise at and their inverses; ``eye`` the intrinsics,
    T_cam_imu and the whitener of the rows. ``out`` gets the Jacobians to each pose (3 m, 6), and the landmark's
    Jacobian beside the residual (3 m, 4). A fixed point p in the IMU frame moves by ``p x phi - rho`` under
    ``T exp([phi, rho])``.
    """
    inverses_now, poses_at, inverses_at = window
    intrinsics, T_cam_imu, rows = eye
    H_pose, H_point = out
    J, uv, nearest = np.empty((3, 4)), np.empty(3), np.inf
    for k in range(where.size):
        j = where[k]
        x, y, z = moved(inverses_now, j, points[f, 0], points[f, 1], points[f, 2])
        x, y, z = moved(T_cam_imu, T_cam_imu.shape[0] - 1, x, y, z)
        nearest = min(nearest, z)
        project(intrinsics, x, y, z, J)
        for i in range(3):
            uv[i] = J[i, 3]
        px, py, pz = moved(inverses_at, j, points[f, 0], points[f, 1], points[f, 2])
        x, y, z = moved(T_cam_imu, T_cam_imu.shape[0] - 1, px, py, pz)
        project(intrinsics, x, y, z, J)
        for i in range(3):
            u = rows[i, 0] * J[0, 0] + rows[i, 1] * J[1, 0]
            v = rows[i, 2] * J[2, 1]
            w = rows[i, 0] * J[0, 2] + rows[i, 1] * J[1, 2] + rows[i, 2] * J[2, 2]
            a = u * T_cam_imu[0, 0, 0] + v * T_cam_imu[0, 1, 0] + w * T_cam_imu[0, 2, 0]
            b = u * T_cam_imu[0, 0, 1] + v * T_cam_imu[0, 1, 1] + w * T_cam_imu[0, 2, 1]
            c = u * T_cam_imu[0, 0, 2] + v * T_cam_imu[0, 1, 2] + w * T_cam_imu[0, 2, 2]
            at = 3 * k + i
            H_pose[at, 0], H_pose[at, 1], H_pose[at, 2] = b * pz - c * py, c * px - a * pz, a * py - b * px
            H_pose[at, 3], H_pose[at, 4], H_pose[at, 5] = -a, -b, -c
            H_point[at, 3] = 0.0
            for d in range(3):
                H_point[at, d] = a * poses_at[j, d, 0] + b * poses_at[j, d, 1] + c * poses_at[j, d, 2]
                H_point[at, 3] += rows[i, d] * (uvs_px[f, j, d] - uv[d])
    return nearest


@compiled
def add_products(rows: Array, first: int, end: int, N: Array, at: int) -> None:
    """Add ``[H r]^T [H r]`` of some rows (., 4) to row ``at`` of N, in the form that ``solved_3`` takes."""
    for row in range(first, end):
        c = 0
        for a in range(4):
            for b in range(a + 1):
                N[at, c] += rows[row, a] * rows[row, b]
                c += 1


@compiled
def step(points: Array, f: int, nearest_m: float, N: Array, at: int) -> None:
    """Move a track's point by the solution of row ``at`` of N, by at most a fifth of the least depth."""
    x, y, z = solved_3(N, at, 0.0, 0.0)
    share = min(1.0, 0.2 * nearest_m / max(math.sqrt(x * x + y * y + z * z), 1e-9))
    points[f, 0] += share * x
    points[f, 1] += share * y
    points[f, 2] += share * z
