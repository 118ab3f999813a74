"""What the MSCKFs compute of each of their tracks, compiled: triangulation, test, elimination of the landmark.

A track has a landmark f and sightings from m poses. Linearised and whitened they are ``r = H_x x + H_f f + n``: r
(3 m,), H_x with the block J (3, 6) of each sighting in the columns of its pose, H_f (3 m, 3), n of unit variance. H_f
and r are kept side by side, ``A = [H_f r]`` (3 m, 4). A sighting without its right image keeps three rows, of which
that of uR is zero.

Sources: Mourikis & Roumeliotis 2007, "A multi-state constraint Kalman filter for vision-aided inertial navigation",
eqs. 17-26 and appendix; Triggs, McLauchlan, Hartley & Fitzgibbon 2000, "Bundle adjustment - a modern synthesis",
section 6.1; Golub & Van Loan, "Matrix Computations" (4th ed.), 4.1-4.2 (roots), 5.1 (reflections).

Only this module imports numba, which takes half a second, so it is imported when an MSCKF is built. All kernels are in
one file because numba's cache looks at a function's own file alone; what is defined elsewhere is an argument for the
same reason. Loops over scalars compile several times as fast as expressions of arrays.
"""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit, types

from toolkit.geometry import Array, BoolArray, IntArray

_BEGAN_CPU_S = time.process_time()
# Levenberg-Marquardt. The landmark is eliminated to first order afterwards, so a fit to better than a hundredth of a
# sigma has no effect. A step that raises the error by no more than rounding is accepted.
ITERATIONS, FIRST_DAMPING, RELATIVE_DECREASE, ROUNDING = 6, 1e-2, 1e-4, 1e-12
# Information added to where rays meet: that of rays that are parallel to within a thousandth of a radian.
LEAST_RAY = 1e-6

Arrays = tuple[Any, ...]
_ROW, _MATRIX, _STACK = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]
_MASK = types.boolean[:, ::1]
# T_world_imu (W, 4, 4) of the window's poses, at present and where Jacobians are evaluated.
_WINDOW = types.Tuple((_STACK, _STACK))
# fx, fy, cx, cy px and baseline m (5,); the whiteners (3, 3) of sightings in both images and in the left one alone;
# T_cam_imu (4, 4).
_CAMERA = types.Tuple((_ROW, _MATRIX, _MATRIX, _MATRIX))
# The least disparity px and the least depth m.
_LIMITS = types.Tuple((types.float64, types.float64))
# As NumPy does, a division by zero gives infinity.
_OPTIONS = {"error_model": "numpy"}


def compiled(function: Callable[..., Any]) -> Any:
    """Return a function that kernels may call; it is compiled for the first of them that does, and inlined.

    LLVM by itself leaves some as calls that pass every array as ten values; the kernels then take 1.2 times as long.
    numba would compile a function anew for each number that it is called with literally; here it does not.
    """
    dispatcher = njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, forceinline=True, **_OPTIONS)(function)
    template_for = dispatcher.get_call_template
    dispatcher.get_call_template = lambda args, named: template_for([types.unliteral(arg) for arg in args], named)
    return dispatcher


