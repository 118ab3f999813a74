"""What tracks in view tell compiled: the normal equations of ``tracks_in_view``'s NumPy, one track after another.

A track's rows are ``[H_f r]`` (3 m, 4) and J (3 m, 6 m), to its landmark and to the poses of its m sightings, the
newest last. Of them are made ``[H_f r]^T [H_f r]`` and ``B = H_f^T J``, and of these with ``V = (H_f^T H_f)^-1`` what
is left on the poses, ``J^T J - B^T V B`` and ``J^T r - B^T V H_f^T r`` (Triggs, McLauchlan, Hartley & Fitzgibbon 2000,
"Bundle adjustment - a modern synthesis", section 6.1).
"""

import math

import numpy as np
from numba import types

from filters.kalman.kernels.algebra import clear, inverses, solved_3
from filters.kalman.kernels.compiling import (
    CAMERA,
    COUNTS,
    MASK,
    MATRIX,
    ROW,
    STACK,
    WINDOW,
    Arrays,
    compiled,
    kept,
    what_was_compiled,
)
from filters.kalman.kernels.sightings import (
    add_products,
    decorrelate,
    linearise,
    noise_roots,
    own_jacobians,
    sighted,
    step,
)
from toolkit.geometry import Array, IntArray

# Tracks: (uL, uR, v) (F, W, 3) px, which count (F, W), their ages (F, W), what for (F, W), points (F, 3). Then window
# and camera, and rules as numbered below.
SIGNATURE = (types.Tuple((STACK, MASK, COUNTS, MATRIX, MATRIX)), WINDOW, CAMERA, ROW)
LEAST_DEPTH, BOUND, HUBER_THRESHOLD = range(3)


