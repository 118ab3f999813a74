"""One frame of the decoupled EKF compiled: ``correction`` and ``landmark_map`` in NumPy, one sighting after another.

With C the Cholesky factor of a sighting's covariance S (3, 3), only ``C^-1 [H r]`` is needed: products of its columns
are ``H^T S^-1 H`` and ``H^T S^-1 r``, from which the pose's information and the landmark's update are computed (Kang,
eqs. 6-14). A sighting by the left image alone has zeros in the row of uR and its own noise
(``toolkit.models.left_only``).
"""

import math

import numpy as np
from numba import types

from filters.kalman.kernels.algebra import cholesky, inverses, moved, products, solve
from filters.kalman.kernels.compiling import compiled, kept, what_was_compiled
from filters.kalman.kernels.rigid_motions import exponential
from filters.kalman.kernels.sightings import linearise
from filters.kalman.kernels.signatures import MATRIX, ROW, STACK, Arrays
from toolkit.geometry import Array, IntArray

# fx, fy, cx, cy px and baseline m (5,), T_imu_cam (1, 4, 4), noise px^2 of sightings by both images and by the left
# alone (2, 3, 3).
CAMERA = types.Tuple((ROW, STACK, STACK))
# Points (N, 3), covariances (N, 3, 3), sightings (uL, uR, v) (N, 1, 3) px and which are by the left image alone (N,);
# pose (1, 4, 4) and covariance (d, d) of the state; the camera; and (2, 2) the bound of the NIS and Huber's threshold,
# in row 0 for sightings by both images, in row 1 for those by the left alone.
CORRECTION = (types.Tuple((MATRIX, STACK, STACK, types.boolean[::1])), types.Tuple((STACK, MATRIX)), CAMERA, MATRIX)
# Sightings (N, 3) px by both images, pose (1, 4, 4), camera.
START = (MATRIX, STACK, CAMERA)


@compiled
def whiten(cov: Array, rows: Array) -> None:
    """Multiply rows (3, n) by C^-1, with C the Cholesky factor of a covariance (3, 3), which C overwrites."""
    cholesky(cov, 3)
    for i in range(3):
        for c in range(rows.shape[1]):
            for k in range(i):
                rows[i, c] -= cov[i, k] * rows[k, c]
            rows[i, c] /= cov[i, i]


@compiled
def compare(landmarks: Arrays, f: int, view: Arrays, eye: Arrays, here: IntArray, out: Arrays) -> float:
    """Linearise the sighting of landmark f as ``linearise`` does, without whitening; return the depth."""
    points, _, uvs_px, left_only = landmarks
    depth_m: float = linearise(points, f, uvs_px, here, view, eye, out)
    if left_only[f]:
        clear_row(out[0], 1)
        clear_row(out[1], 1)
    return depth_m


@compiled
def clear_row(A: Array, i: int) -> None:
    """Set a row of A to zero."""
    for c in range(A.shape[1]):
        A[i, c] = 0.0


@compiled
def add_carried(H: Array, P: Array, n: int, S: Array) -> None:
    """Add ``H P H^T`` to S (3, 3), using the first n columns of H and the same part of P."""
    for a in range(3):
        for c in range(n):
            carried = 0.0
            for k in range(n):
                carried += H[a, k] * P[k, c]
            for b in range(3):
                S[a, b] += carried * H[b, c]