def kernel(*signature: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function for some argument types, or takes it from numba's cache.

    Where nothing can be cached (no folder that can be written, a full disk, a damaged file), the compiled code lasts
    for this process.
    """

    def compile_or_load(function: Callable[..., Any]) -> Any:
        try:
            return njit(signature, cache=True, **_OPTIONS)(function)
        except Exception:  # a defect of the function itself is raised again by the next line
            return njit(signature, **_OPTIONS)(function)

    return compile_or_load


@compiled
def sighted(used: BoolArray | Array, f: int, where: IntArray) -> int:
    """Write the indices of the poses of a track's sightings to ``where`` (W,); return their number."""
    count = 0
    for j in range(used.shape[1]):
        if used[f, j] > 0:
            where[count] = j
            count += 1
    return count


@compiled
def in_camera(poses: Array, camera: Arrays) -> Array:
    """Return T_cam_world (W, 4, 4), without the last row, of poses T_world_imu (W, 4, 4)."""
    T_cam_imu, T = camera[3], np.empty(poses.shape)
    for j in range(poses.shape[0]):
        for i in range(3):
            T[j, i, 3] = T_cam_imu[i, 3]
            for d in range(3):
                T[j, i, d] = 0.0
                for c in range(3):
                    T[j, i, d] += T_cam_imu[i, c] * poses[j, d, c]
                T[j, i, 3] -= T[j, i, d] * poses[j, d, 3]
    return T


@compiled
def moved(T: Array, j: int, points: Array, f: int) -> tuple[float, float, float]:
    """Return point f transformed by motion j of T (W, 4, 4)."""
    x, y, z = points[f, 0], points[f, 1], points[f, 2]
    return (
        T[j, 0, 0] * x + T[j, 0, 1] * y + T[j, 0, 2] * z + T[j, 0, 3],
        T[j, 1, 0] * x + T[j, 1, 1] * y + T[j, 1, 2] * z + T[j, 1, 3],
        T[j, 2, 0] * x + T[j, 2, 1] * y + T[j, 2, 2] * z + T[j, 2, 3],
    )


@compiled
def divisible(depth: float) -> float:
    """Return a depth m to divide by: a millimetre within that distance of the camera's plane, as in ``stereo``."""
    return depth if abs(depth) >= 1e-3 else 1e-3


@compiled
def linearise_point(
    points: Array, f: int, uvs_px: Array, t: int, j: int, window: Arrays, camera: Arrays, A: Array, at: int
) -> float:
    """Write the rows ``[H_f r]`` of track t's sighting j to A, from row ``at`` on; return the depth of point f.

    ``window`` has T_cam_world (W, 4, 4), for the residual, and T_cam_world and T_world_imu (W, 4, 4) for the Jacobian.
    """
    T_cam_world, T_cam_world_at, _ = window
    intrinsics, whitener, left_whitener, _ = camera
    fx, fy, cx, cy, baseline_m = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3], intrinsics[4]
    x, y, depth = moved(T_cam_world, j, points, f)
    z = divisible(depth)
    r0 = uvs_px[t, j, 0] - (fx * x / z + cx)
    r1 = uvs_px[t, j, 1] - (fx * (x - baseline_m) / z + cx)
    r2 = uvs_px[t, j, 2] - (fy * y / z + cy)
    W = whitener
    if math.isnan(r1):
        W, r1 = left_whitener, 0.0
    x, y, z = moved(T_cam_world_at, j, points, f)
    per_z = 1.0 / divisible(z)
    across, down = fx * per_z, fy * per_z
    for i in range(3):
        a, b = (W[i, 0] + W[i, 1]) * across, W[i, 2] * down
        c = -((W[i, 0] * x + W[i, 1] * (x - baseline_m)) * across + W[i, 2] * y * down) * per_z
        for d in range(3):
            A[at + i, d] = a * T_cam_world_at[j, 0, d] + b * T_cam_world_at[j, 1, d] + c * T_cam_world_at[j, 2, d]
        A[at + i, 3] = W[i, 0] * r0 + W[i, 1] * r1 + W[i, 2] * r2
    return depth


@compiled
def linearise(
    points: Array, f: int, uvs_px: Array, where: IntArray, m: int, window: Arrays, camera: Arrays, out: Arrays
) -> float:
    """Write A (3 m, 4) and J (3 m, 6) of track f; return its least depth.

    J is to the pose's error [rotation, position] on the right: ``J = [H_f [p - t]_x R, -H_f R]`` for the point p and
    the pose (R, t).
    """
    A, J = out
    poses_at, nearest = window[2], np.inf
    for k in range(m):
        j = where[k]
        nearest = min(nearest, linearise_point(points, f, uvs_px, f, j, window, camera, A, 3 * k))
        x, y, z = points[f, 0] - poses_at[j, 0, 3], points[f, 1] - poses_at[j, 1, 3], points[f, 2] - poses_at[j, 2, 3]
        for i in range(3 * k, 3 * k + 3):
            a, b, c = A[i, 0], A[i, 1], A[i, 2]
            u, v, w = b * z - c * y, c * x - a * z, a * y - b * x
            for d in range(3):
                J[i, d] = u * poses_at[j, 0, d] + v * poses_at[j, 1, d] + w * poses_at[j, 2, d]
                J[i, 3 + d] = -(a * poses_at[j, 0, d] + b * poses_at[j, 1, d] + c * poses_at[j, 2, d])
    return nearest


@compiled
def add_normals(A: Array, first: int, end: int, N: Array, f: int) -> None:
    """Add ``A^T A`` of some rows of A (., 4) to N[f] (4, 4), of which only the lower half is used."""
    for i in range(first, end):
        for a in range(4):
            for b in range(a + 1):
                N[f, a, b] += A[i, a] * A[i, b]


@compiled
def clear(N: Array, f: int) -> None:
    """Set N[f] (4, 4) to zero."""
    for a in range(4):
        for b in range(4):
            N[f, a, b] = 0.0


