"""The prediction by the samples of an IMU, compiled: the same numbers as those of :mod:`toolkit.models.imu`, sooner.

GTSAM's preintegration is called once a sample from Python, which takes as long as all other propagation.

Sources: Forster et al. 2017, "On-manifold preintegration for real-time visual-inertial odometry", eqs. 26-38; GTSAM's
``TangentPreintegration`` and ``PreintegratedCombinedMeasurements``, whose results these are to rounding (tested).
"""

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import types

from filters.kalman.kernels import Arrays, compiled, kernel, what_was_compiled
from toolkit.geometry import Array
from toolkit.measurements import ImuMotion, Motion, Prior
from toolkit.models.imu import INTEGRATION_DENSITY, ImuModel, transition_over
from toolkit.models.state import Belief, Prediction

_BEGAN_CPU_S = time.process_time()
# Of a series in the squared angle x: coefficients of sin a / a, (1 - cos a) / x and (a - sin a) / (a x), of what the
# inverse Jacobian has before the square, e = (1 - (a / 2) cot(a / 2)) / x, and of de/dx.
_E_SERIES = (
    1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000, 1 / 74724249600,
    3617 / 10670622842880000,
)  # fmt: skip
_SERIES = np.array(
    [
        (*((-1) ** k / math.factorial(2 * k + i) for i in (1, 2, 3)), _E_SERIES[k], (k + 1) * _E_SERIES[k + 1])
        for k in range(len(_E_SERIES) - 1)
    ]
)
_SMALL_ANGLE_SQUARED = 0.25


@compiled
def turn_coefficients(x: float) -> tuple[float, float, float, float, float]:
    """Return what ``_SERIES`` is of, at a squared angle."""
    if x < _SMALL_ANGLE_SQUARED:
        first, second, third, e, slope = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(_SERIES.shape[0] - 1, -1, -1):
            first, second, third = first * x + _SERIES[k, 0], second * x + _SERIES[k, 1], third * x + _SERIES[k, 2]
            e, slope = e * x + _SERIES[k, 3], slope * x + _SERIES[k, 4]
        return first, second, third, e, slope
    a = math.sqrt(x)
    sine, half_sine, half_cosine = math.sin(a), math.sin(0.5 * a), math.cos(0.5 * a)
    e = (1.0 - 0.5 * a * half_cosine / half_sine) / x
    slope = ((1.0 - sine / a) / (8.0 * half_sine * half_sine) - e) / x
    return sine / a, 2.0 * half_sine * half_sine / x, (a - sine) / (a * x), e, slope


