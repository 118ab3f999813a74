"""What tracks leave of their residuals compiled: ``residual_correlation`` in NumPy, one track after another."""

import numpy as np
from numba import types

from filters.kalman.kernels.algebra import inverses, solved_3
from filters.kalman.kernels.compiling import CAMERA, MASK, MATRIX, STACK, Arrays, compiled, kept, what_was_compiled
from filters.kalman.kernels.sightings import add_products, linearise, sighted
from toolkit.geometry import Array, BoolArray

# (uL, uR, v) (F, W, 3) px and which were seen (F, W); points (F, 3); poses (W, 4, 4); camera; how many sightings a
# track needs.
SIGNATURE = (types.Tuple((STACK, MASK)), MATRIX, STACK, CAMERA, types.int64)


@compiled
def pairs_in(seen: BoolArray, fewest: int) -> int:
    """Return how often tracks of so many sightings were seen from two poses in a row."""
    count = 0
    for f in range(seen.shape[0]):
        if sighted(seen, f).size >= fewest:
            for j in range(1, seen.shape[1]):
                count += seen[f, j] and seen[f, j - 1]
    return count


@compiled
def take_up(A: Array, n: int) -> None:
    """Take from the residuals in the last column of A (n, 4) what a step of the landmark takes up."""
    N = np.zeros((1, 10))
    add_products(A, 0, n, N, 0)
    x, y, z = solved_3(N, 0, 0.0, 0.0)
    for i in range(n):
        A[i, 3] -= A[i, 0] * x + A[i, 1] * y + A[i, 2] * z


@kept(SIGNATURE)
def successive_residuals(sightings: Arrays, points: Array, poses: Array, camera: Arrays, fewest: int) -> Arrays:
    """Return whitened residuals (n, 3) that tracks leave, and those of the next poses (n, 3); see :data:`SIGNATURE`."""
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


COMPILED = what_was_compiled(successive_residuals, "what tracks leave of their residuals was")
