"""Rotations and rigid motions on arrays: SO(3) as (..., 3, 3), SE(3) as (..., 4, 4).

Tangent vectors follow GTSAM: an SE(3) twist is [rotation, translation] and perturbs on the right,
``T_perturbed = T @ se3_exp(xi)``. Every function accepts leading batch dimensions. Sources: Barfoot,
"State Estimation for Robotics" (2017), chapter 7; Sola, Deray & Atchuthan, "A micro Lie theory for state
estimation in robotics" (2018), appendix B.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

# Below this squared angle the closed forms lose digits and the Taylor polynomials (seven terms) are exact.
_SMALL_ANGLE_SQUARED = 0.25
# 1/n! for n = 0 ... 20
_INVERSE_FACTORIALS = 1.0 / np.concatenate([[1.0], np.cumprod(np.arange(1.0, 21.0))])


@cache
def _cosine_tail(first: int) -> tuple[float, ...]:
    """Return the coefficients of sum_k (-1)^k x^k / (2k + first)!, highest power first."""
    orders = np.arange(first, first + 14, 2)
    signs = np.where(np.arange(orders.size) % 2 == 0, 1.0, -1.0)
    return tuple((signs * _INVERSE_FACTORIALS[orders])[::-1].tolist())


def _coefficient(angle_squared: Array, first: int, closed_form: Callable[[Array, Array], Array]) -> Array:
    """Evaluate one of the trigonometric coefficients of the exponential map at any angle."""
    small = angle_squared < _SMALL_ANGLE_SQUARED
    if small.all():
        return _taylor(angle_squared, first)
    safe = np.where(small, 1.0, angle_squared)
    return np.where(small, _taylor(np.where(small, angle_squared, 0.0), first), closed_form(np.sqrt(safe), safe))


def _taylor(angle_squared: Array, first: int) -> Array:
    highest, *lower = _cosine_tail(first)
    result = np.full_like(angle_squared, highest)
    for coefficient in lower:
        result = result * angle_squared + coefficient
    return result


def _sin_over_angle(x: Array) -> Array:
    return _coefficient(x, 1, lambda a, _: np.sin(a) / a)


def _one_minus_cos(x: Array) -> Array:
    """(1 - cos a) / a^2"""
    return _coefficient(x, 2, lambda a, a2: (1.0 - np.cos(a)) / a2)


def _angle_minus_sin(x: Array) -> Array:
    """(a - sin a) / a^3"""
    return _coefficient(x, 3, lambda a, a2: (a - np.sin(a)) / (a * a2))


def _fourth_order(x: Array) -> Array:
    """(a^2 / 2 + cos a - 1) / a^4"""
    return _coefficient(x, 4, lambda a, a2: (0.5 * a2 + np.cos(a) - 1.0) / a2**2)


def _fifth_order(x: Array) -> Array:
    """(sin a - a + a^3 / 6) / a^5"""
    return _coefficient(x, 5, lambda a, a2: (np.sin(a) - a + a * a2 / 6.0) / (a * a2**2))


def skew(v: Array) -> Array:
    """Return the (..., 3, 3) matrix [v]x with ``skew(a) @ b == cross(a, b)``; v is (..., 3)."""
    v = np.asarray(v, dtype=float)
    result = np.zeros((*v.shape, 3))
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    result[..., 1, 0], result[..., 2, 0], result[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return result


def _squared_norm(v: Array) -> Array:
    squared: Array = np.einsum("...i,...i->...", v, v)
    return squared


def _spread(x: Array) -> Array:
    """Give a scalar field two trailing axes, so that it scales matrices."""
    return np.asarray(x)[..., None, None]


def so3_exp(phi: Array) -> Array:
    """Return the rotation (..., 3, 3) of a rotation vector (..., 3) in radians (Rodrigues)."""
    phi = np.asarray(phi, dtype=float)
    phi_x, x = skew(phi), _squared_norm(phi)
    return np.eye(3) + _spread(_sin_over_angle(x)) * phi_x + _spread(_one_minus_cos(x)) * (phi_x @ phi_x)


def so3_log(rotation: Array) -> Array:
    """Return the rotation vector (..., 3), of length at most pi, of a rotation (..., 3, 3).

    Goes through the unit quaternion, which is well conditioned at every angle, pi included.
    """
    quaternion = quaternion_from_rotation(rotation)
    vector, scalar = quaternion[..., :3], quaternion[..., 3]
    length = np.sqrt(_squared_norm(vector))
    tiny = length < 1e-9  # there atan2(length, scalar) / length = 1 / scalar to double precision
    factor = np.where(tiny, 2.0 / scalar, 2.0 * np.arctan2(length, scalar) / np.where(tiny, 1.0, length))
    return factor[..., None] * vector


def so3_left_jacobian(phi: Array) -> Array:
    """Return J_l (..., 3, 3) with exp(phi + d) = exp(J_l d) exp(phi) (Barfoot, eq. 7.37)."""
    phi = np.asarray(phi, dtype=float)
    phi_x, x = skew(phi), _squared_norm(phi)
    return np.eye(3) + _spread(_one_minus_cos(x)) * phi_x + _spread(_angle_minus_sin(x)) * (phi_x @ phi_x)


def so3_right_jacobian(phi: Array) -> Array:
    """Return J_r (..., 3, 3) with exp(phi + d) = exp(phi) exp(J_r d)."""
    return so3_left_jacobian(-np.asarray(phi, dtype=float))


def se3(rotation: Array, translation: Array) -> Array:
    """Assemble T (..., 4, 4) from a rotation (..., 3, 3) and a translation (..., 3)."""
    rotation, translation = np.asarray(rotation, dtype=float), np.asarray(translation, dtype=float)
    batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    T = np.zeros((*batch, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T


def se3_exp(xi: Array) -> Array:
    """Return T (..., 4, 4) of a twist (..., 6) ordered [rotation, translation] (Barfoot, eq. 7.33)."""
    xi = np.asarray(xi, dtype=float)
    phi, rho = xi[..., :3], xi[..., 3:]
    return se3(so3_exp(phi), (so3_left_jacobian(phi) @ rho[..., None])[..., 0])


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
    phi, rho = xi[..., :3], xi[..., 3:]
    phi_x, rho_x, x = skew(phi), skew(rho), _squared_norm(phi)
    sandwich = phi_x @ rho_x @ phi_x
    fourth, fifth = _spread(_fourth_order(x)), _spread(_fifth_order(x))
    coupling = (
        0.5 * rho_x
        + _spread(_angle_minus_sin(x)) * (phi_x @ rho_x + rho_x @ phi_x + sandwich)
        + fourth * (phi_x @ phi_x @ rho_x + rho_x @ phi_x @ phi_x - 3.0 * sandwich)
        + 0.5 * (fourth - 3.0 * fifth) * (sandwich @ phi_x + phi_x @ sandwich)
    )
    jacobian = so3_left_jacobian(phi)
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
    outer = np.zeros((*r.shape[:-2], 4, 4))
    for i in range(3):
        outer[..., i, i] = 1.0 + 2.0 * diagonal[..., i] - trace
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[..., j, k] = outer[..., k, j] = r[..., j, k] + r[..., k, j]
        outer[..., i, 3] = outer[..., 3, i] = r[..., k, j] - r[..., j, k]
    outer[..., 3, 3] = 1.0 + trace
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    row = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    row = row / np.sqrt(_squared_norm(row))[..., None]
    return np.where(row[..., 3:] < 0.0, -row, row)


def rotation_from_quaternion(quaternion: Array) -> Array:
    """Return the rotation (..., 3, 3) of a Hamilton quaternion (..., 4) ordered x y z w, of any length > 0."""
    q = np.asarray(quaternion, dtype=float)
    q = q / np.sqrt(_squared_norm(q))[..., None]
    vector_x = skew(q[..., :3])
    return np.eye(3) + 2.0 * (_spread(q[..., 3]) * vector_x + vector_x @ vector_x)


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