@compiled
def squared_length(v: Array) -> float:
    """Return the squared length of v (3,)."""
    return float(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@compiled
def write_turn(v: Array, a: float, b: float, turns: Array, n: int) -> None:
    """Write ``1 + a [v]x + b [v]x^2`` to turns[n] (3, 3)."""
    diagonal = 1.0 - b * squared_length(v)
    for i in range(3):
        for k in range(3):
            turns[n, i, k] = b * v[i] * v[k] + (diagonal if i == k else 0.0)
    for i in range(3):
        turns[n, (i + 1) % 3, (i + 2) % 3] -= a * v[i]
        turns[n, (i + 2) % 3, (i + 1) % 3] += a * v[i]


@compiled
def derive_inverse_turn(v: Array, w: Array, e: float, slope: float, turns: Array, n: int) -> None:
    """Write the derivative by v of ``(1 + [v]x / 2 + e [v]x^2) w`` to turns[n] (3, 3); ``slope`` is de/dv^2."""
    x, along = squared_length(v), v[0] * w[0] + v[1] * w[1] + v[2] * w[2]
    for i in range(3):
        for k in range(3):
            turns[n, i, k] = e * (v[i] * w[k] - 2.0 * w[i] * v[k]) + 2.0 * slope * (v[i] * along - w[i] * x) * v[k]
        turns[n, i, i] += e * along
    for i in range(3):
        turns[n, (i + 1) % 3, (i + 2) % 3] += 0.5 * w[i]
        turns[n, (i + 2) % 3, (i + 1) % 3] -= 0.5 * w[i]


@compiled
def multiply_rows(errors: Array, first: int, columns: int, turns: Array, n: int) -> None:
    """Multiply rows ``first`` to ``first + 3`` of some columns of ``errors`` by turns[n] (3, 3)."""
    for c in range(columns):
        x, y, z = errors[first, c], errors[first + 1, c], errors[first + 2, c]
        for i in range(3):
            errors[first + i, c] = turns[n, i, 0] * x + turns[n, i, 1] * y + turns[n, i, 2] * z


@compiled
def transpose(errors: Array, size: int) -> None:
    """Transpose the first ``size`` rows and columns of ``errors`` in place."""
    for i in range(size):
        for k in range(i):
            errors[i, k], errors[k, i] = errors[k, i], errors[i, k]


@compiled
def carry_errors(errors: Array, columns: int, turns: Array, dt: float) -> None:
    """Carry errors (15, .) [theta, position, velocity, accel bias, gyro bias] of a preintegration over dt s.

    ``turns`` as in :func:`preintegrate`.
    """
    for c in range(columns):
        t0, t1, t2, a0, a1, a2 = errors[0, c], errors[1, c], errors[2, c], errors[9, c], errors[10, c], errors[11, c]
        g0, g1, g2 = errors[12, c], errors[13, c], errors[14, c]
        for i in range(3):
            force = turns[4, i, 0] * t0 + turns[4, i, 1] * t1 + turns[4, i, 2] * t2
            force -= turns[0, i, 0] * a0 + turns[0, i, 1] * a1 + turns[0, i, 2] * a2
            rate = turns[3, i, 0] * t0 + turns[3, i, 1] * t1 + turns[3, i, 2] * t2
            rate -= turns[2, i, 0] * g0 + turns[2, i, 1] * g1 + turns[2, i, 2] * g2
            errors[i, c] += dt * rate
            errors[3 + i, c] += dt * errors[6 + i, c] + 0.5 * dt * dt * force
            errors[6 + i, c] += dt * force


@compiled
def preintegrate(samples: Arrays, bias: Array, variances: Array, mean: Arrays, errors: Array) -> None:
    """Preintegrate samples to theta, position and velocity, (3,) each, of ``mean``.

    The first fifteen columns of ``errors`` (15, 21) become the covariance, the others the derivative by the bias. With
    n a specific force in the axes of the first sample's beginning, and theta the rotation vector since then, the
    matrices (3, 3) of a sample are exp(theta), its left Jacobian J_l, the inverse of the right one, the derivative by
    theta of this times the turn rate, that of n by theta, ``-[n]x J_l``, and the turn from its middle to its beginning.
    """
    dts_s, accels_mps2, gyros_radps = samples
    theta, position, velocity = mean
    rate, force, turns = np.empty(3), np.empty(3), np.empty((6, 3, 3))
    factors = np.array(((0.0, 0.0), (0.0, 0.0), (0.5, 0.0)))
    for n in range(dts_s.size):
        dt = dts_s[n]
        for i in range(3):
            rate[i] = gyros_radps[n, i] - bias[3 + i]
        first, second, _, _, _ = turn_coefficients(0.25 * dt * dt * squared_length(rate))
        write_turn(rate, 0.5 * dt * first, 0.25 * dt * dt * second, turns, 5)
        factors[0, 0], factors[0, 1], factors[1, 1], factors[2, 1], slope = turn_coefficients(squared_length(theta))
        factors[1, 0] = factors[0, 1]
        for i in range(3):
            write_turn(theta, factors[i, 0], factors[i, 1], turns, i)
        derive_inverse_turn(theta, rate, factors[2, 1], slope, turns, 3)
        for i in range(3):
            force[i] = 0.0
            for j in range(3):
                for k in range(3):
                    force[i] += turns[0, i, j] * turns[5, j, k] * (accels_mps2[n, k] - bias[k])
        for c in range(3):
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                turns[4, i, c] = turns[1, j, c] * force[k] - turns[1, k, c] * force[j]
        for columns in (21, 15):
            carry_errors(errors, columns, turns, dt)
            transpose(errors, 15)
        for i in range(3):
            for k in range(3):
                for c in range(3):
                    errors[i, k] += dt * variances[1] * turns[2, i, c] * turns[2, k, c]
                theta[i] += dt * turns[2, i, k] * rate[k]
            errors[3 + i, 3 + i] += 0.25 * dt * dt * dt * variances[0] + dt * variances[4]
            errors[3 + i, 6 + i] += 0.5 * dt * dt * variances[0]
            errors[6 + i, 3 + i] += 0.5 * dt * dt * variances[0]
            errors[6 + i, 6 + i] += dt * variances[0]
            errors[9 + i, 9 + i] += dt * variances[2]
            errors[12 + i, 12 + i] += dt * variances[3]
            position[i] += dt * velocity[i] + 0.5 * dt * dt * force[i]
            velocity[i] += dt * force[i]


# Arrays of packets are read-only.
def _given(axes: int) -> Any:
    return types.Array(types.float64, axes, "C", readonly=True)


@kernel(
    types.Tuple((_given(1), _given(2), _given(2))), types.Tuple((_given(2), _given(1), _given(1))), _given(1), _given(1)
)
def predict_by_imu(
    samples: Arrays, start: Arrays, gravity_world: Array, variances: Array
) -> tuple[Array, Array, Array, Array]:
    """Predict a state over the samples of an IMU, preintegrated about its bias, as :mod:`toolkit.models.imu` does.

    ``samples`` are durations (n,) s, and specific forces (n, 3) m/s^2 and turn rates (n, 3) rad/s of their middles;
    ``start`` is T_world_imu (4, 4), v_world (3,) m/s and the bias (6,) [accel, gyro]; ``variances`` (5,) are squared
    densities: of accelerometer, gyro, their random walks, and the integration of the position. Returns the pose, the
    velocity, the transition (15, 15) and the noise (15, 15) of the prediction.

    It is GTSAM's preintegration in the tangent space: theta, the rotation vector since the beginning, is integrated as
    the position and the velocity are, with the noise of its combined measurements (Forster et al. 2017, eqs. 26-38).
    """
    T_world_imu, v_world, bias = start
    theta, p, v, errors = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((15, 21))
    for i in range(6):
        errors[9 + i, 15 + i] = 1.0
    preintegrate(samples, bias, variances, (theta, p, v), errors)
    dt = 0.0
    for n in range(samples[0].size):
        dt += samples[0][n]
    # Errors of theta, position and velocity become those of the state at the end, in its axes.
    turns, T_world_end, v_world_end, transition = np.empty((2, 3, 3)), np.zeros((4, 4)), np.empty(3), np.eye(15)
    first, second, third, _, _ = turn_coefficients(squared_length(theta))
    write_turn(theta, -second, third, turns, 0)
    write_turn(theta, -first, second, turns, 1)
    for columns in (21, 15):
        for block in range(3):
            multiply_rows(errors, 3 * block, columns, turns, min(block, 1))
        transpose(errors, 15)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        T_world_end[i, 3] = T_world_imu[i, 3] + dt * v_world[i] + 0.5 * dt * dt * gravity_world[i]
        v_world_end[i] = v_world[i] + dt * gravity_world[i]
        for c in range(3):
            transition[c, i] = transition[3 + c, 3 + i] = transition[6 + c, 6 + i] = turns[1, c, i]
            transition[3 + c, 6 + i] = dt * turns[1, c, i]
            transition[3 + c, i] = p[j] * turns[1, c, k] - p[k] * turns[1, c, j]
            transition[6 + c, i] = v[j] * turns[1, c, k] - v[k] * turns[1, c, j]
            T_world_end[i, 3] += T_world_imu[i, c] * p[c]
            v_world_end[i] += T_world_imu[i, c] * v[c]
            for d in range(3):
                T_world_end[i, c] += T_world_imu[i, d] * turns[1, c, d]
    T_world_end[3, 3] = 1.0
    for i in range(9):
        for c in range(6):
            transition[i, 9 + c] = errors[i, 15 + c]
    return T_world_end, v_world_end, transition, np.ascontiguousarray(errors[:, :15])


COMPILED = what_was_compiled("the prediction by an IMU", (predict_by_imu,), _BEGAN_CPU_S)


@dataclass(frozen=True, eq=False)
class CompiledIncrement:
    """The samples between two frames, squared noise densities (5,), and gravity (3,) m/s^2 in the world."""

    motion: ImuMotion
    variances: Array
    gravity_world: Array

    def predict(self, start: Belief) -> Prediction:
        samples = self.motion.dt_s, self.motion.accel_mps2, self.motion.gyro_radps
        mean = start.T_world_imu, start.v_world, start.bias
        return Prediction(*predict_by_imu(samples, mean, self.gravity_world, self.variances))

    def transition_between(self, start: Belief, end: Prediction) -> Array:
        return transition_over(float(self.motion.dt_s.sum()), self.gravity_world, start, end)


class CompiledImu:
    """What filters need of an :class:`ImuModel`, preintegrated about the bias of the state that is predicted."""

    def __init__(self, model: ImuModel) -> None:
        self._model = model

    def initial_belief(self, prior: Prior) -> Belief:
        return self._model.initial_belief(prior)

    def integrate(self, motion: Motion, bias: Array) -> CompiledIncrement:
        assert isinstance(motion, ImuMotion)
        noise = self._model.noise_over(motion)
        white = noise.accel_noise_density, noise.gyro_noise_density
        densities = np.array([*white, noise.accel_random_walk, noise.gyro_random_walk, INTEGRATION_DENSITY])
        return CompiledIncrement(motion, densities**2, self._model.gravity_world)