@compiled
def solve(N: Array, f: int, damping: float, least: float, b: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the solution x of ``(H + damping diag(H) + least) x = b`` by ``L D L^T``, H being N[f]'s first 3 x 3."""
    d0 = N[f, 0, 0] * (1.0 + damping) + least
    l10, l20 = N[f, 1, 0] / d0, N[f, 2, 0] / d0
    d1 = N[f, 1, 1] * (1.0 + damping) + least - l10 * N[f, 1, 0]
    l21 = (N[f, 2, 1] - l20 * N[f, 1, 0]) / d1
    d2 = N[f, 2, 2] * (1.0 + damping) + least - l20 * N[f, 2, 0] - l21 * l21 * d1
    y1 = b[1] - l10 * b[0]
    x2 = (b[2] - l20 * b[0] - l21 * y1) / d2
    x1 = y1 / d1 - l21 * x2
    return b[0] / d0 - l10 * x1 - l20 * x2, x1, x2


@compiled
def right_side(N: Array, f: int) -> tuple[float, float, float]:
    """Return ``H_f^T r`` of the normal equations N[f]."""
    return N[f, 3, 0], N[f, 3, 1], N[f, 3, 2]


@compiled
def is_determined(N: Array, f: int, depth_m: float) -> bool:
    """Say whether a point is determined to within its depth: every eigenvalue of its information exceeds 1/depth^2.

    By the rule of the least disparity, at which the depth is uncertain by 100 %. The pivots of ``H - 1/depth^2`` are
    positive.
    """
    least = 1.0 / (depth_m * depth_m)
    d0 = N[f, 0, 0] - least
    l10, l20 = N[f, 1, 0] / d0, N[f, 2, 0] / d0
    d1 = N[f, 1, 1] - least - l10 * N[f, 1, 0]
    l21 = (N[f, 2, 1] - l20 * N[f, 1, 0]) / d1
    return d0 > 0.0 and d1 > 0.0 and N[f, 2, 2] - least - l20 * N[f, 2, 0] - l21 * l21 * d1 > 0.0


@compiled
def left_ray(uvs_px: Array, f: int, j: int, T: Array, camera: Arrays) -> tuple[float, float, float]:
    """Return the ray of depth one, in world axes, along which the left image of pose j sees track f."""
    intrinsics = camera[0]
    x, y = (uvs_px[f, j, 0] - intrinsics[2]) / intrinsics[0], (uvs_px[f, j, 2] - intrinsics[3]) / intrinsics[1]
    return (
        T[j, 0, 0] * x + T[j, 1, 0] * y + T[j, 2, 0],
        T[j, 0, 1] * x + T[j, 1, 1] * y + T[j, 2, 1],
        T[j, 0, 2] * x + T[j, 1, 2] * y + T[j, 2, 2],
    )


@compiled
def centre(T: Array, j: int) -> tuple[float, float, float]:
    """Return the camera's centre in the world, of T_cam_world j of T (W, 4, 4)."""
    x, y, z = T[j, 0, 3], T[j, 1, 3], T[j, 2, 3]
    return (
        -T[j, 0, 0] * x - T[j, 1, 0] * y - T[j, 2, 0] * z,
        -T[j, 0, 1] * x - T[j, 1, 1] * y - T[j, 2, 1] * z,
        -T[j, 0, 2] * x - T[j, 1, 2] * y - T[j, 2, 2] * z,
    )


@compiled
def where_rays_meet(points: Array, f: int, uvs_px: Array, where: IntArray, m: int, T: Array, camera: Arrays) -> None:
    """Write to ``points[f]`` the point nearest to the rays of the left image; given is a point far along the first.

    The sum of squared distances to the rays is least where ``sum (1 - d d^T) p = sum (1 - d d^T) c``, with d their
    directions and c their centres. Parallel rays meet in the given point.
    """
    N = np.zeros((1, 4, 4))
    for d in range(3):
        N[0, 3, d] = LEAST_RAY * points[f, d]
    for k in range(m):
        ray, c = left_ray(uvs_px, f, where[k], T, camera), centre(T, where[k])
        squared = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]
        for a in range(3):
            for b in range(3):
                across = (1.0 if a == b else 0.0) - ray[a] * ray[b] / squared
                N[0, a, b] += across
                N[0, 3, a] += across * c[b]
    points[f, 0], points[f, 1], points[f, 2] = solve(N, 0, 0.0, LEAST_RAY, right_side(N, 0))


@compiled
def start_point(
    points: Array, f: int, uvs_px: Array, where: IntArray, m: int, T: Array, camera: Arrays, least_px: float
) -> tuple[bool, bool]:
    """Write a first guess of the landmark to ``points[f]``; say whether there is one, and whether it is a stereo point.

    It is the stereo point of the largest disparity. Where that is too small and right images are missing, it is the
    point where the rays of the left image meet best.
    """
    nearest, largest, left_only = 0, least_px, False
    for k in range(m):
        disparity = uvs_px[f, where[k], 0] - uvs_px[f, where[k], 1]
        left_only = left_only or math.isnan(disparity)
        if disparity > largest:
            nearest, largest = k, disparity
    depth = camera[0][0] * camera[0][4] / largest
    ray, c = left_ray(uvs_px, f, where[nearest], T, camera), centre(T, where[nearest])
    for d in range(3):
        points[f, d] = c[d] + depth * ray[d]
    wide = largest > least_px
    if left_only and not wide:
        where_rays_meet(points, f, uvs_px, where, m, T, camera)
    return wide or left_only, wide