@compiled
def informed_pose(landmarks: Arrays, state: Arrays, eye: Arrays, noises: Array, rules: Array, out: Arrays) -> None:
    """Gate N sightings; sum the pose's information ``[M n]`` (6, 7) of those that passed, with Huber's weights.

    The gate tests residuals with the uncertainty of pose, landmark and sighting; the loss is of residuals whitened
    without the pose's uncertainty. ``out`` also gets the NIS (N,) and which passed (N,).
    """
    points, covs, _, left_only = landmarks
    view, P = state
    information, nis, accepted = out
    here, H_pose, H_point = np.zeros(1, dtype=np.int64), np.empty((3, 6)), np.empty((3, 4))
    own, S, rows, residual = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 7)), np.empty((3, 1))
    for f in range(points.shape[0]):
        kind, depth_m = int(left_only[f]), compare(landmarks, f, view, eye, here, (H_pose, H_point))
        for i in range(3):
            for j in range(3):
                own[i, j] = noises[kind, i, j]
        add_carried(H_point, covs[f], 3, own)
        for i in range(3):
            for j in range(3):
                S[i, j] = own[i, j]
            residual[i, 0] = H_point[i, 3]
        add_carried(H_pose, P, 6, S)
        whiten(S, residual)
        nis[f] = residual[0, 0] ** 2 + residual[1, 0] ** 2 + residual[2, 0] ** 2
        accepted[f] = nis[f] < rules[kind, 0] and depth_m > 0.0
        if accepted[f]:
            for i in range(3):
                for c in range(7):
                    rows[i, c] = H_pose[i, c] if c < 6 else H_point[i, 3]
            whiten(own, rows)
            squared = rows[0, 6] ** 2 + rows[1, 6] ** 2 + rows[2, 6] ** 2
            weight = min(1.0, rules[kind, 1] / math.sqrt(max(squared, 1e-12)))
            for i in range(3):
                for a in range(6):
                    for c in range(7):
                        information[a, c] += weight * rows[i, a] * rows[i, c]


@compiled
def corrected_pose(information: Array, P: Array) -> tuple[Array, Array]:
    """Return the error (d,) and the covariance (d, d) of the state given ``[M n]`` of its pose.

    As in ``correction.updated_by_pose_sightings``: ``P_p (1 + M P_pp)^-1 [M P_p^T, n]``.
    """
    d = P.shape[0]
    A, B, moved_by, cov = np.empty((6, 6)), np.empty((6, d + 1)), np.empty(d), np.empty((d, d))
    for a in range(6):
        B[a, d] = information[a, 6]
        for c in range(d):
            B[a, c] = 0.0
            for k in range(6):
                B[a, c] += information[a, k] * P[c, k]
        for c in range(6):
            A[a, c] = B[a, c] + (1.0 if a == c else 0.0)
    solve(A, B)
    for i in range(d):
        for c in range(d + 1):
            taken = 0.0
            for k in range(6):
                taken += P[i, k] * B[k, c]
            if c < d:
                cov[i, c] = P[i, c] - taken
            else:
                moved_by[i] = taken
    for i in range(d):
        for c in range(i):
            cov[i, c] = cov[c, i] = 0.5 * (cov[i, c] + cov[c, i])
    return moved_by, cov


@compiled
def correct_landmarks(
    landmarks: Arrays, state: Arrays, eye: Arrays, noises: Array, rules: Array, accepted: Array
) -> tuple[Array, Array]:
    """Return points (N, 3) and covariances (N, 3, 3), corrected where a sighting passed the pose's gate and now again.

    With ``A = C^-1 H P``, P being the joint covariance of pose and landmark, the landmark's covariance falls by
    ``A^T A``.
    """
    points, covs, _, left_only = landmarks
    view, P = state
    here, H_pose, H_point = np.zeros(1, dtype=np.int64), np.empty((3, 6)), np.empty((3, 4))
    S, rows, new_points, new_covs = np.empty((3, 3)), np.empty((3, 4)), points.copy(), covs.copy()
    for f in range(points.shape[0]):
        if not accepted[f]:
            continue
        kind, depth_m = int(left_only[f]), compare(landmarks, f, view, eye, here, (H_pose, H_point))
        for i in range(3):
            rows[i, 3] = H_point[i, 3]
            for c in range(3):
                S[i, c], rows[i, c] = noises[kind, i, c], 0.0
                for k in range(3):
                    rows[i, c] += H_point[i, k] * covs[f, k, c]
        add_carried(H_point, covs[f], 3, S)
        add_carried(H_pose, P, 6, S)
        whiten(S, rows)
        nis = rows[0, 3] ** 2 + rows[1, 3] ** 2 + rows[2, 3] ** 2
        if nis < rules[kind, 0] and depth_m > 0.0:
            for a in range(3):
                for i in range(3):
                    new_points[f, a] += rows[i, a] * rows[i, 3]
                    for c in range(3):
                        new_covs[f, a, c] -= rows[i, a] * rows[i, c]
            for a in range(3):
                for c in range(a):
                    new_covs[f, a, c] = new_covs[f, c, a] = 0.5 * (new_covs[f, a, c] + new_covs[f, c, a])
    return new_points, new_covs


