"""The exponential map of SE(3) compiled, with inverse, right Jacobian and adjoint: ``toolkit.geometry`` for one motion.

Twists are [rotation, translation]. Source: Barfoot, "State Estimation for Robotics" (2017), eqs. 7.33, 7.85-7.86.
"""

import math

import numpy as np

from filters.kalman.kernels.algebra import multiply, solve
from filters.kalman.kernels.compiling import compiled
from toolkit.geometry import Array


@compiled
def coefficients(x: float, c: Array) -> None:
    """Write the five coefficients of the exponential map and its Jacobian at a squared angle x to c (5,).

    They are ``sum_k (-x)^k / (2 k + n)!`` for n = 1 ... 5, as in ``toolkit.geometry``; small angles use seven terms.
    """
    if x < 0.25:
        first = 1.0
        for n in range(1, 6):
            first /= n
            term = first
            c[n - 1] = first
            for k in range(1, 7):
                term *= -x / ((2 * k + n - 1) * (2 * k + n))
                c[n - 1] += term
    else:
        a = math.sqrt(x)
        sine, cosine = math.sin(a), math.cos(a)
        c[0], c[1], c[2] = sine / a, (1.0 - cosine) / x, (a - sine) / (a * x)
        c[3], c[4] = (0.5 * x + cosine - 1.0) / (x * x), (sine - a + a * x / 6.0) / (a * x * x)


@compiled
def skew(v: Array, first: int, sign: float, X: Array) -> None:
    """Write the cross-product matrix of three elements of v, times a sign, to X (3, 3)."""
    x, y, z = sign * v[first], sign * v[first + 1], sign * v[first + 2]
    X[0, 0], X[0, 1], X[0, 2] = 0.0, -z, y
    X[1, 0], X[1, 1], X[1, 2] = z, 0.0, -x
    X[2, 0], X[2, 1], X[2, 2] = -y, x, 0.0


@compiled
def exponential(xi: Array, T: Array) -> None:
    """Write the motion of a twist, the first six elements of xi, to T (1, 4, 4)."""
    X, XX, c = np.empty((3, 3)), np.empty((3, 3)), np.empty(5)
    skew(xi, 0, 1.0, X)
    multiply(X, X, XX)
    coefficients(xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2], c)
    for i in range(3):
        T[0, 3, i], T[0, i, 3] = 0.0, xi[3 + i]
        for j in range(3):
            T[0, i, j] = (1.0 if i == j else 0.0) + c[0] * X[i, j] + c[1] * XX[i, j]
            T[0, i, 3] += (c[1] * X[i, j] + c[2] * XX[i, j]) * xi[3 + j]
    T[0, 3, 3] = 1.0


@compiled
def right_jacobian(xi: Array, J: Array) -> None:
    """Write J_r of a twist, ``exp(xi + d) = exp(xi) exp(J_r d)``, to J (6, 6)."""
    X, Y, XX, XY, YX = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    XYX, XXY, YXX = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    left, right = np.empty((3, 3)), np.empty((3, 3))
    c = np.empty(5)
    skew(xi, 0, -1.0, X)
    skew(xi, 3, -1.0, Y)
    multiply(X, X, XX)
    multiply(X, Y, XY)
    multiply(Y, X, YX)
    multiply(XY, X, XYX)
    multiply(X, XY, XXY)
    multiply(YX, X, YXX)
    multiply(X, XYX, left)
    multiply(XYX, X, right)
    coefficients(xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2], c)
    for i in range(3):
        for j in range(3):
            J[i, j] = J[3 + i, 3 + j] = (1.0 if i == j else 0.0) + c[1] * X[i, j] + c[2] * XX[i, j]
            J[i, 3 + j] = 0.0
            J[3 + i, j] = (
                0.5 * Y[i, j]
                + c[2] * (XY[i, j] + YX[i, j] + XYX[i, j])
                + c[3] * (XXY[i, j] + YXX[i, j] - 3.0 * XYX[i, j])
                + 0.5 * (c[3] - 3.0 * c[4]) * (left[i, j] + right[i, j])
            )


@compiled
def adjoint_of_inverse(T: Array, A: Array) -> None:
    """Write the adjoint of the inverse of a motion (1, 4, 4), ``[R^T, 0; -R^T [t]x, R^T]``, to A (6, 6)."""
    for i in range(3):
        for j in range(3):
            A[i, j] = A[3 + i, 3 + j] = T[0, j, i]
            A[i, 3 + j] = 0.0
        x, y, z = T[0, 0, i], T[0, 1, i], T[0, 2, i]
        A[3 + i, 0] = z * T[0, 1, 3] - y * T[0, 2, 3]
        A[3 + i, 1] = x * T[0, 2, 3] - z * T[0, 0, 3]
        A[3 + i, 2] = y * T[0, 0, 3] - x * T[0, 1, 3]


@compiled
def rotation_vector(T: Array, phi: Array) -> None:
    """Write the rotation vector of a motion (1, 4, 4), of length at most pi, to the first three elements of phi.

    It is computed from the unit quaternion, starting with its largest element (Shepperd 1978).
    """
    q, trace, largest = np.empty(4), T[0, 0, 0] + T[0, 1, 1] + T[0, 2, 2], 3
    for i in range(3):
        # The diagonal of 4 q q^T is 1 + 2 T_ii - trace, and 1 + trace.
        if T[0, i, i] >= (trace if largest == 3 else T[0, largest, largest]):
            largest = i
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        if largest == 3:
            q[i] = T[0, k, j] - T[0, j, k]
        elif largest == i:
            q[i], q[3] = 1.0 + 2.0 * T[0, i, i] - trace, T[0, k, j] - T[0, j, k]
        else:
            q[i] = T[0, i, largest] + T[0, largest, i]
    if largest == 3:
        q[3] = 1.0 + trace
    length, sign = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2]), 1.0 if q[3] >= 0.0 else -1.0
    angle = 2.0 * math.atan2(length, abs(q[3]))
    for i in range(3):
        phi[i] = sign * q[i] * (angle / length if length > 1e-9 * abs(q[3]) else 2.0 / abs(q[3]))


@compiled
def logarithm(T: Array, xi: Array) -> None:
    """Write the twist of a motion (1, 4, 4), whose fourth row is not read, to the first six elements of xi."""
    X, XX, c, rho = np.empty((3, 3)), np.empty((3, 3)), np.empty(5), np.empty((3, 1))
    rotation_vector(T, xi)
    skew(xi, 0, 1.0, X)
    multiply(X, X, XX)
    coefficients(xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2], c)
    for i in range(3):
        rho[i, 0] = T[0, i, 3]
        for j in range(3):
            X[i, j] = (1.0 if i == j else 0.0) + c[1] * X[i, j] + c[2] * XX[i, j]
    solve(X, rho)
    for i in range(3):
        xi[3 + i] = rho[i, 0]