@compiled
def normal_equations(
    points: Array, at: int, uvs_px: Array, f: int, where: IntArray, m: int, window: Arrays, camera: Arrays, N: Array
) -> tuple[float, float]:
    """Write ``[H_f r]^T [H_f r]`` of track f, with its landmark at ``points[at]``, to N[at].

    Return half the squared error, infinite where the point is behind a camera, and the least depth.
    """
    A, nearest = np.empty((3, 4)), np.inf
    clear(N, at)
    for k in range(m):
        nearest = min(nearest, linearise_point(points, at, uvs_px, f, where[k], window, camera, A, 0))
        add_normals(A, 0, 3, N, at)
    return (0.5 * N[at, 3, 3] if nearest > 0.0 else np.inf), nearest


@compiled
def triangulate(
    points: Array, f: int, uvs_px: Array, where: IntArray, m: int, window: Arrays, camera: Arrays, limits: Arrays
) -> bool:
    """Write the least-squares landmark of a track to ``points[f]``; say whether to rely on it.

    Levenberg-Marquardt: steps of ``(H + damping diag(H) + 1e-12) step = H_f^T r`` with ``H = H_f^T H_f``. A point is
    reliable if it lies in front of every pose that saw it and one disparity is large enough to determine its depth;
    where right images are missing, also if the sightings together determine it. ``window`` is linearised at the present
    poses.
    """
    least_px, least_m = limits
    started, determined = start_point(points, f, uvs_px, where, m, window[0], camera, least_px)
    if not started:
        return False
    tried, N, damping = np.empty((2, 3)), np.empty((2, 4, 4)), FIRST_DAMPING
    now, other, cost, depth = 1, 0, np.nan, 0.0
    for i in range(3):
        tried[other, i] = points[f, i]
    for _ in range(1 + ITERATIONS):
        cost_there, depth_there = normal_equations(tried, other, uvs_px, f, where, m, window, camera, N)
        if cost_there >= (1.0 + ROUNDING) * cost:  # not so for the first guess, which has none to compare with
            damping *= 10.0
        else:
            settled = cost_there >= (1.0 - RELATIVE_DECREASE) * cost
            now, other, cost, depth, damping = other, now, cost_there, depth_there, 0.1 * damping
            if settled:
                break
        x, y, z = solve(N, now, damping, 1e-12, right_side(N, now))
        tried[other, 0], tried[other, 1], tried[other, 2] = tried[now, 0] + x, tried[now, 1] + y, tried[now, 2] + z
    for i in range(3):
        points[f, i] = tried[now, i]
    return (determined or is_determined(N, now, depth)) and depth > least_m


@compiled
def carry_cov(where: IntArray, m: int, J: Array, P: Array, S: Array) -> None:
    """Write ``H_x P H_x^T + 1`` (3 m, 3 m) to S: the block of sightings i and k is ``J_i P_ik J_k^T``."""
    T = np.empty((3, P.shape[1]))
    for i in range(m):
        end = 6 * where[i] + 6
        for a in range(3):
            for c in range(end):
                T[a, c] = 0.0
            for b in range(6):
                factor, row = J[3 * i + a, b], 6 * where[i] + b
                for c in range(end):
                    T[a, c] += factor * P[row, c]
        for k in range(i + 1):
            at = np.uint64(6 * where[k])
            for a in range(3):
                for b in range(3):
                    total = 0.0
                    for c in range(np.uint64(6)):
                        total += T[a, at + c] * J[3 * k + b, c]
                    S[3 * i + a, 3 * k + b] = total
                    S[3 * k + b, 3 * i + a] = total
    for i in range(3 * m):
        S[i, i] += 1.0


@compiled
def cholesky(S: Array, n: int) -> None:
    """Overwrite the upper half of a symmetric S (n, n) by L^T, with ``L L^T = S``."""
    end = np.uint64(n)  # rows of unsigned indices are vectorised
    for k in range(n):
        root = math.sqrt(S[k, k])
        for c in range(np.uint64(k), end):
            S[k, c] /= root
        for i in range(np.uint64(k + 1), end):
            factor = S[k, i]
            for c in range(i, end):
                S[i, c] -= factor * S[k, c]


@compiled
def divide_by_root(S: Array, n: int, B: Array) -> None:
    """Overwrite B (n, 4) by ``L^-1 B``; the upper half of S has L^T."""
    for i in range(n):
        for c in range(4):
            B[i, c] /= S[i, i]
        for k in range(i + 1, n):
            for c in range(4):
                B[k, c] -= S[i, k] * B[i, c]