@kept(CORRECTION)
def correct(landmarks: Arrays, state: Arrays, camera: Arrays, rules: Array) -> Arrays:
    """Correct the pose by N landmarks, then the landmarks by the pose; see :data:`CORRECTION`.

    Returns the error (d,) that the state moves by, the motion (1, 4, 4) of its pose, its covariance (d, d); points and
    covariances of the landmarks; the NIS (N,) of the sightings and which passed the pose's gate (N,).
    """
    points = landmarks[0]
    pose, P = state
    intrinsics, T_imu_cam, noises = camera
    eye = (intrinsics, inverses(T_imu_cam), np.eye(3))
    information, nis, accepted = np.zeros((6, 7)), np.empty(points.shape[0]), np.empty(points.shape[0], dtype=np.bool_)
    inverse = inverses(pose)
    informed_pose(landmarks, ((inverse, pose, inverse), P), eye, noises, rules, (information, nis, accepted))
    moved_by, cov = corrected_pose(information, P)
    step = np.zeros((1, 4, 4))
    exponential(moved_by, step)
    pose = products(pose, step)
    inverse = inverses(pose)
    points, covs = correct_landmarks(landmarks, ((inverse, pose, inverse), cov), eye, noises, rules, accepted)
    return moved_by, step, cov, points, covs, nis, accepted


@kept(START)
def start(uvs_px: Array, pose: Array, camera: Arrays) -> tuple[Array, Array]:
    """Return N landmarks triangulated from stereo, points (N, 3) and covariances (N, 3, 3); see :data:`START`.

    With the disparity d the depth is ``z = fx b / d``, so that ``dz/duL = -z / d = -dz/duR``; for the coordinates
    across and down this is multiplied by ``(uL - cx) / fx`` and ``(v - cy) / fy`` (Kang, eqs. 3-5).
    """
    intrinsics, T_imu_cam, noises = camera
    fx, fy, cx, cy, baseline_m = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3], intrinsics[4]
    T_world_cam = products(pose, T_imu_cam)
    count = uvs_px.shape[0]
    points, covs, D = np.empty((count, 3)), np.zeros((count, 3, 3)), np.empty((3, 3))
    for f in range(count):
        disparity_px = uvs_px[f, 0] - uvs_px[f, 1]
        z = fx * baseline_m / disparity_px
        across, down, steep = (uvs_px[f, 0] - cx) / fx, (uvs_px[f, 2] - cy) / fy, z / disparity_px
        points[f, 0], points[f, 1], points[f, 2] = moved(T_world_cam, 0, across * z, down * z, z)
        for i in range(3):
            toward = T_world_cam[0, i, 0] * across + T_world_cam[0, i, 1] * down + T_world_cam[0, i, 2]
            D[i, 0] = T_world_cam[0, i, 0] * z / fx - toward * steep
            D[i, 1] = toward * steep
            D[i, 2] = T_world_cam[0, i, 1] * z / fy
        add_carried(D, noises[0], 3, covs[f])
    return points, covs


COMPILED = what_was_compiled(correct, "the correction of pose and landmarks was")
