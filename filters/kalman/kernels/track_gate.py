"""The track gate compiled: the mathematics of ``track_gate``'s NumPy, one track after another.

NumPy pads all tracks to the whole window and computes them at once; compiled, the cost of a track depends on its own m
sightings. The covariance is not formed in the null space of the landmark: ``S = H_x P H_x^T`` is made of 3x3 blocks,
one for every pair of poses, and the reflections that eliminate the landmark are applied to it from both sides. The
resulting rows span the same space as NumPy's in another basis: NIS, ``H^T H`` and ``H^T r`` are the same.

Sources: Mourikis & Roumeliotis 2007, "A multi-state constraint Kalman filter for vision-aided inertial navigation",
eqs. 17-26 and appendix; Golub & Van Loan, "Matrix Computations" (4th ed.), 5.1 (reflections and their products).
"""

import numpy as np
from numba import types

from filters.kalman.kernels.algebra import (
    cholesky,
    inverses,
    invert,
    moved,
    products,
    reflect_both_sides,
    reflections,
    solved_3,
)
from filters.kalman.kernels.compiling import compiled, kept, what_was_compiled
from filters.kalman.kernels.sightings import (
    add_products,
    first_guess,
    linearise,
    project,
    sighted,
)
from filters.kalman.kernels.signatures import CAMERA, MASK, ROW, STACK, WINDOW, Arrays
from toolkit.geometry import Array, BoolArray, IntArray

# Sightings: (uL, uR, v) (F, W, 3) px, which were seen (F, W). Then window and camera, the rules numbered below, and
# bounds (3 W - 2,) of the NIS by degrees of freedom.
SIGNATURE = (types.Tuple((STACK, MASK)), WINDOW, CAMERA, ROW, ROW)
ITERATIONS, FIRST_DAMPING, RELATIVE_DECREASE, ROUNDING, LEAST_DISPARITY, LEAST_DEPTH, MISMATCHED = range(7)


@compiled
def normal_equations(
    points: Array, f: int, sightings: Arrays, T_cam_world: Array, eye: Arrays, N: Array, at: int
) -> tuple[float, float]:
    """Write ``[J r]^T [J r]`` of a track's whitened residuals r at its point to row ``at`` of N; see ``solved_3``.

    Return half the squared error, infinite where the point is behind a camera, and the least depth.
    """
    uvs_px, seen = sightings
    intrinsics, whitener = eye
    for c in range(10):
        N[at, c] = 0.0
    J, rows = np.empty((3, 4)), np.empty((3, 4))
    nearest = np.inf
    for j in range(seen.shape[1]):
        if seen[f, j]:
            x, y, z = moved(T_cam_world, j, points[at, 0], points[at, 1], points[at, 2])
            nearest = min(nearest, z)
            project(intrinsics, x, y, z, J)
            for i in range(3):
                a = whitener[i, 0] * J[0, 0] + whitener[i, 1] * J[1, 0]
                b = whitener[i, 2] * J[2, 1]
                c = whitener[i, 0] * J[0, 2] + whitener[i, 1] * J[1, 2] + whitener[i, 2] * J[2, 2]
                for d in range(3):
                    rows[i, d] = a * T_cam_world[j, 0, d] + b * T_cam_world[j, 1, d] + c * T_cam_world[j, 2, d]
                rows[i, 3] = 0.0
                for d in range(3):
                    rows[i, 3] += whitener[i, d] * (uvs_px[f, j, d] - J[d, 3])
            add_products(rows, 0, 3, N, at)
    return (0.5 * N[at, 9] if nearest > 0.0 else np.inf), nearest


@compiled
def triangulate(
    sightings: Arrays, poses: Array, T_imu_cam: Array, eye: Arrays, rules: Array, points: Array
) -> BoolArray:
    """Write the least-squares points of F tracks to ``points`` (F + 1, 3); return which are reliable (F,).

    As ``triangulation.triangulate``: steps of ``(A + lambda diag(A) + 1e-12) step = J^T r`` with ``A = J^T J``. All
    tracks stop together, as soon as no step has reduced the error of any track by the relative decrease.
    """
    uvs_px, seen = sightings
    count = seen.shape[0]
    T_world_cam = products(poses, T_imu_cam)
    T_cam_world = inverses(T_world_cam)
    reliable = np.empty(count, dtype=np.bool_)
    N, costs, depths, dampings = np.empty((count + 1, 10)), np.empty(count), np.empty(count), np.empty(count)
    for f in range(count):
        points[f, 0] = rules[LEAST_DISPARITY]
        reliable[f] = first_guess(uvs_px, seen, f, T_world_cam, eye[0], points) > rules[LEAST_DISPARITY]
        costs[f], depths[f] = normal_equations(points, f, sightings, T_cam_world, eye, N, f)
        dampings[f] = rules[FIRST_DAMPING]
    unsettled, iteration = True, 0
    while unsettled and iteration < rules[ITERATIONS]:
        unsettled, iteration = False, iteration + 1
        for f in range(count):
            x, y, z = solved_3(N, f, dampings[f], 1e-12)
            points[count, 0], points[count, 1], points[count, 2] = points[f, 0] + x, points[f, 1] + y, points[f, 2] + z
            cost, depth = normal_equations(points, f, sightings, T_cam_world, eye, N, count)
            unsettled = unsettled or cost < (1.0 - rules[RELATIVE_DECREASE]) * costs[f]
            if cost < (1.0 + rules[ROUNDING]) * costs[f]:
                for i in range(3):
                    points[f, i] = points[count, i]
                for i in range(10):
                    N[f, i] = N[count, i]
                costs[f], depths[f] = cost, depth
                dampings[f] *= 0.1
            else:
                dampings[f] *= 10.0
    for f in range(count):
        reliable[f] = reliable[f] and depths[f] > rules[LEAST_DEPTH]
    return reliable