@compiled
def reflect(V: Array, k: int, B: Array, n: int, begin: int, end: int) -> None:
    """Multiply columns ``begin`` to ``end`` of B (n, .) by ``1 - v v^T``, with v row k of V (3, n)."""
    total = np.zeros(end - begin)
    for i in range(k, n):
        for c in range(end - begin):
            total[c] += V[k, i] * B[i, begin + c]
    for i in range(k, n):
        for c in range(end - begin):
            B[i, begin + c] -= V[k, i] * total[c]


@compiled
def reflect_landmark_away(A: Array, n: int, V: Array) -> None:
    """Triangularise H_f of ``A = [H_f r]`` (n, 4) by three reflections of both; their vectors are written to V (3, n).

    Rows of ``Q^T r`` from the fourth on do not depend on the landmark: Q's columns are the left null space of H_f.
    """
    for k in range(3):
        squared = 0.0
        for i in range(k):
            V[k, i] = 0.0
        for i in range(k, n):
            squared += A[i, k] * A[i, k]
        alpha = A[k, k] + math.copysign(math.sqrt(squared), A[k, k])
        squared += alpha * alpha - A[k, k] * A[k, k]
        scale = math.sqrt(2.0 / squared) if squared > 0.0 else 0.0
        for i in range(k, n):
            V[k, i] = scale * (alpha if i == k else A[i, k])
        reflect(V, k, A, n, k, 4)


@compiled
def worst_sighting(S: Array, m: int, V: Array, r: Array, B: Array) -> int:
    """Return which of a track's m sightings reduces its NIS most when left out.

    ``r`` (3 m, 4) has the reflected residual as its last column, the root of S is in its upper half, and V are the
    reflections. Leaving sighting j out means leaving its value free. With ``G = Q^T L^-1 E_j``, E_j its three columns
    of the identity, and the rows of G and r from the fourth on, the NIS falls by ``r^T G (G^T G)^-1 G^T r``.
    """
    n, worst, largest, N = 3 * m, 0, -1.0, np.empty((1, 4, 4))
    for j in range(m):
        for i in range(n):
            for a in range(3):
                B[i, a] = 1.0 if i == 3 * j + a else 0.0
            B[i, 3] = 0.0
        divide_by_root(S, n, B)
        for k in range(3):
            reflect(V, k, B, n, 0, 3)
        for i in range(n):
            B[i, 3] = r[i, 3]
        clear(N, 0)
        add_normals(B, 3, n, N, 0)
        x, y, z = solve(N, 0, 0.0, 1e-12, right_side(N, 0))
        fall = x * N[0, 3, 0] + y * N[0, 3, 1] + z * N[0, 3, 2]
        if fall > largest:
            worst, largest = j, fall
    return worst


@compiled
def scale(rows: Arrays, first: int, end: int, weight: float) -> None:
    """Multiply some rows of A and J by the root of a weight."""
    A, J = rows
    root = math.sqrt(weight)
    for i in range(first, end):
        for c in range(4):
            A[i, c] *= root
        for c in range(6):
            J[i, c] *= root


@compiled
def add_pose(rows: Arrays, at: int, D: Array, d: Array, j: int) -> None:
    """Add ``J^T J`` of a sighting's three rows to block j of D (W, 6, 6), and ``J^T r`` to d (6 W,)."""
    A, J = rows
    for a in range(6):
        x, y, z = J[at, a], J[at + 1, a], J[at + 2, a]
        d[6 * j + a] += x * A[at, 3] + y * A[at + 1, 3] + z * A[at + 2, 3]
        for c in range(np.uint64(6)):
            D[j, a, c] += x * J[at, c] + y * J[at + 1, c] + z * J[at + 2, c]


@compiled
def add_cross(rows: Arrays, at: int, B: Array, f: int, j: int) -> None:
    """Add ``H_f^T J`` of a sighting's three rows to the block of track f and pose j of B (3 F, 6 W)."""
    A, J = rows
    for a in range(6):
        for b in range(3):
            for row in range(at, at + 3):
                B[3 * f + b, 6 * j + a] += A[row, b] * J[row, a]


