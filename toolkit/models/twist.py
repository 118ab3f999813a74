"""Pose kinematics driven by a measured body twist, with an optional gyro bias (Kang, eqs. 1-2).

The pose moves by T <- T exp(dt [w - b, v]); everything is in GTSAM's order [rotation, position] and perturbed
on the right.
"""

from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, se3_adjoint, se3_exp, se3_inverse, se3_right_jacobian
from toolkit.sequence import TwistMotion, TwistNoise


class TwistStep(NamedTuple):
    """The relative motion of one interval and its first-order error.

    ``T_start_end`` (4, 4); ``d_step_d_bias`` (6, 3), the change of the step's end (right perturbation) with
    the gyro bias; ``cov`` (6, 6), the covariance of the step in the tangent of its end, from the noise of
    the twist alone; ``dt_s``, the interval's length.
    """

    T_start_end: Array
    d_step_d_bias: Array
    cov: Array
    dt_s: float


def integrate(motion: TwistMotion, gyro_bias: Array, noise: TwistNoise) -> TwistStep:
    """Integrate the twists of one interval with a gyro bias (3,) rad/s taken off."""
    T_start_end, d_step_d_bias, cov = np.eye(4), np.zeros((6, 3)), np.zeros((6, 6))
    density_squared = np.concatenate([noise.gyro_noise_density**2, noise.velocity_noise_density**2])
    for dt_s, v_mps, w_radps in zip(motion.dt_s, motion.v_mps, motion.w_radps, strict=True):
        xi = dt_s * np.concatenate([w_radps - gyro_bias, v_mps])
        T_start_next, d_step_d_xi = se3_exp(xi), se3_right_jacobian(xi)
        carry = se3_adjoint(se3_inverse(T_start_next))
        T_start_end = T_start_end @ T_start_next
        d_step_d_bias = carry @ d_step_d_bias - dt_s * d_step_d_xi[:, :3]
        cov = carry @ cov @ carry.T + (d_step_d_xi * (dt_s * density_squared)) @ d_step_d_xi.T
    return TwistStep(T_start_end, d_step_d_bias, cov, float(motion.dt_s.sum()))


def bias_walk_cov(noise: TwistNoise, dt_s: float) -> Array:
    """Return the covariance (3, 3) of the gyro bias' walk over an interval."""
    return np.diag(noise.gyro_random_walk**2 * dt_s)
