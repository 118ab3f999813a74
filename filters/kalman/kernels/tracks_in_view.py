"""The information of tracks in view compiled: the normal equations of ``tracks_in_view``'s NumPy, track by track.

A track's rows are ``[H_f r]`` (3 m, 4) and J (3 m, 6 m), the Jacobians to its landmark and to the poses of its m
sightings, the newest last. From them ``[H_f r]^T [H_f r]`` and ``B = H_f^T J`` are formed, and from these with
``V = (H_f^T H_f)^-1`` the information on the poses, ``J^T J - B^T V B`` and ``J^T r - B^T V H_f^T r`` (Triggs,
McLauchlan, Hartley & Fitzgibbon 2000, "Bundle adjustment - a modern synthesis", section 6.1).

:func:`follow` finds the landmarks known from the frame before. The information takes two kernels, because between them
BLAS transforms the rows of all tracks at once to errors of unit covariance: :func:`normals_of_tracks` forms B without
the newest sightings, :func:`information_with_newest` tests and adds these.
"""

import math

import numpy as np
from numba import types

from filters.kalman.kernels.algebra import inverses, products, solved_3
from filters.kalman.kernels.compiling import compiled, kept, what_was_compiled
from filters.kalman.kernels.sightings import (
    add_products,
    first_guess,
    linearise,
    sighted,
    step,
)
from filters.kalman.kernels.signatures import CAMERA, MASK, MATRIX, ROW, STACK, Arrays
from toolkit.geometry import Array, IntArray

# Tracks: (uL, uR, v) (F, W, 3) px, which are used (F, W), weights (F, W), points (F, 3). Then poses
# (W, 4, 4), poses to linearise at (W, 4, 4), camera, and the rules numbered below.
SIGNATURE = (types.Tuple((STACK, MASK, MATRIX, MATRIX)), types.Tuple((STACK, STACK)), CAMERA, ROW)
# What :func:`normals_of_tracks` returns; R (6 W, 6 W), J R of the newest sightings and B R (3 F, 6 W); rules.
NEWEST_SIGNATURE = (
    types.Tuple((MATRIX, ROW, MATRIX, MATRIX, MATRIX, MATRIX, STACK, ROW)),
    types.Tuple((MATRIX, MATRIX, MATRIX)),
    ROW,
)
LEAST_DEPTH, BOUND, HUBER_THRESHOLD = range(3)
# Of tracks known before: ids (K,), frames of the poses (V,), points (K, 3), weights of sightings (K, V). Of the present
# ones: ids (A,), frames (W,), (uL, uR, v) (A, W, 3) px and which were seen (A, W). Poses (W, 4, 4), camera; the number
# of sightings and the disparity (px) that a track needs.
_IDS = types.int64[::1]
FOLLOWING = (
    types.Tuple((_IDS, _IDS, MATRIX, MATRIX)),
    types.Tuple((_IDS, _IDS, STACK, MASK)),
    STACK,
    CAMERA,
    types.int64,
    types.float64,
)


@compiled
def place_of(wanted: int, ids: IntArray, first: int) -> int:
    """Return the index of an id among ids, searching from ``first`` on and then before it; -1 if absent."""
    for k in range(ids.size):
        at = first + k if first + k < ids.size else first + k - ids.size
        if ids[at] == wanted:
            return at
    return -1


@compiled
def places_of(frames: IntArray, known: IntArray) -> IntArray:
    """Return the indices of frames (W,) among known ones, -1 if absent."""
    places = np.empty(frames.size, dtype=np.int64)
    for j in range(frames.size):
        places[j] = place_of(frames[j], known, j if j < known.size else 0)
    return places