@compiled
def eliminate(f: int, N: Array, E: Array, width: int, e: Array) -> None:
    """Overwrite the three rows B of a track by ``C^-1 B``, with ``C C^T = H_f^T H_f``, and write ``C^-1 H_f^T r`` to e.

    Beyond column ``width`` B is zero. What the track then says of the poses is the information ``H_x^T H_x - E^T E``
    and the vector ``H_x^T r - E^T e``: that of its residuals on the left null space of H_f, without forming the null
    space (the Schur complement).
    """
    l00 = math.sqrt(N[f, 0, 0])
    l10, l20 = N[f, 1, 0] / l00, N[f, 2, 0] / l00
    l11 = math.sqrt(N[f, 1, 1] - l10 * l10)
    l21 = (N[f, 2, 1] - l20 * l10) / l11
    l22 = math.sqrt(N[f, 2, 2] - l20 * l20 - l21 * l21)
    for c in range(width):
        x = E[3 * f, c] / l00
        y = (E[3 * f + 1, c] - l10 * x) / l11
        E[3 * f, c], E[3 * f + 1, c] = x, y
        E[3 * f + 2, c] = (E[3 * f + 2, c] - l20 * x - l21 * y) / l22
    e[3 * f] = N[f, 3, 0] / l00
    e[3 * f + 1] = (N[f, 3, 1] - l10 * e[3 * f]) / l11
    e[3 * f + 2] = (N[f, 3, 2] - l20 * e[3 * f] - l21 * e[3 * f + 1]) / l22


_WEIGHER = types.Tuple((_ROW, _ROW))


@compiled
def weight_of(nis: float, dof: int, weigher: Arrays) -> float:
    """Return Huber's weight of an innovation of some NIS, 0 where the gate rejects it.

    ``weigher`` has the bound of the NIS and Huber's threshold at each number of degrees of freedom.
    """
    bounds, thresholds = weigher
    return min(1.0, thresholds[dof] / math.sqrt(max(nis, 1e-12))) if nis < bounds[dof] else 0.0


@kernel(types.Tuple((_STACK, _MASK)), _WINDOW, _MATRIX, _CAMERA, _LIMITS, _WEIGHER, types.Tuple((types.float64,) * 2))
def eliminate_tracks(
    sightings: Arrays, window: Arrays, P: Array, camera: Arrays, limits: Arrays, weigher: Arrays, factors: Arrays
) -> tuple[Array, BoolArray, Array, IntArray, IntArray, Array, Arrays]:
    """Triangulate F tracks, linearise them, test their constraints on the window, eliminate their landmarks.

    ``sightings`` are (uL, uR, v) (F, W, 3) px and which were seen (F, W); P (6 W, 6 W) is the covariance of the poses;
    ``factors`` say how many times its bound a NIS is far above it, and what every weight is multiplied by.

    Returns the landmarks (F, 3); which are reliable (F,) (the other results are undefined for the others); the NIS (F,)
    and its degrees of freedom (F,); the worst sighting (F,), -1 where the NIS is not far above its bound; the weight
    (F,), 0 of a track that is not accepted; and the normal equations of the accepted, weighted: ``[H_f r]^T [H_f r]``
    (F, 4, 4), E (3 F, 6 W) and e (3 F,) of :func:`eliminate`, zero for the others, ``H_x^T H_x``, one block (W, 6, 6) a
    pose, and ``H_x^T r`` (6 W,).
    """
    uvs_px, seen = sightings
    mismatched_factor, common_weight = factors
    T_cam_world = in_camera(window[0], camera)
    here, window_at = (T_cam_world, T_cam_world, window[0]), (T_cam_world, in_camera(window[1], camera), window[1])
    count, longest = seen.shape
    most = 3 * longest
    points, reliable, nis, weights = (
        np.zeros((count, 3)),
        np.empty(count, dtype=np.bool_),
        np.empty(count),
        np.zeros(count),
    )
    dof, worst = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    N, E, e = np.zeros((count, 4, 4)), np.zeros((3 * count, 2 * most)), np.zeros(3 * count)
    D, d, where = np.zeros((longest, 6, 6)), np.zeros(2 * most), np.empty(longest, dtype=np.int64)
    A, J, whitened, B = np.empty((most, 4)), np.empty((most, 6)), np.empty((most, 4)), np.empty((most, 4))
    S, V = np.empty((most, most)), np.empty((3, most))
    for f in range(count):
        m = sighted(seen, f, where)
        n, nis[f], dof[f], worst[f] = 3 * m, np.inf, 3 * m - 3, -1
        for k in range(m):
            dof[f] -= math.isnan(uvs_px[f, where[k], 1])
        reliable[f] = m >= 2 and triangulate(points, f, uvs_px, where, m, here, camera, limits)
        if not reliable[f]:
            continue
        linearise(points, f, uvs_px, where, m, window_at, camera, (A, J))
        carry_cov(where, m, J, P, S)
        cholesky(S, n)
        for i in range(n):
            for c in range(4):
                whitened[i, c] = A[i, c]
        divide_by_root(S, n, whitened)
        reflect_landmark_away(whitened, n, V)
        nis[f] = 0.0
        for i in range(3, n):
            nis[f] += whitened[i, 3] * whitened[i, 3]
        weights[f] = common_weight * weight_of(nis[f], dof[f], weigher)
        if weights[f] > 0.0:
            scale((A, J), 0, n, weights[f])
            add_normals(A, 0, n, N, f)
            for k in range(m):
                add_pose((A, J), 3 * k, D, d, where[k])
                add_cross((A, J), 3 * k, E, f, where[k])
            eliminate(f, N, E, 2 * most, e)
        elif nis[f] > mismatched_factor * weigher[0][dof[f]]:
            worst[f] = where[worst_sighting(S, m, V, whitened, B)]
    return points, reliable, nis, dof, worst, weights, (N, E, e, D, d)


