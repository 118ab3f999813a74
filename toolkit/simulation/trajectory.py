"""Trajectories with exact derivatives: uniform B-splines in position and, cumulatively, in SO(3).

Quintic by default (C4), so the specific force and the angular velocity an IMU would measure are exact and
smooth. Sources: Qin, "General matrix representations for B-splines" (2000), for the blending matrix; Kim, Kim
& Shin, "A general construction scheme for unit quaternion curves" (1995), and Sommer et al., "Efficient
derivative computation for cumulative B-splines on Lie groups" (2020), for rotations.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import comb, factorial
from typing import Protocol

import numpy as np

from toolkit.geometry import Array, IntArray, se3, so3_exp, so3_log

SPLINE_ORDER = 6  # control points that act at one instant; the degree is one less


@dataclass(frozen=True, eq=False)
class Kinematics:
    """The exact motion at N instants.

    ``T_world_imu`` (N, 4, 4); velocity and acceleration (N, 3) in the world, m/s and m/s^2; angular velocity
    (N, 3) in the IMU frame, rad/s.
    """

    T_world_imu: Array
    v_world: Array
    a_world: Array
    w_imu: Array


class SmoothTrajectory(Protocol):
    """A motion with exact derivatives at every instant; not the sampled poses of ``toolkit.estimate.Trajectory``."""

    def at(self, t_s: Array) -> Kinematics: ...


@lru_cache
def blending_matrix(order: int) -> Array:
    """Return M (order, order): control point s weighs sum_n M[s, n] u^n at the phase u in [0, 1) (Qin 2000)."""
    weights = np.zeros((order, order))
    for s in range(order):
        for n in range(order):
            terms = ((-1) ** (i - s) * comb(order, i - s) * (order - 1 - i) ** (order - 1 - n) for i in range(s, order))
            weights[s, n] = comb(order - 1, n) / factorial(order - 1) * sum(terms)
    return weights


@dataclass(frozen=True)
class UniformKnots:
    """The time base of a spline: control point i is centred on ``start_s + i * step_s``."""

    start_s: float
    step_s: float
    order: int = SPLINE_ORDER

    def locate(self, t_s: Array, control_count: int) -> tuple[IntArray, Array]:
        """Return the first acting control point (N,) and the phase (N,) in [0, 1] of the instants (N,) s.

        Raises ValueError at an instant where fewer than ``order`` control points act.
        """
        position = (np.asarray(t_s, dtype=float) - self.start_s) / self.step_s - 0.5 * (self.order - 2)
        first = np.floor(position).astype(np.int64)
        if first.size and (first.min() < 0 or first.max() > control_count - self.order):
            raise ValueError("the spline does not reach all of these instants; give it more control points")
        return first, position - first

    def powers(self, phase: Array, derivative: int) -> Array:
        """Return d^n/dt^n of [1, u, u^2, ...] (N, order) at the phases (N,)."""
        n = np.arange(self.order)
        falling = np.prod([np.maximum(n - d, 0) for d in range(derivative)], axis=0) if derivative else np.ones(n.size)
        exponents = np.maximum(n - derivative, 0)
        return np.asarray(falling * phase[:, None] ** exponents / self.step_s**derivative)


@dataclass(frozen=True, eq=False)
class VectorSpline:
    """A uniform B-spline through a vector space; ``control`` is (C, d)."""

    knots: UniformKnots
    control: Array

    def at(self, t_s: Array, derivative: int = 0) -> Array:
        """Return the value, or its n-th derivative in time, (N, d) at the instants (N,) s."""
        first, phase = self.knots.locate(t_s, len(self.control))
        weights = self.knots.powers(phase, derivative) @ blending_matrix(self.knots.order).T
        acting = self.control[first[:, None] + np.arange(self.knots.order)]
        return np.asarray(np.einsum("ns,nsd->nd", weights, acting))


@dataclass(frozen=True, eq=False)
class RotationSpline:
    """A cumulative uniform B-spline on SO(3); ``control`` is (C, 3, 3)."""

    knots: UniformKnots
    control: Array

    def at(self, t_s: Array) -> tuple[Array, Array]:
        """Return the rotation (N, 3, 3) and its body angular velocity (N, 3) rad/s (Sommer et al., eqs. 26, 33)."""
        order = self.knots.order
        first, phase = self.knots.locate(t_s, len(self.control))
        cumulative = np.cumsum(blending_matrix(order)[::-1], axis=0)[::-1].T
        weights = self.knots.powers(phase, 0) @ cumulative
        rates = self.knots.powers(phase, 1) @ cumulative
        steps = so3_log(np.swapaxes(self.control[:-1], 1, 2) @ self.control[1:])
        rotation, w = self.control[first], np.zeros((first.size, 3))
        for j in range(1, order):
            step = steps[first + j - 1]
            turn = so3_exp(weights[:, j, None] * step)
            rotation = rotation @ turn
            w = (np.swapaxes(turn, 1, 2) @ w[:, :, None])[:, :, 0] + rates[:, j, None] * step
        return rotation, w


@dataclass(frozen=True, eq=False)
class FreeTrajectory:
    """A body that turns independently of where it goes: hand-held or flying."""

    position: VectorSpline
    rotation: RotationSpline

    def at(self, t_s: Array) -> Kinematics:
        R_world_imu, w_imu = self.rotation.at(t_s)
        pose = se3(R_world_imu, self.position.at(t_s))
        return Kinematics(pose, self.position.at(t_s, 1), self.position.at(t_s, 2), w_imu)


@dataclass(frozen=True, eq=False)
class RoadTrajectory:
    """A car: x forward along its velocity, y level and to the left, z up; it must never stand still.

    The attitude follows from the path, so the lateral and vertical body velocities are exactly zero.
    """

    position: VectorSpline

    def at(self, t_s: Array) -> Kinematics:
        """Return the motion at the instants (N,) s; angular velocity from the derivative of the road frame."""
        v, a = self.position.at(t_s, 1), self.position.at(t_s, 2)
        forward, d_forward = _unit_with_rate(v, a)
        up_world = np.array([0.0, 0.0, 1.0])
        left, d_left = _unit_with_rate(np.cross(up_world, forward), np.cross(up_world, d_forward))
        up = np.cross(forward, left)
        w_imu = np.stack([_dot(up, d_left), -_dot(up, d_forward), _dot(left, d_forward)], axis=-1)
        R_world_imu = np.stack([forward, left, up], axis=-1)
        return Kinematics(se3(R_world_imu, self.position.at(t_s)), v, a, w_imu)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", a, b))


def _unit_with_rate(x: Array, d_x: Array) -> tuple[Array, Array]:
    """Return x / |x| (N, 3) and its derivative, given x's."""
    length = np.sqrt(_dot(x, x))[:, None]
    unit = x / length
    return unit, (d_x - unit * _dot(unit, d_x)[:, None]) / length
