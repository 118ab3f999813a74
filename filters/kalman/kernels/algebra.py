"""Small linear algebra of the kernels, in place: symmetric 3 x 3 systems, roots, reflections, rigid motions.

Source: Golub & Van Loan, "Matrix Computations" (4th ed.), 4.1-4.2 (roots) and 5.1 (reflections).
"""

import math

import numpy as np

from filters.kalman.kernels.compiling import compiled
from toolkit.geometry import Array


@compiled
def solved_3(N: Array, f: int, damping: float, least: float) -> tuple[float, float, float]:
    """Return the solution of ``(A + damping diag(A) + least) x = b`` by ``L D L^T``.

    Row f of N has the symmetric A (3, 3) and b (3,) as the lower triangle, row by row, of [A b; b^T .] (4, 4).
    """
    d0, l10, l20 = N[f, 0] * (1.0 + damping) + least, N[f, 1], N[f, 3]
    e10, e20 = l10 / d0, l20 / d0
    d1 = N[f, 2] * (1.0 + damping) + least - e10 * l10
    l21 = N[f, 4] - e20 * l10
    e21 = l21 / d1
    d2 = N[f, 5] * (1.0 + damping) + least - e20 * l20 - e21 * l21
    y1 = N[f, 7] - e10 * N[f, 6]
    y2 = N[f, 8] - e20 * N[f, 6] - e21 * y1
    x2 = y2 / d2
    x1 = y1 / d1 - e21 * x2
    return N[f, 6] / d0 - e10 * x1 - e20 * x2, x1, x2


@compiled
def cholesky(A: Array, n: int) -> None:
    """Overwrite a symmetric A (n, n) by its lower Cholesky factor, with the transposed factor in the upper half.

    It goes row by row through the upper half, which the compiler vectorises where indices are unsigned.
    """
    end = np.uint64(n)
    for k in range(n):
        A[k, k] = math.sqrt(A[k, k])
        root = A[k, k]
        for c in range(np.uint64(k + 1), end):
            A[k, c] /= root
        for i in range(np.uint64(k + 1), end):
            factor = A[k, i]
            A[i, k] = factor
            for c in range(i, end):
                A[i, c] -= factor * A[k, c]


@compiled
def invert(L: Array, n: int, W: Array) -> None:
    """Write ``(L L^T)^-1`` to the symmetric W (n, n); its first three rows and columns become zero."""
    for j in range(n):
        for i in range(n):
            W[j, i] = 1.0 if i == j and i > 2 else 0.0
        for i in range(max(j, 3), n):
            for k in range(max(j, 3), i):
                W[j, i] -= L[i, k] * W[j, k]
            W[j, i] /= L[i, i]
        for i in range(n - 1, 2, -1):
            for k in range(i + 1, n):
                W[j, i] -= L[k, i] * W[j, k]
            W[j, i] /= L[i, i]


@compiled
def multiply(A: Array, B: Array, out: Array) -> None:
    """Write A (l, m) B (m, n) to ``out``; zeros in A are skipped."""
    for i in range(A.shape[0]):
        for c in range(B.shape[1]):
            out[i, c] = 0.0
        for k in range(A.shape[1]):
            factor = A[i, k]
            if factor != 0.0:
                for c in range(B.shape[1]):
                    out[i, c] += factor * B[k, c]


@compiled
def solve(A: Array, B: Array) -> None:
    """Overwrite B (n, m) by the solution of ``A X = B``, by elimination with row pivots; A (n, n) is destroyed."""
    n = A.shape[0]
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(A[i, k]) > abs(A[pivot, k]):
                pivot = i
        for c in range(n):
            A[k, c], A[pivot, c] = A[pivot, c], A[k, c]
        for c in range(B.shape[1]):
            B[k, c], B[pivot, c] = B[pivot, c], B[k, c]
        for i in range(k + 1, n):
            factor = A[i, k] / A[k, k]
            for c in range(k + 1, n):
                A[i, c] -= factor * A[k, c]
            for c in range(B.shape[1]):
                B[i, c] -= factor * B[k, c]
    for k in range(n - 1, -1, -1):
        for c in range(B.shape[1]):
            for i in range(k + 1, n):
                B[k, c] -= A[k, i] * B[i, c]
            B[k, c] /= A[k, k]