_TRACKS = types.Tuple((_STACK, _MASK, _MATRIX, _MATRIX))


@kernel(_TRACKS, _WINDOW, _CAMERA, _LIMITS)
def normals_in_view(
    tracks: Arrays, window: Arrays, camera: Arrays, limits: Arrays
) -> tuple[IntArray, Array, Array, Array, Array, Array, Array, Array, IntArray]:
    """Return the normal equations of G of F tracks without their newest sightings, and the rows of the newest.

    ``tracks`` are (uL, uR, v) (F, W, 3) px, which were seen (F, W), their weights (F, W), 0 where one does not count,
    and the landmarks (F, 3), NaN for none; a landmark starts here once two sightings allow it. A track does not count
    if it has no landmark, the newest pose (the last) does not see it, it is behind one of its cameras, or it lacks
    right images and its earlier sightings do not determine the landmark. In the last two cases its landmark and its
    weights are forgotten. Returns which tracks count (G,) and the least depth (G,) of each; ``N = [H_f r]^T [H_f r]``
    (G, 4, 4); the newest A (3 G, 4); ``B = H_f^T H_x`` (3 G, 6 W); the newest J (3 G, 6); ``H_x^T H_x``, one block
    (W, 6, 6) a pose, and ``H_x^T r`` (6 W,) of the others. In these the newest pose is the first, so that of a track
    only the leading columns of B are not zero; their numbers (G,) are returned last.
    """
    uvs_px, seen, weights, points = tracks
    least_px, least_m = limits
    T_cam_world = in_camera(window[0], camera)
    window_at = (T_cam_world, in_camera(window[1], camera), window[1])
    count, longest = weights.shape
    counting, widths = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    depths, g = np.empty(count), 0
    N, B = np.zeros((count, 4, 4)), np.zeros((3 * count, 6 * longest))
    A_newest, J_newest = np.empty((3 * count, 4)), np.empty((3 * count, 6))
    D, d = np.zeros((longest, 6, 6)), np.zeros(6 * longest)
    where, A, J = np.empty(longest, dtype=np.int64), np.empty((3 * longest, 4)), np.empty((3 * longest, 6))
    for f in range(count):
        if math.isnan(points[f, 0]):
            m = sighted(seen, f, where)
            if m < 2 or not start_point(points, f, uvs_px, where, m, T_cam_world, camera, least_px)[0]:
                points[f, 0] = np.nan
        if math.isnan(points[f, 0]) or not seen[f, longest - 1]:
            continue
        m, left_only = sighted(weights, f, where), False
        nearest = linearise(points, f, uvs_px, where, m, window_at, camera, (A, J))
        last = 3 * m - 3
        for k in range(m):
            left_only = left_only or math.isnan(uvs_px[f, where[k], 1])
            scale((A, J), 3 * k, 3 * k + 3, weights[f, where[k]])
        clear(N, g)
        add_normals(A, 0, last, N, g)
        if not nearest > least_m or (left_only and not is_determined(N, g, nearest)):
            points[f, 0] = np.nan
            for j in range(longest):
                weights[f, j] = seen[f, j]
            continue
        counting[g], depths[g], widths[g] = f, nearest, 6 * (longest - where[0])
        for i in range(3):
            for c in range(4):
                A_newest[3 * g + i, c] = A[last + i, c]
            for c in range(6):
                J_newest[3 * g + i, c] = J[last + i, c]
        for k in range(m - 1):
            add_pose((A, J), 3 * k, D, d, longest - 1 - where[k])
            add_cross((A, J), 3 * k, B, g, longest - 1 - where[k])
        g += 1
    of_tracks = counting[:g], depths[:g], N[:g], A_newest[: 3 * g]
    return *of_tracks, B[: 3 * g], J_newest[: 3 * g], D, d, widths[:g]