@kept(FOLLOWING)
def follow(known: Arrays, now: Arrays, poses: Array, camera: Arrays, fewest: int, least_px: float) -> Arrays:
    """Return which of A tracks have a landmark (A,), the points (A, 3), and the weights of their sightings (A, W).

    Landmarks are those known before; a new track's is the stereo point of its sighting with the largest disparity.
    """
    known_ids, known_frames, known_points, known_weights = known
    ids, frames, uvs_px, seen = now
    (count, window), at, places = seen.shape, 0, places_of(frames, known_frames)
    T_world_cam = products(poses, camera[1])
    found, points, weights = np.empty(count, dtype=np.bool_), np.zeros((count, 3)), np.ones((count, window))
    for f in range(count):
        found[f] = sighted(seen, f).size >= fewest
        if found[f]:
            row = place_of(ids[f], known_ids, at)
            if row >= 0:
                at = row + 1
                for i in range(3):
                    points[f, i] = known_points[row, i]
                for j in range(window):
                    if places[j] >= 0:
                        weights[f, j] = known_weights[row, places[j]]
            else:
                points[f, 0] = least_px
                found[f] = first_guess(uvs_px, seen, f, T_world_cam, camera[0], points) > least_px
    return found, points, weights


@compiled
def scale(rows: Arrays, first: int, end: int, columns: int, factor: float) -> None:
    """Multiply some rows of a track, and the first columns of their J, by a factor."""
    A, J = rows
    for i in range(first, end):
        for c in range(4):
            A[i, c] *= factor
        for c in range(columns):
            J[i, c] *= factor