@compiled
def add_normals(rows: Arrays, first: int, end: int, N: Array, B: Array) -> None:
    """Add some rows of a track to ``[H_f r]^T [H_f r]`` in the first row of N, and to B (3, 6 m)."""
    A, J, dense = rows
    add_products(A, first, end, N, 0)
    for i in range(first, end):
        for a in range(3):
            for c in range(0 if dense else 6 * (i // 3), 6 * (i // 3) + 6):
                B[a, c] += A[i, a] * J[i, c]


@compiled
def given_others(rows: Arrays, n: int, N: Array, B: Array, H: Array, S: Array) -> None:
    """Put the newest sighting's Jacobian to the poses, given the others, in H (3, 6 m); its noise and innovation in S.

    N and B are of the others, which put the landmark at ``V (b + B x)``; of it the newest sees ``H_f V (b + B x)``.
    S has ``[covariance, innovation]`` in its first row as ``solved_3`` takes them.
    """
    A, J, _ = rows
    T, at = np.empty((3, 3)), 0
    for a in range(3):
        for c in range(6):
            N[1, c] = N[0, c]
        for d in range(3):
            N[1, 6 + d] = A[n - 3 + a, d]
        x, y, z = solved_3(N, 1, 0.0, 0.0)
        T[a, 0], T[a, 1], T[a, 2] = x, y, z
        for c in range(2 * n):
            H[a, c] = J[n - 3 + a, c] - x * B[0, c] - y * B[1, c] - z * B[2, c]
        S[0, 6 + a] = A[n - 3 + a, 3] - x * N[0, 6] - y * N[0, 7] - z * N[0, 8]
        for b in range(a + 1):
            S[0, at] = 1.0 if a == b else 0.0
            for d in range(3):
                S[0, at] += T[a, d] * A[n - 3 + b, d]
            at += 1


@compiled
def add_carried(where: IntArray, H: Array, P: Array, T: Array, S: Array) -> None:
    """Add ``T H^T``, with ``T = H P`` (3, 6 W) and H (3, 6 m) to the poses ``where`` (m,), to what S has of it.

    Rows of P are added up, which a processor does four numbers at a time.
    """
    at = 0
    for a in range(3):
        for c in range(P.shape[1]):
            T[a, c] = 0.0
        for k in range(6 * where.size):
            row, factor = 6 * where[k // 6] + k % 6, H[a, k]
            for c in range(P.shape[1]):
                T[a, c] += factor * P[row, c]
        for b in range(a + 1):
            for k in range(6 * where.size):
                S[0, at] += T[a, 6 * where[k // 6] + k % 6] * H[b, k]
            at += 1


@compiled
def weight_of(S: Array, bound: float, huber_threshold: float) -> float:
    """Return what a sighting counts for whose innovation and its covariance are in the first row of S."""
    x, y, z = solved_3(S, S.shape[0] - 1, 0.0, 0.0)
    nis = x * S[0, 6] + y * S[0, 7] + z * S[0, 8]
    return min(1.0, huber_threshold / math.sqrt(max(nis, 1e-12))) if nis < bound else 0.0


@compiled
def scale(rows: Arrays, first: int, end: int, factor: float) -> None:
    """Multiply some rows of a track."""
    A, J, dense = rows
    for i in range(first, end):
        for c in range(4):
            A[i, c] *= factor
        for c in range(0 if dense else 6 * (i // 3), 6 * (i // 3) + 6):
            J[i, c] *= factor


@compiled
def add_products_of_poses(where: IntArray, rows: Arrays, n: int, told: Arrays) -> None:
    """Add ``J^T J`` and ``J^T r`` of n rows to the lower half of what is told of all poses.

    r is the last column of A; unless dense, a row depends on its own pose alone.
    """
    A, J, dense = rows
    matrix, vector = told
    for i in range(n):
        for k in range(0 if dense else i // 3, where.size if dense else i // 3 + 1):
            for a in range(6 * k, 6 * k + 6):
                row, value = 6 * where[k] + a - 6 * k, J[i, a]
                vector[row] += value * A[i, 3]
                for j in range(0 if dense else k, k + 1):
                    for c in range(6 * j, 6 * j + 6):
                        matrix[row, 6 * where[j] + c - 6 * j] += value * J[i, c]


@compiled
def eliminated_rows(N: Array, B: Array, where: IntArray, E: Array, first: int) -> None:
    """Put ``C^-1 [B, H_f^T r]``, C being the root of ``H_f^T H_f``, in three rows of E (., 6 W + 1) from ``first`` on.

    N has ``[H_f r]^T [H_f r]`` in its first row; B (3, 6 m) is to the poses ``where`` (m,).
    """
    l00 = math.sqrt(N[0, 0])
    l10, l20 = N[0, 1] / l00, N[0, 3] / l00
    l11 = math.sqrt(N[0, 2] - l10 * l10)
    l21 = (N[0, 4] - l20 * l10) / l11
    l22 = math.sqrt(N[0, 5] - l20 * l20 - l21 * l21)
    for k in range(6 * where.size + 1):
        own = k < 6 * where.size
        column = 6 * where[k // 6] + k % 6 if own else E.shape[1] - 1
        x = (B[0, k] if own else N[0, 6]) / l00
        y = ((B[1, k] if own else N[0, 7]) - l10 * x) / l11
        z = ((B[2, k] if own else N[0, 8]) - l20 * x - l21 * y) / l22
        E[first, column], E[first + 1, column], E[first + 2, column] = x, y, z


@compiled
def mirror(A: Array) -> None:
    """Put the lower half of a symmetric matrix (n, n) in its upper half."""
    for i in range(A.shape[0]):
        for j in range(i):
            A[j, i] = A[i, j]


@kept(SIGNATURE)
def told_by_tracks(tracks: Arrays, window: Arrays, camera: Arrays, rules: Array) -> Arrays:
    """Gate the newest sightings of F tracks and return what the tracks tell of the W poses; see :data:`SIGNATURE`.

    Returns points (F, 3) after a step, what the newest sightings count for (F,), which tracks all their cameras have
    in front (F,): of others nothing is told; ``J^T J`` (6 W, 6 W) and ``J^T r`` (6 W,) of all tracks, and what the
    landmarks take of both, ``E^T E``, as the rows E (3 F, 6 W + 1): a product of whole matrices is left to BLAS.
    """
    uvs_px, counted, ages, weights, points = tracks
    poses, poses_at, P = window
    intrinsics, T_imu_cam, whitener, variances, channels = camera
    (count, longest), correlated = counted.shape, variances.shape[0] > 0
    inverses_now, inverses_at, T_cam_imu = inverses(poses), inverses(poses_at), inverses(T_imu_cam)
    views, eye = (inverses_now, poses_at, inverses_at), (intrinsics, T_cam_imu, channels if correlated else whitener)
    newest, in_front, stepped = np.zeros(count), np.empty(count, dtype=np.bool_), points.copy()
    told, most = (np.zeros((6 * longest, 6 * longest)), np.zeros(6 * longest)), 3 * longest
    H_pose, A, J = np.empty((most, 6)), np.empty((most, 4)), np.empty((most, 2 * most))
    roots, H, B = np.empty((most, longest)), np.empty((3, 2 * most)), np.empty((3, 2 * most))
    N, S, T, E = np.empty((2, 10)), np.empty((1, 10)), np.empty((3, 2 * most)), np.zeros((3 * count, 2 * most + 1))
    for f in range(count):
        where = sighted(counted, f)
        m, n, rows = where.size, 3 * where.size, (A, J, correlated)
        nearest_m = linearise(points, f, uvs_px, where, views, eye, (H_pose, A))
        in_front[f] = nearest_m > rules[LEAST_DEPTH]
        if in_front[f]:
            if correlated:
                noise_roots(ages, f, where, variances, roots)
                decorrelate(roots, m, A, A.shape[1])
            own_jacobians(H_pose, m, roots, correlated, J)
            for k in range(m - 1):
                if weights[f, where[k]] < 1.0:
                    scale(rows, 3 * k, 3 * k + 3, math.sqrt(weights[f, where[k]]))
            clear(N, 1)
            clear(B, 3)
            add_normals(rows, 0, n - 3, N, B)
            given_others(rows, n, N, B, H, S)
            add_carried(where, H, P, T, S)
            newest[f] = weight_of(S, rules[BOUND], rules[HUBER_THRESHOLD])
            scale(rows, n - 3, n, math.sqrt(newest[f]))
            add_normals(rows, n - 3, n, N, B)
            step(stepped, f, nearest_m, N)
            add_products_of_poses(where, rows, n, told)
            eliminated_rows(N, B, where, E, 3 * f)
    mirror(told[0])
    return stepped, newest, in_front, told[0], told[1], E


COMPILED = what_was_compiled(told_by_tracks, "what tracks in view tell was")
