"""Parts of corrections compiled: motions, images, residuals after elimination of landmarks, the test of a correction.

The NumPy definitions are ``toolkit.geometry.se3_exp``, ``multiview.NUMPY``, ``residual_correlation`` and
``toolkit.models.corrections``. Source of the eigenvalues: Golub & Van Loan, "Matrix Computations" (4th ed.), 8.3
(tridiagonal QR).
"""

import math

import numpy as np
from numba import types

from filters.kalman.kernels.algebra import inverses, products, reflect_both_sides, solved_3
from filters.kalman.kernels.compiling import compiled, kept, what_was_compiled
from filters.kalman.kernels.rigid_motions import exponential, logarithm
from filters.kalman.kernels.sightings import add_products, linearise, sighted
from filters.kalman.kernels.signatures import CAMERA, MASK, MATRIX, ROW, STACK, Arrays
from toolkit.geometry import Array, BoolArray, IntArray

# (uL, uR, v) (F, W, 3) px and which were seen (F, W); points (F, 3); poses (W, 4, 4); camera; how many sightings a
# track needs.
RESIDUALS = (types.Tuple((STACK, MASK)), MATRIX, STACK, CAMERA, types.int64)
# Pose (1, 4, 4), velocity m/s and bias (9,), and covariance (d, d), before and after; the indices of velocity, accel
# bias and gyro bias in the error (3,), -1 for what it lacks; the least share of the variance that counts as corrected.
_STATE = types.Tuple((STACK, ROW, MATRIX))
CORRECTION = (_STATE, _STATE, types.int64[::1], types.float64)
# Points (F, 3), poses (W, 4, 4), camera.
IMAGES = (MATRIX, STACK, CAMERA)
# An eigenvalue usually takes two or three.
_MOST_STEPS = 30


@kept((MATRIX,))
def exponentials(twists: Array) -> Array:
    """Return the motions (N, 4, 4) of twists (N, 6), [rotation, translation], by the exponential map."""
    motions = np.empty((twists.shape[0], 4, 4))
    for k in range(twists.shape[0]):
        exponential(twists[k], motions[k : k + 1])
    return motions


@kept(IMAGES)
def predict_images(points: Array, poses: Array, camera: Arrays) -> Arrays:
    """Return the images of F points in W poses, (uL, uR, v) (F, W, 3) px, Jacobians and depths; see :data:`IMAGES`.

    The Jacobians to the pose (F, W, 18) and to the point (F, W, 9) are flattened row by row; depths (F, W) m.
    """
    count, window = points.shape[0], poses.shape[0]
    latest, eye = inverses(poses), (camera[0], inverses(camera[1]), np.zeros((3, 3)))
    uvs_px, depths, where = np.zeros((count, window, 3)), np.empty((count, window)), np.zeros(1, dtype=np.int64)
    d_pose, d_point = np.empty((count, window, 18)), np.empty((count, window, 9))
    H_pose, H_point = np.empty((3, 6)), np.empty((3, 4))
    for i in range(3):
        eye[2][i, i] = 1.0
    for f in range(count):
        for j in range(window):
            where[0] = j
            depths[f, j] = linearise(points, f, uvs_px, where, (latest, poses, latest), eye, (H_pose, H_point))
            for i in range(3):
                uvs_px[f, j, i] = -H_point[i, 3]
                for c in range(6):
                    d_pose[f, j, 6 * i + c] = H_pose[i, c]
                for c in range(3):
                    d_point[f, j, 3 * i + c] = H_point[i, c]
    return uvs_px, d_pose, d_point, depths


@compiled
def pairs_in(seen: BoolArray, fewest: int) -> int:
    """Return the number of pairs of successive sightings in tracks of at least ``fewest`` sightings."""
    count = 0
    for f in range(seen.shape[0]):
        if sighted(seen, f).size >= fewest:
            for j in range(1, seen.shape[1]):
                count += seen[f, j] and seen[f, j - 1]
    return count


@compiled
def take_up(A: Array, n: int) -> None:
    """Subtract from the residuals in the last column of A (n, 4) their projection onto its landmark columns."""
    N = np.zeros((1, 10))
    add_products(A, 0, n, N, 0)
    x, y, z = solved_3(N, 0, 0.0, 0.0)
    for i in range(n):
        A[i, 3] -= A[i, 0] * x + A[i, 1] * y + A[i, 2] * z


@kept(RESIDUALS)
def successive_residuals(sightings: Arrays, points: Array, poses: Array, camera: Arrays, fewest: int) -> Arrays:
    """Return whitened residuals (n, 3) of tracks after a landmark step, and those at the next pose (n, 3).

    See :data:`RESIDUALS` for the arguments.
    """
    uvs_px, seen = sightings
    intrinsics, T_imu_cam, whitener, _, _ = camera
    latest, T_cam_imu, most = inverses(poses), inverses(T_imu_cam), 3 * seen.shape[1]
    H_pose, A, pairs, at = np.empty((most, 6)), np.empty((most, 4)), pairs_in(seen, fewest), 0
    before, after = np.empty((pairs, 3)), np.empty((pairs, 3))
    for f in range(seen.shape[0]):
        where = sighted(seen, f)
        if where.size >= fewest:
            linearise(points, f, uvs_px, where, (latest, poses, latest), (intrinsics, T_cam_imu, whitener), (H_pose, A))
            take_up(A, 3 * where.size)
            for k in range(1, where.size):
                if where[k] == where[k - 1] + 1:
                    for i in range(3):
                        before[at, i], after[at, i] = A[3 * k - 3 + i, 3], A[3 * k + i, 3]
                    at += 1
    return before, after


