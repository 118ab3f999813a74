"""A prediction over IMU samples compiled: ``toolkit.models.imu``, whose preintegration is GTSAM's.

The state is integrated in the tangent space of its start: a rotation vector theta, a position and a velocity. The turn
rate w gives ``theta' = J_r^-1(theta) w`` (Forster et al. 2017, "On-manifold preintegration for real-time
visual-inertial odometry", eqs. 26-38; GTSAM's "tangent preintegration"). A step has the Jacobian F (15, 15) of the
errors of theta, position, velocity and both biases; F propagates the covariance.
"""

import numpy as np
from numba import types

from filters.kalman.kernels.algebra import clear, multiply, transpose
from filters.kalman.kernels.compiling import compiled, kept, what_was_compiled
from filters.kalman.kernels.rigid_motions import coefficients, skew
from filters.kalman.kernels.signatures import MATRIX, ROW, STACK, Arrays
from toolkit.geometry import Array

# Lengths s (n,) of steps, specific forces and turn rates (n, 3) at their midpoints. Squared noise densities (5,) of
# accelerometer, gyro, the random walks of their biases, and the integration error. Pose (1, 4, 4), velocity m/s (3,),
# bias (6,) [accel, gyro] of the state; gravity m/s^2 (3,) in the world.
SIGNATURE = (types.Tuple((ROW, MATRIX, MATRIX)), ROW, types.Tuple((STACK, ROW, ROW)), ROW)


@compiled
def tangent(theta: Array, R: Array, Jr: Array, inverse: Array, c: Array) -> None:
    """Write the rotation of a vector to R (3, 3), its right Jacobian to Jr and the inverse of that to ``inverse``.

    Its coefficients (5,), as in ``rigid_motions``, go to c.
    """
    X, XX = np.empty((3, 3)), np.empty((3, 3))
    skew(theta, 0, 1.0, X)
    multiply(X, X, XX)
    coefficients(theta[0] * theta[0] + theta[1] * theta[1] + theta[2] * theta[2], c)
    second = (c[2] - 2.0 * c[3]) / (2.0 * c[1])
    for i in range(3):
        for j in range(3):
            one = 1.0 if i == j else 0.0
            R[i, j] = one + c[0] * X[i, j] + c[1] * XX[i, j]
            Jr[i, j] = one - c[1] * X[i, j] + c[2] * XX[i, j]
            inverse[i, j] = one + 0.5 * X[i, j] + second * XX[i, j]


@compiled
def turned(R: Array, v: Array, out: Array) -> None:
    """Write the product of R (3, 3) with v (3,) to ``out`` (3,)."""
    for i in range(3):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]


@compiled
def rate_by_angle(theta: Array, u: Array, c: Array, M: Array) -> None:
    """Write the derivative of ``J_r(theta) u`` by theta, with u constant, to M (3, 3)."""
    X, across, twice = np.empty((3, 3)), np.empty(3), np.empty(3)
    skew(theta, 0, 1.0, X)
    turned(X, u, across)
    turned(X, across, twice)
    skew(u, 0, 1.0, X)
    along = theta[0] * u[0] + theta[1] * u[1] + theta[2] * u[2]
    for i in range(3):
        for j in range(3):
            M[i, j] = c[1] * X[i, j] + c[2] * (theta[i] * u[j] - 2.0 * u[i] * theta[j])
            M[i, j] += ((c[2] - 2.0 * c[3]) * across[i] + (3.0 * c[4] - c[3]) * twice[i]) * theta[j]
        M[i, i] += c[2] * along


@compiled
def step(state: Array, force: Array, rate: Array, dt_s: float, F: Array) -> None:
    """Move theta, position and velocity (9,) by a step of unbiased samples (3,); write its Jacobian to F (15, 15)."""
    R, Jr, inverse, c = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(5)
    X, XJ, by_angle, u, a = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    tangent(state, R, Jr, inverse, c)
    turned(inverse, rate, u)
    turned(R, force, a)
    rate_by_angle(state, u, c, X)
    multiply(inverse, X, by_angle)
    skew(force, 0, -1.0, X)
    multiply(X, Jr, XJ)
    multiply(R, XJ, X)
    for i in range(3):
        state[i] += dt_s * u[i]
        state[3 + i] += dt_s * state[6 + i] + 0.5 * dt_s * dt_s * a[i]
        state[6 + i] += dt_s * a[i]
        for j in range(3):
            F[i, j] = (1.0 if i == j else 0.0) - dt_s * by_angle[i, j]
            F[3 + i, j], F[6 + i, j] = 0.5 * dt_s * dt_s * X[i, j], dt_s * X[i, j]
            F[3 + i, 6 + j] = dt_s if i == j else 0.0
            F[3 + i, 9 + j], F[6 + i, 9 + j] = -0.5 * dt_s * dt_s * R[i, j], -dt_s * R[i, j]
            F[i, 12 + j] = -dt_s * inverse[i, j]


@compiled
def carry(F: Array, P: Array, work: Array) -> None:
    """Overwrite a symmetric P (n, n) by ``F P F^T``."""
    multiply(F, P, work)
    transpose(work, P.shape[0])
    multiply(F, work, P)


@compiled
def over_step(F: Array, A: Array, out: Array) -> None:
    """Write the first nine rows of F A to ``out``, with F a step's Jacobian; A has 15 columns.

    Theta depends on theta and the gyro's bias. Velocity depends on theta, itself and the accelerometer's bias; position
    on these and on itself.
    """
    for i in range(9):
        bias = 12 if i < 3 else 9
        x, y, z, u, v, w = F[i, 0], F[i, 1], F[i, 2], F[i, bias], F[i, bias + 1], F[i, bias + 2]
        own, moved = 1.0 if i > 2 else 0.0, F[i, i + 3] if 2 < i < 6 else 0.0
        for c in range(np.uint64(15)):
            value = x * A[0, c] + y * A[1, c] + z * A[2, c] + u * A[bias, c] + v * A[bias + 1, c] + w * A[bias + 2, c]
            out[i, c] = value + own * A[i, c] + moved * A[i + 3, c]