@compiled
def add_normals(f: int, where: IntArray, rows: Arrays, n: int, sums: Arrays) -> None:
    """Add n rows of track f to ``[H_f r]^T [H_f r]``, to B, and to ``J^T J`` and ``J^T r`` of all tracks.

    A row of J (3 m, 6) is the Jacobian to the pose of its sighting; ``J^T J`` is (W, 6, 6).
    """
    A, J = rows
    N, B, D, d = sums
    add_products(A, 0, n, N, f)
    for i in range(0, n, 3):
        block = where[i // 3]
        column = 6 * block
        for a in range(6):
            x, y, z = J[i, a], J[i + 1, a], J[i + 2, a]
            d[column + a] = d[column + a] + x * A[i, 3] + y * A[i + 1, 3] + z * A[i + 2, 3]
            for b in range(3):
                B[3 * f + b, column + a] += A[i, b] * x + A[i + 1, b] * y + A[i + 2, b] * z
            for c in range(np.uint64(6)):
                D[block, a, c] = D[block, a, c] + x * J[i, c] + y * J[i + 1, c] + z * J[i + 2, c]


@compiled
def put_newest(f: int, where: IntArray, rows: Arrays, A_newest: Array, J_newest: Array) -> None:
    """Copy the last three rows of a track to those of the newest sightings: J (3 F, 6)."""
    A, J = rows
    for a in range(3):
        i = 3 * where.size - 3 + a
        for c in range(4):
            A_newest[3 * f + a, c] = A[i, c]
        for c in range(6):
            J_newest[3 * f + a, c] = J[i, c]


@kept(SIGNATURE)
def normals_of_tracks(tracks: Arrays, window: Arrays, camera: Arrays, rules: Array) -> Arrays:
    """Return the normal equations of F tracks without their newest sightings, and the rows of the newest.

    They are, for :func:`information_with_newest`: points (F, 3); the least depth (F,) of each; ``[H_f r]^T [H_f r]`` (F
    + 1, 10) as ``solved_3`` takes it; B (3 F, 6 W); the newest rows, ``[H_f r]`` (3 F, 4) and J (3 F, 6) to the newest
    pose; ``J^T J`` of the others, one block (W, 6, 6) per pose; ``J^T r`` (6 W,). A track that is behind one of its
    cameras adds nothing.
    """
    uvs_px, counted, weights, points = tracks
    poses, poses_at = window
    intrinsics, T_imu_cam, whitener = camera
    count, longest = counted.shape
    inverses_now, inverses_at, T_cam_imu = inverses(poses), inverses(poses_at), inverses(T_imu_cam)
    views, eye = (inverses_now, poses_at, inverses_at), (intrinsics, T_cam_imu, whitener)
    most = 3 * longest
    depths, N, B = np.empty(count), np.zeros((count + 1, 10)), np.zeros((3 * count, 6 * longest))
    A_newest, J_newest = np.empty((3 * count, 4)), np.zeros((3 * count, 6))
    D, d, H_pose, A = np.zeros((longest, 6, 6)), np.zeros(6 * longest), np.empty((most, 6)), np.empty((most, 4))
    for f in range(count):
        where = sighted(counted, f)
        m, rows = where.size, (A, H_pose)
        depths[f] = linearise(points, f, uvs_px, where, views, eye, (H_pose, A))
        if depths[f] > rules[LEAST_DEPTH]:
            for i in range(m - 1):
                if weights[f, where[i]] < 1.0:
                    scale(rows, 3 * i, 3 * i + 3, 6, math.sqrt(weights[f, where[i]]))
            put_newest(f, where, rows, A_newest, J_newest)
            add_normals(f, where, rows, 3 * m - 3, (N, B, D, d))
    return points, depths, N, B, A_newest, J_newest, D, d


@compiled
def newest_innovation(f: int, N: Array, A: Array, JR: Array, BR: Array, H: Array, S: Array) -> None:
    """Write the innovation of a track's newest sighting, given the others, and its covariance to the first row of S.

    The others place the landmark at ``V (b + B x)``, and the newest measures ``H_f V (b + B x)`` of it. H (3, 6 W) gets
    its Jacobian to errors of unit covariance; S has ``[covariance, innovation]`` in the form that ``solved_3`` takes.
    """
    T, last = np.empty((3, 3)), N.shape[0] - 1
    for a in range(3):
        for c in range(6):
            N[last, c] = N[f, c]
        for d in range(3):
            N[last, 6 + d] = A[3 * f + a, d]
        x, y, z = solved_3(N, last, 0.0, 0.0)
        T[a, 0], T[a, 1], T[a, 2] = x, y, z
        for c in range(JR.shape[1]):
            H[a, c] = JR[3 * f + a, c] - x * BR[3 * f, c] - y * BR[3 * f + 1, c] - z * BR[3 * f + 2, c]
        S[0, 6 + a] = A[3 * f + a, 3] - x * N[f, 6] - y * N[f, 7] - z * N[f, 8]
    at = 0
    for a in range(3):
        for b in range(a + 1):
            S[0, at] = 1.0 if a == b else 0.0
            for d in range(3):
                S[0, at] += T[a, d] * A[3 * f + b, d]
            at += 1
    # Six independent sums: a single one would wait for each of its products.
    s0, s1, s2, s3, s4, s5 = S[0, 0], S[0, 1], S[0, 2], S[0, 3], S[0, 4], S[0, 5]
    for c in range(JR.shape[1]):
        x, y, z = H[0, c], H[1, c], H[2, c]
        s0, s1, s2, s3, s4, s5 = s0 + x * x, s1 + y * x, s2 + y * y, s3 + z * x, s4 + z * y, s5 + z * z
    S[0, 0], S[0, 1], S[0, 2], S[0, 3], S[0, 4], S[0, 5] = s0, s1, s2, s3, s4, s5


@compiled
def weight_of(S: Array, bound: float, huber_threshold: float) -> float:
    """Return the weight of a sighting whose innovation and covariance are in the first row of S."""
    x, y, z = solved_3(S, S.shape[0] - 1, 0.0, 0.0)
    nis = x * S[0, 6] + y * S[0, 7] + z * S[0, 8]
    return min(1.0, huber_threshold / math.sqrt(max(nis, 1e-12))) if nis < bound else 0.0


@compiled
def add_newest(f: int, weight: float, rows: Arrays, JR: Array, BR: Array, sums: Arrays) -> None:
    """Add a track's weighted newest sighting to ``[H_f r]^T [H_f r]``, to B R, and to ``J^T J`` and ``J^T r``."""
    A, J = rows
    N, D, d = sums
    scale(rows, 3 * f, 3 * f + 3, J.shape[1], math.sqrt(weight))
    add_products(A, 3 * f, 3 * f + 3, N, f)
    shift, last = d.size - J.shape[1], D.shape[0] - 1
    for i in range(3 * f, 3 * f + 3):
        for b in range(3):
            factor = math.sqrt(weight) * A[i, b]
            for c in range(BR.shape[1]):
                BR[3 * f + b, c] += factor * JR[i, c]
        for a in range(J.shape[1]):
            d[shift + a] += J[i, a] * A[i, 3]
            for c in range(a + 1):
                D[last, a, c] += J[i, a] * J[i, c]


@compiled
def eliminate(f: int, N: Array, E: Array, e: Array) -> None:
    """Overwrite B R by ``C^-1 B R``, with C the root of a track's ``H_f^T H_f``, and write ``C^-1 H_f^T r`` to e."""
    l00 = math.sqrt(N[f, 0])
    l10, l20 = N[f, 1] / l00, N[f, 3] / l00
    l11 = math.sqrt(N[f, 2] - l10 * l10)
    l21 = (N[f, 4] - l20 * l10) / l11
    l22 = math.sqrt(N[f, 5] - l20 * l20 - l21 * l21)
    for c in range(E.shape[1]):
        x = E[3 * f, c] / l00
        y = (E[3 * f + 1, c] - l10 * x) / l11
        E[3 * f, c], E[3 * f + 1, c] = x, y
        E[3 * f + 2, c] = (E[3 * f + 2, c] - l20 * x - l21 * y) / l22
    e[3 * f] = N[f, 6] / l00
    e[3 * f + 1] = (N[f, 7] - l10 * e[3 * f]) / l11
    e[3 * f + 2] = (N[f, 8] - l20 * e[3 * f] - l21 * e[3 * f + 1]) / l22


@compiled
def mirror(A: Array) -> None:
    """Copy the lower halves of symmetric matrices (., n, n) to their upper halves."""
    for k in range(A.shape[0]):
        for i in range(A.shape[1]):
            for j in range(i):
                A[k, j, i] = A[k, i, j]


@compiled
def blocks_times_root(D: Array, R: Array) -> Array:
    """Return the product of a block-diagonal matrix of blocks D (., k, k) with a lower triangular R (n, n)."""
    result = np.zeros(R.shape)
    for block in range(D.shape[0]):
        first = block * D.shape[1]
        for a in range(D.shape[1]):
            for b in range(D.shape[1]):
                for c in range(first + b + 1):
                    result[first + a, c] += D[block, a, b] * R[first + b, c]
    return result


@kept(NEWEST_SIGNATURE)
def information_with_newest(normals: Arrays, by_root: Arrays, rules: Array) -> Arrays:
    """Gate the newest sightings of F tracks and finish their information; see :data:`NEWEST_SIGNATURE`.

    Returns points (F, 3) after a step, the weights of the newest sightings (F,), which tracks are in front of all their
    cameras (F,), the landmarks' part e (3 F,) of the vector, and ``J^T J R`` (6 W, 6 W) of all sightings. In place,
    ``J^T r`` becomes that of all sightings and ``B R`` becomes E (3 F, 6 W). The information is then
    ``R^T J^T J R - E^T E`` and ``R^T J^T r - E^T e``.
    """
    points, depths, N, _, A, J, D, d = normals
    R, JR, BR = by_root
    count = depths.size
    newest, in_front, stepped, e = np.zeros(count), np.empty(count, dtype=np.bool_), points.copy(), np.zeros(3 * count)
    H, S = np.empty((3, JR.shape[1])), np.empty((1, 10))
    for f in range(count):
        in_front[f] = depths[f] > rules[LEAST_DEPTH]
        if in_front[f]:
            newest_innovation(f, N, A, JR, BR, H, S)
            newest[f] = weight_of(S, rules[BOUND], rules[HUBER_THRESHOLD])
            add_newest(f, newest[f], (A, J), JR, BR, (N, D, d))
            step(stepped, f, depths[f], N, f)
            eliminate(f, N, BR, e)
    mirror(D)
    return stepped, newest, in_front, e, blocks_times_root(D, R)


COMPILED = what_was_compiled(follow, "the information of tracks in view was")