@compiled
def transpose(A: Array, n: int) -> None:
    """Transpose A (n, n) in place."""
    for i in range(n):
        for j in range(i):
            A[i, j], A[j, i] = A[j, i], A[i, j]


@compiled
def clear(A: Array, rows: int) -> None:
    """Set the first rows of A to zero."""
    for i in range(rows):
        for j in range(A.shape[1]):
            A[i, j] = 0.0


@compiled
def inverses(T: Array) -> Array:
    """Return the inverses of rigid motions (W, 4, 4); only the first three rows of each are set."""
    result = np.empty(T.shape)
    for k in range(T.shape[0]):
        for i in range(3):
            shift = 0.0
            for j in range(3):
                result[k, i, j] = T[k, j, i]
                shift -= T[k, j, i] * T[k, j, 3]
            result[k, i, 3] = shift
    return result


@compiled
def products(T: Array, A: Array) -> Array:
    """Return the products of rigid motions (W, 4, 4) with one (1, 4, 4); only the first three rows of each are set."""
    result = np.empty(T.shape)
    for k in range(T.shape[0]):
        for i in range(3):
            for c in range(4):
                result[k, i, c] = T[k, i, 3] if c == 3 else 0.0
                for d in range(3):
                    result[k, i, c] += T[k, i, d] * A[0, d, c]
    return result


@compiled
def moved(T: Array, k: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a point transformed by motion k of T (W, 4, 4)."""
    return (
        T[k, 0, 0] * x + T[k, 0, 1] * y + T[k, 0, 2] * z + T[k, 0, 3],
        T[k, 1, 0] * x + T[k, 1, 1] * y + T[k, 1, 2] * z + T[k, 1, 3],
        T[k, 2, 0] * x + T[k, 2, 1] * y + T[k, 2, 2] * z + T[k, 2, 3],
    )


@compiled
def reflections(H_point: Array, n: int, V: Array, tau: Array) -> None:
    """Triangularise the first three columns of H_point (n, 4) by reflections ``1 - tau_k v_k v_k^T``.

    The fourth column is reflected as well. v_k is row k of V (3, n): zero before element k, which is one.
    """
    for k in range(3):
        below = 0.0
        for i in range(k + 1, n):
            below += H_point[i, k] * H_point[i, k]
        alpha = H_point[k, k]
        beta = -math.copysign(math.sqrt(alpha * alpha + below), alpha)
        tau[k] = (beta - alpha) / beta if below > 0.0 else 0.0
        for i in range(n):
            V[k, i] = 0.0 if i < k else 1.0 if i == k else H_point[i, k] / (alpha - beta) if below > 0.0 else 0.0
        for c in range(k, 4):
            dot = 0.0
            for i in range(k, n):
                dot += V[k, i] * H_point[i, c]
            for i in range(k, n):
                H_point[i, c] -= tau[k] * dot * V[k, i]


@compiled
def reflect_both_sides(S: Array, V: Array, k: int, tau: float, n: int) -> None:
    """Overwrite the symmetric S (n, n) by ``(1 - tau v v^T) S (1 - tau v v^T)``, with v row k of V.

    With ``u = tau S v`` and ``w = u - (tau / 2) (v^T u) v`` it is ``S - v w^T - w v^T``.
    """
    w, half = np.zeros(n), 0.0
    for j in range(n):
        factor = V[k, j]
        for i in range(n):
            w[i] += factor * S[j, i]
    for i in range(n):
        w[i] *= tau
        half += 0.5 * tau * V[k, i] * w[i]
    for i in range(n):
        w[i] -= half * V[k, i]
    for i in range(n):
        own, turned = V[k, i], w[i]
        for j in range(n):
            S[i, j] -= own * w[j] + turned * V[k, j]