@compiled
def carry_over_step(F: Array, P: Array, work: Array) -> None:
    """Overwrite a symmetric P (15, 15) by ``F P F^T``, with F a step's Jacobian."""
    over_step(F, P, work)
    for i in range(9):
        for c in range(15):
            P[c, i] = work[i, c]
    over_step(F, P, work)
    for i in range(9):
        for c in range(9):
            P[i, c] = work[i, c]
        for c in range(9, 15):
            P[i, c] = P[c, i]


@compiled
def add_noise(F: Array, variances: Array, dt_s: float, P: Array) -> None:
    """Add the noise of a step with Jacobian F, in theta, position, velocity and biases, to P (15, 15)."""
    accel, gyro = variances[0] / dt_s, variances[1] / dt_s
    for i in range(9):
        variance, first, begin, end = (gyro, 12, 0, 3) if i < 3 else (accel, 9, 3, 9)
        for j in range(begin, end):
            for c in range(3):
                P[i, j] += variance * F[i, first + c] * F[j, first + c]
    for i in range(3):
        P[3 + i, 3 + i] += variances[4] * dt_s
        P[9 + i, 9 + i] += variances[2] * dt_s
        P[12 + i, 12 + i] += variances[3] * dt_s


@compiled
def identity(A: Array) -> None:
    """Set A to the identity."""
    clear(A, A.shape[0])
    for i in range(A.shape[0]):
        A[i, i] = 1.0


@compiled
def integrate(samples: Arrays, variances: Array, bias: Array, state: Array, P: Array, G: Array) -> float:
    """Integrate samples; write theta, position and velocity to state (9,), their covariance with both biases to P.

    G (15, 15), initially the identity, becomes the derivative by the biases of the start. Returns the duration.
    """
    dt_s, forces, rates = samples
    F, work, X, c = np.empty((15, 15)), np.empty((15, 15)), np.empty((3, 3)), np.empty(5)
    force, rate, half, across, twice, total = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), 0.0
    identity(F)
    for k in range(dt_s.size):
        for i in range(3):
            force[i], rate[i] = forces[k, i] - bias[i], rates[k, i] - bias[3 + i]
            half[i] = 0.5 * dt_s[k] * rate[i]
        # A specific force is that of the step's midpoint; it is rotated to the axes of the start.
        coefficients(half[0] * half[0] + half[1] * half[1] + half[2] * half[2], c)
        skew(half, 0, 1.0, X)
        turned(X, force, across)
        turned(X, across, twice)
        for i in range(3):
            force[i] += c[0] * across[i] + c[1] * twice[i]
        step(state, force, rate, dt_s[k], F)
        carry_over_step(F, P, work)
        add_noise(F, variances, dt_s[k], P)
        over_step(F, G, work)
        for i in range(9):
            for j in range(9, 15):
                G[i, j] = work[i, j]
        total += dt_s[k]
    return total


@compiled
def to_end(R: Array, Jr: Array, D: Array) -> None:
    """Write to D (15, 15) the map of errors of theta, position and velocity to the body's axes at the end."""
    identity(D)
    for i in range(3):
        for j in range(3):
            D[i, j], D[3 + i, 3 + j], D[6 + i, 6 + j] = Jr[i, j], R[j, i], R[j, i]


@kept(SIGNATURE)
def predict(samples: Arrays, variances: Array, start: Arrays, gravity: Array) -> Arrays:
    """Return pose (4, 4), velocity (3,), transition (15, 15) and noise (15, 15) at the end; see :data:`SIGNATURE`."""
    pose, velocity, bias = start
    state, P, G, D = np.zeros(9), np.zeros((15, 15)), np.empty((15, 15)), np.empty((15, 15))
    R, Jr, X, c = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(5)
    T, v, F = np.zeros((4, 4)), np.empty(3), np.empty((15, 15))
    identity(G)
    dt_s = integrate(samples, variances, bias, state, P, G)
    tangent(state, R, Jr, X, c)
    to_end(R, Jr, D)
    carry(D, P, F)
    multiply(D, G, F)
    # The effect of the start's own error on theta, position and velocity, which are integrated in the start's axes.
    for block in range(2):
        skew(state, 3 + 3 * block, -1.0, X)
        for i in range(3):
            for j in range(3):
                F[3 + 3 * block + i, j] = R[0, i] * X[0, j] + R[1, i] * X[1, j] + R[2, i] * X[2, j]
    for i in range(3):
        for j in range(3):
            F[i, j] = F[3 + i, 3 + j] = F[6 + i, 6 + j] = R[j, i]
            F[3 + i, 6 + j], F[6 + i, 3 + j] = dt_s * R[j, i], 0.0
    for i in range(3):
        T[i, 3] = pose[0, i, 3] + dt_s * velocity[i] + 0.5 * dt_s * dt_s * gravity[i]
        v[i] = velocity[i] + dt_s * gravity[i]
        for j in range(3):
            T[i, 3] += pose[0, i, j] * state[3 + j]
            v[i] += pose[0, i, j] * state[6 + j]
            for d in range(3):
                T[i, j] += pose[0, i, d] * R[d, j]
    T[3, 3] = 1.0
    return T, v, F, P


COMPILED = what_was_compiled(predict, "the prediction along an IMU's samples was")