@compiled
def innovate(f: int, N: Array, A: Array, JR: Array, BR: Array, width: int, H: Array, S: Array) -> None:
    """Write the covariance and the innovation of a track's newest sighting, given the others, to S[0] (4, 4).

    The others place the landmark at ``V (b + B x)`` with ``V = N^-1``; the newest measures ``H_f V (b + B x)`` of it.
    H (3, 6 W) is its Jacobian to errors of unit covariance, zero beyond ``width``.
    """
    b = right_side(N, f)
    for a in range(3):
        row = 3 * f + a
        x, y, z = solve(N, f, 0.0, 0.0, (A[row, 0], A[row, 1], A[row, 2]))  # a row of H_f V
        for c in range(width):
            H[a, c] = -(x * BR[3 * f, c] + y * BR[3 * f + 1, c] + z * BR[3 * f + 2, c])
        for c in range(6):
            H[a, c] += JR[row, c]
        S[0, 3, a] = A[row, 3] - x * b[0] - y * b[1] - z * b[2]
        for k in range(a + 1):
            S[0, a, k] = x * A[3 * f + k, 0] + y * A[3 * f + k, 1] + z * A[3 * f + k, 2]
        S[0, a, a] += 1.0
    # Six independent sums: a single one would wait for each of its products.
    s00, s10, s11, s20, s21, s22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(width):
        x, y, z = H[0, c], H[1, c], H[2, c]
        s00, s10, s11, s20, s21, s22 = s00 + x * x, s10 + y * x, s11 + y * y, s20 + z * x, s21 + z * y, s22 + z * z
    S[0, 0, 0], S[0, 1, 0], S[0, 1, 1] = S[0, 0, 0] + s00, S[0, 1, 0] + s10, S[0, 1, 1] + s11
    S[0, 2, 0], S[0, 2, 1], S[0, 2, 2] = S[0, 2, 0] + s20, S[0, 2, 1] + s21, S[0, 2, 2] + s22


_NORMALS = types.Tuple((types.int64[::1], _ROW, _STACK, _MATRIX, _MATRIX, _STACK, _ROW))


@kernel(_TRACKS, _NORMALS, types.Tuple((_MATRIX, _MATRIX, types.int64[::1])), _WEIGHER)
def add_newest(tracks: Arrays, normals: Arrays, by_root: Arrays, weigher: Arrays) -> Array:
    """Gate the newest sightings of G of F tracks, add them, and eliminate the landmarks.

    ``normals`` are those of :func:`normals_in_view` without B; ``by_root`` are J R of the newest sightings (3 G, 6),
    B R (3 G, 6 W), and up to which columns (G,) this is not zero, with R the lower root of the covariance of the
    poses, newest first; ``weigher`` has the gate's bound of the NIS (4,) and Huber's threshold (4,).

    Returns the landmarks' part e (3 G,) of the vector. In place, the newest sightings get their weights, B R becomes E,
    ``H_x^T H_x`` and ``H_x^T r`` those of all sightings, and the landmarks move by a Gauss-Newton step of at most a
    fifth of their least depth. The information on errors of unit covariance is then
    ``R^T H_x^T H_x R - E^T E`` and ``R^T H_x^T r - E^T e``.
    """
    uvs_px, _, weights, points = tracks
    counting, depths, N, A, J, D, d = normals
    JR, BR, widths = by_root
    last = D.shape[0] - 1
    e, H, S = np.zeros(3 * depths.size), np.empty((3, BR.shape[1])), np.empty((1, 4, 4))
    for g in range(depths.size):
        f = counting[g]
        innovate(g, N, A, JR, BR, widths[g], H, S)
        x, y, z = solve(S, 0, 0.0, 0.0, right_side(S, 0))
        nis = x * S[0, 3, 0] + y * S[0, 3, 1] + z * S[0, 3, 2]
        weights[f, last] = weight_of(nis, 2 if math.isnan(uvs_px[f, last, 1]) else 3, weigher)
        root = math.sqrt(weights[f, last])
        scale((A, J), 3 * g, 3 * g + 3, weights[f, last])
        for i in range(3 * g, 3 * g + 3):
            for b in range(3):
                for c in range(6):
                    BR[3 * g + b, c] += root * A[i, b] * JR[i, c]
        add_normals(A, 3 * g, 3 * g + 3, N, g)
        add_pose((A, J), 3 * g, D, d, 0)
        x, y, z = solve(N, g, 0.0, 0.0, right_side(N, g))
        share = min(1.0, 0.2 * depths[g] / max(math.sqrt(x * x + y * y + z * z), 1e-9))
        points[f, 0] += share * x
        points[f, 1] += share * y
        points[f, 2] += share * z
        eliminate(g, N, BR, widths[g], e)
    return e


def _what_was_compiled() -> tuple[str, ...]:
    """Return a line about the compilation, if it was not done before."""
    stats = [each.stats for each in (eliminate_tracks, normals_in_view, add_newest)]
    if all(each.cache_hits for each in stats):
        return ()
    kept = all(each.cache_path for each in stats)
    how_often = "once for this version" if kept else "and there is no place to keep that: NUMBA_CACHE_DIR names one"
    spent_s = time.process_time() - _BEGAN_CPU_S
    return (f"the MSCKF was compiled, {how_often} ({spent_s:.0f} s of CPU, in none of the times)",)


COMPILED = _what_was_compiled()