@compiled
def carry_cov(where: IntArray, H_pose: Array, P: Array, S: Array) -> None:
    """Write ``H_x P H_x^T`` (3 m, 3 m) to S: the block of sightings i and j is ``H_i P_ij H_j^T``."""
    T = np.empty((3, P.shape[1]))
    for i in range(where.size):
        end = 6 * where[i] + 6
        for a in range(3):
            for c in range(end):
                T[a, c] = 0.0
            for b in range(6):
                factor, row = H_pose[3 * i + a, b], 6 * where[i] + b
                for c in range(end):
                    T[a, c] += factor * P[row, c]
        for j in range(i + 1):
            at = np.uint64(6 * where[j])
            for a in range(3):
                for b in range(3):
                    total = 0.0
                    for c in range(np.uint64(6)):
                        total += T[a, at + c] * H_pose[3 * j + b, c]
                    S[3 * i + a, 3 * j + b] = total
                    S[3 * j + b, 3 * i + a] = total


@compiled
def innovations(points: Array, f: int, sightings: Arrays, window: Arrays, eye: Arrays, work: Arrays) -> None:
    """Linearise track f.

    ``work`` gets the Jacobians to each pose (3 m, 6); the landmark's Jacobian and the residual (3 m, 4); and the
    covariance (3 m, 3 m) of the latter without their noise, ``H_x P H_x^T``.
    """
    uvs_px, where = sightings
    inverses_now, poses_at, inverses_at, P = window
    H_pose, H_point, S = work
    linearise(points, f, uvs_px, where, (inverses_now, poses_at, inverses_at), eye, (H_pose, H_point))
    carry_cov(where, H_pose, P, S)


@compiled
def nis_of(S: Array, n: int, residual: Array) -> float:
    """Return ``r^T (S + 1)^-1 r`` over all rows but the first three.

    The Cholesky factor L of those rows is left in S, ``L^-1 r`` in ``residual``.
    """
    for i in range(n):
        S[i, i] += 1.0
        for j in range(min(i, 3)):
            S[i, j] = S[j, i] = 0.0  # decouples the first three rows from the others
    cholesky(S, n)
    total = 0.0
    for i in range(3, n):
        residual[i] /= S[i, i]
        value = residual[i]
        for j in range(i + 1, n):
            residual[j] -= value * S[i, j]
        total += value * value
    return total


