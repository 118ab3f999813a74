"""A prediction over measured twists compiled: ``toolkit.models.twist`` in NumPy, of pose and gyro bias."""

import numpy as np
from numba import types

from filters.kalman.kernels.algebra import multiply, multiply_transposed, products
from filters.kalman.kernels.compiling import compiled, kept, what_was_compiled
from filters.kalman.kernels.rigid_motions import adjoint_of_inverse, exponential, right_jacobian
from filters.kalman.kernels.signatures import MATRIX, ROW, STACK, Arrays
from toolkit.geometry import Array

# Lengths s (n,) of twists, their turn rates and velocities (n, 3), factors on the noise of velocity and turn rate
# (n, 2), or (0, 2) for none; squared noise densities (9,) of turn rate, velocity and the bias' random walk; pose
# (1, 4, 4), bias of the gyro (3,) and covariance (9, 9) of the state.
SIGNATURE = (types.Tuple((ROW, MATRIX, MATRIX, MATRIX)), ROW, types.Tuple((STACK, ROW, MATRIX)))


@compiled
def integrate(twists: Arrays, densities: Array, bias: Array, T: Array, F: Array, Q: Array) -> Array:
    """Return the increment of n twists, one after another, from the identity T (1, 4, 4).

    F gets the derivative of the increment's error (9,) of pose and bias by the bias, and Q its covariance.
    """
    dt_s, w_radps, v_mps, noise_scale = twists
    piece, xi, J, carry = np.zeros((1, 4, 4)), np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    D, C, CC = np.zeros((6, 3)), np.zeros((6, 6)), np.empty((6, 6))
    carried = np.empty((6, 3))
    for k in range(dt_s.size):
        for c in range(3):
            xi[c], xi[3 + c] = dt_s[k] * (w_radps[k, c] - bias[c]), dt_s[k] * v_mps[k, c]
        exponential(xi, piece)
        right_jacobian(xi, J)
        adjoint_of_inverse(piece, carry)
        T = products(T, piece)
        multiply(carry, D, carried)
        multiply(carry, C, CC)
        multiply_transposed(CC, carry, C)
        for i in range(6):
            for c in range(3):
                D[i, c] = carried[i, c] - dt_s[k] * J[i, c]
            for c in range(6):
                scale = noise_scale[k, 1 - c // 3] if noise_scale.shape[0] else 1.0
                weighted = J[i, c] * dt_s[k] * densities[c] * scale * scale
                for j in range(6):
                    C[i, j] += weighted * J[j, c]
    for i in range(6):
        for c in range(3):
            F[i, 6 + c] = D[i, c]
        for c in range(6):
            Q[i, c] = C[i, c]
    return T


@kept(SIGNATURE)
def predict(twists: Arrays, densities: Array, state: Arrays) -> Arrays:
    """Return pose (1, 4, 4) and covariance (9, 9) of the state predicted over n twists; see :data:`SIGNATURE`."""
    pose, bias, P = state
    dt_s = twists[0]
    start, F, Q = np.zeros((1, 4, 4)), np.zeros((9, 9)), np.zeros((9, 9))
    for i in range(4):
        start[0, i, i] = 1.0
    T, carry = integrate(twists, densities, bias, start, F, Q), np.empty((6, 6))
    adjoint_of_inverse(T, carry)
    for i in range(6):
        for c in range(6):
            F[i, c] = carry[i, c]
    for c in range(3):
        F[6 + c, 6 + c] = 1.0
        for k in range(dt_s.size):
            Q[6 + c, 6 + c] += densities[6 + c] * dt_s[k]
    FP, cov = np.empty((9, 9)), np.empty((9, 9))
    multiply(F, P, FP)
    multiply_transposed(FP, F, cov)
    for i in range(9):
        for c in range(i + 1):
            cov[i, c] = cov[c, i] = 0.5 * (cov[i, c] + cov[c, i] + Q[i, c] + Q[c, i])
    pose = products(pose, T)
    for c in range(4):
        pose[0, 3, c] = 1.0 if c == 3 else 0.0
    return pose, cov


COMPILED = what_was_compiled(predict, "the prediction along twists was")