@compiled
def error_between(before: Arrays, after: Arrays, places: IntArray, error: Array) -> None:
    """Write the error (d,) that moves one state to the other to ``error``."""
    pose, vector, _ = before
    logarithm(products(inverses(pose), after[0]), error)
    for block in range(3):
        for i in range(3):
            if places[block] >= 0:
                moved = 0.0
                for k in range(3):
                    turn = pose[0, k, i] if block == 0 else 1.0 if k == i else 0.0
                    moved += turn * (after[1][3 * block + k] - vector[3 * block + k])
                error[places[block] + i] = moved


@compiled
def tridiagonalise(A: Array, y: Array, diagonal: Array, beside: Array) -> None:
    """Write the diagonal (n,) and off-diagonal (n,) of the tridiagonal ``Q A Q^T``; replace y (n,) by Q y.

    Q is a product of reflections, each of which leaves one element of a column below the diagonal.
    """
    n, V = A.shape[0], np.empty((1, A.shape[0]))
    for k in range(n - 2):
        below, alpha, dot = 0.0, A[k + 1, k], 0.0
        for i in range(k + 2, n):
            below += A[i, k] * A[i, k]
        if below > 0.0:
            beta = -math.copysign(math.sqrt(alpha * alpha + below), alpha)
            tau = (beta - alpha) / beta
            for i in range(n):
                V[0, i] = 0.0 if i <= k else 1.0 if i == k + 1 else A[i, k] / (alpha - beta)
                dot += V[0, i] * y[i]
            reflect_both_sides(A, V, 0, tau, n)
            for i in range(n):
                y[i] -= tau * dot * V[0, i]
    for i in range(n):
        diagonal[i], beside[i] = A[i, i], A[i + 1, i] if i < n - 1 else 0.0


@compiled
def chase(diagonal: Array, beside: Array, y: Array, first: int, last: int) -> None:
    """Take one implicit QL step with Wilkinson's shift on the rows ``first`` to ``last``; rotate y as well."""
    g = (diagonal[first + 1] - diagonal[first]) / (2.0 * beside[first])
    g = diagonal[last] - diagonal[first] + beside[first] / (g + math.copysign(math.sqrt(g * g + 1.0), g))
    s, c, shift = 1.0, 1.0, 0.0
    for i in range(last - 1, first - 1, -1):
        f, b = s * beside[i], c * beside[i]
        r = math.sqrt(f * f + g * g)
        s, c = (f / r, g / r) if r > 0.0 else (0.0, 1.0)
        beside[i + 1] = r
        g = diagonal[i + 1] - shift
        r = (diagonal[i] - g) * s + 2.0 * c * b
        shift = s * r
        diagonal[i + 1] = g + shift
        g = c * r - b
        y[i], y[i + 1] = c * y[i] - s * y[i + 1], s * y[i] + c * y[i + 1]
    diagonal[first] -= shift
    beside[first], beside[last] = g, 0.0


@compiled
def diagonalise(A: Array, y: Array, eigenvalues: Array) -> None:
    """Write the eigenvalues (n,) of a symmetric A (n, n), which is destroyed; rotate y (n,) to the eigenvectors."""
    n, beside = A.shape[0], np.empty(A.shape[0])
    tridiagonalise(A, y, eigenvalues, beside)
    for first in range(n):
        for _ in range(_MOST_STEPS):
            last = first
            while last < n - 1 and abs(beside[last]) > 1e-16 * (abs(eigenvalues[last]) + abs(eigenvalues[last + 1])):
                last += 1
            if last > first:
                chase(eigenvalues, beside, y, first, last)


@kept(CORRECTION)
def test_correction(before: Arrays, after: Arrays, places: IntArray, least: float) -> Arrays:
    """Return the NIS and degrees of freedom of a correction; see :data:`CORRECTION`.

    The reduction of the covariance, with entries in units of the sigmas before it, is diagonalised, and the error is
    rotated to its eigenvectors.
    """
    P, Q, d = before[2], after[2], before[2].shape[0]
    error, taken, shares = np.empty(d), np.empty((d, d)), np.empty(d)
    error_between(before, after, places, error)
    for i in range(d):
        error[i] = error[i] / math.sqrt(P[i, i]) if P[i, i] > 0.0 else 0.0
        for j in range(d):
            known = P[i, i] > 0.0 and P[j, j] > 0.0
            taken[i, j] = (P[i, j] - Q[i, j]) / math.sqrt(P[i, i] * P[j, j]) if known else 0.0
    diagonalise(taken, error, shares)
    for i in range(d):
        least = max(least, -shares[i])
    nis, dof = 0.0, 0
    for i in range(d):
        if shares[i] > least:
            nis += error[i] * error[i] / shares[i]
            dof += 1
    return nis, dof


COMPILED = what_was_compiled(test_correction, "the parts of a correction were")