@compiled
def constraint_rows(where: IntArray, J: Array, V: Array, tau: Array, H: Array, first: int) -> None:
    """Write all but the first three rows of ``Q^T J`` to H (., 6 W), from row ``first`` on.

    J (3 m, 6) are Jacobians to the poses ``where`` (m,), which give the columns of H; a row depends on its own pose.
    The product of three reflections is ``Q^T = 1 - V T^T V^T`` with an upper triangular T. Its diagonal has their
    factors; above it ``T_ik = -tau_k sum_j T_ij v_j^T v_k`` (Schreiber & Van Loan 1989). Q itself is not formed.
    """
    n, T, reached = 3 * where.size, np.zeros((3, 3)), np.zeros((3, 6 * where.size))
    for k in range(3):
        T[k, k] = tau[k]
        for j in range(k):
            overlap = 0.0
            for i in range(k, n):
                overlap += V[j, i] * V[k, i]
            for i in range(j + 1):
                T[i, k] -= tau[k] * T[i, j] * overlap
    for i in range(n):
        begin = 6 * (i // 3)
        for a in range(3):
            weight = T[0, a] * V[0, i] + T[1, a] * V[1, i] + T[2, a] * V[2, i]
            for c in range(6):
                reached[a, begin + c] += weight * J[i, c]
    for i in range(3, n):
        row, x, y, z = first + i - 3, V[0, i], V[1, i], V[2, i]
        for c in range(H.shape[1]):
            H[row, c] = 0.0
        for k in range(where.size):
            at, to = np.uint64(6 * k), np.uint64(6 * where[k])
            for c in range(np.uint64(6)):
                own = J[i, c] if i // 3 == k else 0.0
                H[row, to + c] = own - x * reached[0, at + c] - y * reached[1, at + c] - z * reached[2, at + c]


@compiled
def worst_sighting(S: Array, n: int, rest: Array, V: Array, tau: Array) -> int:
    """Return which of a track's m sightings reduces its NIS most when left out: ``track_gate._worst_sighting``.

    S has the Cholesky factor and ``rest`` the residuals that ``nis_of`` leaves. With ``W = Q [0, 0; 0, S^-1] Q^T`` and
    w = W r the NIS falls by ``w_j^T W_jj^-1 w_j``.
    """
    W, w = np.empty((n, n)), np.zeros((n, 1))
    invert(S, n, W)
    for i in range(n - 1, 2, -1):
        w[i, 0] = rest[i]
        for k in range(i + 1, n):
            w[i, 0] -= S[k, i] * w[k, 0]
        w[i, 0] /= S[i, i]
    for k in range(2, -1, -1):
        reflect_both_sides(W, V, k, tau[k], n)
        dot = 0.0
        for i in range(n):
            dot += V[k, i] * w[i, 0]
        for i in range(n):
            w[i, 0] -= tau[k] * dot * V[k, i]
    worst, largest, N = 0, -1.0, np.empty((1, 10))
    for j in range(n // 3):
        at = 0
        for a in range(4):
            for b in range(a + 1):
                N[0, at] = W[3 * j + a, 3 * j + b] if a < 3 else w[3 * j + b, 0] if b < 3 else 0.0
                at += 1
        x, y, z = solved_3(N, N.shape[0] - 1, 0.0, 1e-12)
        fall = x * N[0, 6] + y * N[0, 7] + z * N[0, 8]
        if fall > largest:
            worst, largest = j, fall
    return worst


@kept(SIGNATURE)
def test_tracks(sightings: Arrays, window: Arrays, camera: Arrays, rules: Array, bounds: Array) -> Arrays:
    """Triangulate F tracks, linearise them, eliminate their landmarks and test them; see :data:`SIGNATURE`.

    Returns points (F + 1, 3), whose last row has no meaning; which are reliable (F,) (the other results are undefined
    for unreliable ones); the NIS (F,) and its degrees of freedom (F,); the worst sighting (F,), -1 where the NIS is not
    far above its bound; and the n stacked rows of the tracks below their bounds: H (n, 6 W), residuals (n,), and the
    index of each row's track among the reliable tracks (n,).
    """
    uvs_px, seen = sightings
    poses, poses_at, P = window
    intrinsics, T_imu_cam, whitener = camera
    count, longest = seen.shape
    points, nis = np.empty((count + 1, 3)), np.empty(count)
    worst, dof = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    reliable = triangulate((uvs_px, seen), poses, T_imu_cam, (intrinsics, whitener), rules, points)
    inverses_now, inverses_at, T_cam_imu = inverses(poses), inverses(poses_at), inverses(T_imu_cam)
    window_of_all, eye = (inverses_now, poses_at, inverses_at, P), (intrinsics, T_cam_imu, whitener)
    most, rows = 3 * longest, 0
    for f in range(count):
        dof[f] = 3 * sighted(seen, f).size - 3
        rows += max(dof[f], 0)
    H, residuals, owners = np.empty((rows, 2 * most)), np.empty(rows), np.empty(rows, dtype=np.int64)
    end, owner = 0, -1
    H_pose, H_point = np.empty((most, 6)), np.empty((most, 4))
    S, V, tau, rest = np.empty((most, most)), np.empty((3, most)), np.empty(3), np.empty(most)
    for f in range(count):
        nis[f], worst[f], where = np.inf, -1, sighted(seen, f)
        n = dof[f] + 3
        owner += reliable[f]
        if reliable[f] and n > 3:
            innovations(points, f, (uvs_px, where), window_of_all, eye, (H_pose, H_point, S))
            reflections(H_point, n, V, tau)
            for k in range(3):
                reflect_both_sides(S, V, k, tau[k], n)
            for i in range(n):
                rest[i] = H_point[i, 3]
            nis[f] = nis_of(S, n, rest)
            if nis[f] < bounds[n - 3]:
                constraint_rows(where, H_pose, V, tau, H, end)
                for i in range(3, n):
                    residuals[end], owners[end] = H_point[i, 3], owner
                    end += 1
            elif nis[f] > rules[MISMATCHED] * bounds[n - 3]:
                worst[f] = where[worst_sighting(S, n, rest, V, tau)]
    return points, reliable, nis, dof, worst, H[:end], residuals[:end], owners[:end]


COMPILED = what_was_compiled(test_tracks, "the track gate was")
