"""Rotations and rigid motions on arrays: SO(3) as (..., 3, 3), SE(3) as (..., 4, 4).

Tangent vectors follow GTSAM: an SE(3) twist is [rotation, translation] and perturbs on the right,
``T_perturbed = T @ se3_exp(xi)``. Every function accepts leading batch dimensions. Sources: Barfoot,
"State Estimation for Robotics" (2017), chapter 7; Sola, Deray & Atchuthan, "A micro Lie theory for state
estimation in robotics" (2018), appendix B.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_IDENTITY = np.eye(3)
# Below this squared angle the closed forms lose digits and the Taylor polynomials (seven terms) are exact.
_SMALL_ANGLE_SQUARED = 0.25


def _tails() -> Array:
    """Return the coefficients (7, 5) of sum_k (-1)^k x^k / (2k + n)!, lowest power first, for n = 1 ... 5."""
    inverse_factorials = 1.0 / np.concatenate([[1.0], np.cumprod(np.arange(1.0, 21.0))])
    k = np.arange(7)[:, None]
    return np.asarray((-1.0) ** k * inverse_factorials[2 * k + np.arange(1, 6)])


_TAILS = _tails()
_POWERS = np.arange(len(_TAILS))


def _coefficients(phi: Array) -> list[Array]:
    """Return the five coefficients (..., 1, 1) of the exponential map and its Jacobians at rotation vectors (..., 3).

    They are tails of sine and cosine divided by powers of the angle a: sin a / a, (1 - cos a) / a^2,
    (a - sin a) / a^3, (a^2 / 2 + cos a - 1) / a^4, (sin a - a + a^3 / 6) / a^5.
    """
    x = np.asarray(_squared_norm(phi))
    large = x >= _SMALL_ANGLE_SQUARED
    some_large = large.any()
    small = np.where(large, 0.0, x) if some_large else x
    values = small[..., None] ** _POWERS @ _TAILS
    if some_large:
        values[large] = _closed_forms(x[large])
    return [values[..., i, None, None] for i in range(5)]


def _closed_forms(x: Array) -> Array:
    """Return all five coefficients (N, 5) at squared angles (N,) that are not small."""
    a = np.sqrt(x)
    sine, cosine = np.sin(a), np.cos(a)
    fourth, fifth = (0.5 * x + cosine - 1.0) / x**2, (sine - a + a * x / 6.0) / (a * x**2)
    return np.stack([sine / a, (1.0 - cosine) / x, (a - sine) / (a * x), fourth, fifth], axis=-1)


def skew(v: Array) -> Array:
    """Return the (..., 3, 3) matrix [v]x with ``skew(a) @ b == cross(a, b)``; v is (..., 3)."""
    v = np.asarray(v, dtype=float)
    result = np.zeros((*v.shape, 3))
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    result[..., 1, 0], result[..., 2, 0], result[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return result


def transposed(matrices: Array) -> Array:
    """Return matrices (..., m, n) transposed in memory too: products of small ones are three times as fast."""
    return np.ascontiguousarray(np.swapaxes(matrices, -1, -2))


def _squared_norm(v: Array) -> Array:
    squared: Array = np.einsum("...i,...i->...", v, v)
    return squared


def so3_exp(phi: Array) -> Array:
    """Return the rotation (..., 3, 3) of a rotation vector (..., 3) in radians (Rodrigues)."""
    phi = np.asarray(phi, dtype=float)
    phi_x = skew(phi)
    first, second, *_ = _coefficients(phi)
    return _IDENTITY + first * phi_x + second * (phi_x @ phi_x)


def so3_log(rotation: Array) -> Array:
    """Return the rotation vector (..., 3), of length at most pi, of a rotation (..., 3, 3).

    Goes through the unit quaternion, which is well conditioned at every angle, pi included.
    """
    quaternion = quaternion_from_rotation(rotation)
    vector, scalar = quaternion[..., :3], quaternion[..., 3]
    length = np.sqrt(_squared_norm(vector))
    tiny = length < 1e-9  # there atan2(length, scalar) / length = 1 / scalar to double precision
    at_zero = 2.0 / np.where(tiny, scalar, 1.0)
    factor = np.where(tiny, at_zero, 2.0 * np.arctan2(length, scalar) / np.where(tiny, 1.0, length))
    return factor[..., None] * vector


def so3_angle(rotation: Array) -> Array:
    """Return the angles (...,) rad, 0 to pi, of rotations (..., 3, 3)."""
    return np.asarray(np.linalg.norm(so3_log(rotation), axis=-1))


def so3_left_jacobian(phi: Array) -> Array:
    """Return J_l (..., 3, 3) with exp(phi + d) = exp(J_l d) exp(phi) (Barfoot, eq. 7.37)."""
    phi = np.asarray(phi, dtype=float)
    phi_x = skew(phi)
    _, second, third, *_ = _coefficients(phi)
    return _IDENTITY + second * phi_x + third * (phi_x @ phi_x)


def se3(rotation: Array, translation: Array) -> Array:
    """Assemble T (..., 4, 4) from a rotation (..., 3, 3) and a translation (..., 3)."""
    rotation, translation = np.asarray(rotation, dtype=float), np.asarray(translation, dtype=float)
    batch = rotation.shape[:-2]
    if batch != translation.shape[:-1]:
        batch = np.broadcast_shapes(batch, translation.shape[:-1])
    T = np.zeros((*batch, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T


def _hats() -> Array:
    """Return the matrix (6, 16) that multiplies a twist to the elements of its matrix (4, 4)."""
    each = np.zeros((6, 4, 4))
    each[:3, :3, :3], each[3:, :3, 3] = skew(_IDENTITY), _IDENTITY
    return each.reshape(6, 16)


_HATS, _IDENTITY_4 = _hats(), np.eye(4)


def se3_exp(xi: Array) -> Array:
    """Return T (..., 4, 4) of a twist (..., 6) ordered [rotation, translation] (Barfoot, eq. 7.43)."""
    xi = np.asarray(xi, dtype=float)
    return _se3_exp(xi, _coefficients(xi[..., :3]))


def _se3_exp(xi: Array, coefficients: list[Array]) -> Array:
    _, second, third, *_ = coefficients
    hat = (xi @ _HATS).reshape(*xi.shape[:-1], 4, 4)
    squared = hat @ hat
    return np.asarray(_IDENTITY_4 + hat + second * squared + third * (squared @ hat))


def se3_exp_and_right_jacobian(xi: Array) -> tuple[Array, Array]:
    """Return what :func:`se3_exp` and :func:`se3_right_jacobian` do of twists (..., 6), in less time than both."""
    xi = np.asarray(xi, dtype=float)
    phi_x, rho_x, coefficients = skew(xi[..., :3]), skew(xi[..., 3:]), _coefficients(xi[..., :3])
    squared = phi_x @ phi_x
    return _se3_exp(xi, coefficients), _se3_left_jacobian(-phi_x, -rho_x, squared, coefficients)


def se3_log(T: Array) -> Array:
    """Return the twist (..., 6), ordered [rotation, translation], of T (..., 4, 4)."""
    phi = so3_log(T[..., :3, :3])
    rho = np.linalg.solve(so3_left_jacobian(phi), T[..., :3, 3:])[..., 0]
    return np.concatenate([phi, rho], axis=-1)


def se3_inverse(T: Array) -> Array:
    """Return the inverse of a rigid motion (..., 4, 4) without a matrix inversion."""
    transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    return se3(transposed, -(transposed @ T[..., :3, 3:])[..., 0])


def se3_adjoint(T: Array) -> Array:
    """Return Ad(T) (..., 6, 6) with T exp(xi) T^-1 = exp(Ad(T) xi), order [rotation, translation]."""
    rotation, translation = T[..., :3, :3], T[..., :3, 3]
    return _block_lower(rotation, skew(translation) @ rotation, rotation)


def se3_right_jacobian(xi: Array) -> Array:
    """Return J_r (..., 6, 6) with exp(xi + d) = exp(xi) exp(J_r d) (Barfoot, eqs. 7.85-7.86).

    Barfoot orders [translation, rotation] and gives the left Jacobian; J_r(xi) = J_l(-xi).
    """
    xi = -np.asarray(xi, dtype=float)
    phi_x, rho_x = skew(xi[..., :3]), skew(xi[..., 3:])
    return _se3_left_jacobian(phi_x, rho_x, phi_x @ phi_x, _coefficients(xi[..., :3]))


def _se3_left_jacobian(phi_x: Array, rho_x: Array, squared: Array, coefficients: list[Array]) -> Array:
    _, second, third, fourth, fifth = coefficients
    both = phi_x @ rho_x
    sandwich = both @ phi_x
    coupling = (
        0.5 * rho_x
        + third * (both + rho_x @ phi_x + sandwich)
        + fourth * (squared @ rho_x + rho_x @ squared - 3.0 * sandwich)
        + 0.5 * (fourth - 3.0 * fifth) * (sandwich @ phi_x + phi_x @ sandwich)
    )
    jacobian = _IDENTITY + second * phi_x + third * squared
    return _block_lower(jacobian, coupling, jacobian)


def _block_lower(upper_left: Array, lower_left: Array, lower_right: Array) -> Array:
    result = np.zeros((*upper_left.shape[:-2], 6, 6))
    result[..., :3, :3], result[..., 3:, :3], result[..., 3:, 3:] = upper_left, lower_left, lower_right
    return result


def transform(T_a_b: Array, points_b: Array) -> Array:
    """Take points (..., 3) from frame b to frame a by T_a_b (..., 4, 4)."""
    return (T_a_b[..., :3, :3] @ points_b[..., None])[..., 0] + T_a_b[..., :3, 3]


def quaternion_from_rotation(rotation: Array) -> Array:
    """Return the unit quaternion (..., 4), Hamilton, ordered x y z w with w >= 0, of a rotation (..., 3, 3).

    Takes, per rotation, the row of 4 q q^T with the largest diagonal (Shepperd 1978).
    """
    r = np.asarray(rotation, dtype=float)
    diagonal = np.diagonal(r, axis1=-2, axis2=-1)
    trace = diagonal.sum(axis=-1)
    of_vector, of_scalar = 1.0 + 2.0 * diagonal - trace[..., None], 1.0 + trace
    if (of_vector < of_scalar[..., None]).all():
        # The usual case: rotations by less than about 90 degrees, such as those between two estimates.
        vee = (r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1])
        row = np.stack([*vee, of_scalar], axis=-1)
    else:
        row = _largest_row(r, of_vector, of_scalar)
    row = row / np.sqrt(_squared_norm(row))[..., None]
    return np.where(row[..., 3:] < 0.0, -row, row)


def _largest_row(r: Array, of_vector: Array, of_scalar: Array) -> Array:
    """Return the row (..., 4) of 4 q q^T with the largest of the diagonals (..., 3) and (...)."""
    outer = np.zeros((*r.shape[:-2], 4, 4))
    for i in range(3):
        outer[..., i, i] = of_vector[..., i]
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[..., j, k] = outer[..., k, j] = r[..., j, k] + r[..., k, j]
        outer[..., i, 3] = outer[..., 3, i] = r[..., k, j] - r[..., j, k]
    outer[..., 3, 3] = of_scalar
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    return np.asarray(np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :])


def rotation_from_quaternion(quaternion: Array) -> Array:
    """Return the rotation (..., 3, 3) of a Hamilton quaternion (..., 4) ordered x y z w, of any length > 0."""
    q = np.asarray(quaternion, dtype=float)
    q = q / np.sqrt(_squared_norm(q))[..., None]
    vector_x = skew(q[..., :3])
    return _IDENTITY + 2.0 * (q[..., 3, None, None] * vector_x + vector_x @ vector_x)


def nearest_rotation(matrix: Array) -> tuple[Array, Array]:
    """Return the rotation R (3, 3) with the largest tr(R^T M) of a matrix M (3, 3), and the terms (3,) of that trace.

    R is nearest to M, and turns vectors x best onto y where M is the sum of y x^T (Kabsch 1976; Umeyama 1991, eqs.
    40-43). The terms are the singular values of M, the last one negative where M mirrors.
    """
    u, d, v_transposed = np.linalg.svd(matrix)
    s = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v_transposed))])
    return (u * s) @ v_transposed, d * s


def yaw_of(rotation: Array) -> Array:
    """Return the heading (...,) in radians about the world z axis of a rotation (..., 3, 3) world <- body."""
    return np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])


def about_z(yaw_rad: Array | float) -> Array:
    """Return the rotation (..., 3, 3) by an angle about the z axis."""
    zero = np.zeros_like(np.asarray(yaw_rad, dtype=float))
    return so3_exp(np.stack([zero, zero, np.asarray(yaw_rad, dtype=float)], axis=-1))


def interpolate_poses(t_ns: IntArray, poses: Array, at_ns: IntArray) -> Array:
    """Interpolate poses (N, 4, 4) at strictly increasing stamps to the stamps ``at_ns`` (M,), within their range.

    Moves on the geodesic of SE(3) between neighbours: T_i exp(s log(T_i^-1 T_j)).
    """
    after = np.clip(np.searchsorted(t_ns, at_ns, side="right"), 1, t_ns.size - 1)
    before = after - 1
    share = (at_ns - t_ns[before]) / (t_ns[after] - t_ns[before])
    step = se3_log(se3_inverse(poses[before]) @ poses[after])
    return poses[before] @ se3_exp(share[:, None] * step)


def read_only(values: Any, dtype: npt.DTypeLike = np.float64) -> Any:
    """Return the values as a contiguous array nobody can write to; copies only where it must."""
    array = np.ascontiguousarray(values, dtype=dtype)
    if array.flags.writeable:
        array = array.view()
        array.flags.writeable = False
    return array
