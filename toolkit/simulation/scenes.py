"""The scenes of the scenarios: the road of `drive` and the hall of `flight`, with trajectories of exact derivatives.

A scene is a function of its duration alone, or one of a family of its kind: other corners, hills and turns, other
landmarks, drawn from a stream of random numbers.

Trajectories are uniform B-splines in position and, cumulatively, in SO(3); quintic (C4), so the specific force and the
angular velocity an IMU would measure are exact and smooth. Sources: Qin, "General matrix representations for B-splines"
(2000), for the blending matrix; Kim, Kim & Shin, "A general construction scheme for unit quaternion curves" (1995), and
Sommer et al., "Efficient derivative computation for cumulative B-splines on Lie groups" (2020), for rotations.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import comb, factorial
from typing import Protocol

import numpy as np

from toolkit.geometry import Array, IntArray, about_z, se3, so3_exp, so3_log

SPLINE_ORDER = 6  # control points that act at one instant; the degree is one less
_WORLD_SEED = 20  # draws the landmarks, the same for every seed of a scenario

# The road goes on after the last frame as far as the camera sees.
_ROAD_LEAD_OUT_S = 6.0
_ROAD_LANDMARKS_PER_POSE = 14
_ROAD_POSE_SPACING_M = 2.0
_CORNER_EVERY_S = 20.0

HALL_LOWER_M, HALL_UPPER_M = np.array([-5.0, -5.0, 0.0]), np.array([5.0, 5.0, 4.5])
_HALL_LANDMARKS = 1500
# The IMU of EuRoC's sensor stands on its side: x up, z ahead.
_R_LEVEL_IMU = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])


# Trajectories ---------------------------------------------------------------------------------------------------------


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


# Scenes ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene: the trajectory and the landmarks (M, 3) along it."""

    trajectory: SmoothTrajectory
    points: Array


# Makes a scene of a given duration (s): always the same one, or one drawn from random numbers if any are given.
SceneOf = Callable[..., Scene]


@dataclass(frozen=True)
class _Streets:
    """Parameters of the streets: the directions of the corners, phases (rad) of bends and hills."""

    corner_turns: tuple[float, ...] = (1.0, 1.0, -1.0, 1.0, -1.0, -1.0)  # left is positive; repeated from the first
    bend_phase: float = 0.0
    hill_phases: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def drawn(cls, rng: np.random.Generator, corners: int) -> "_Streets":
        bend, *hills = rng.uniform(0.0, 2.0 * np.pi, 3)
        turns = rng.choice([1.0, -1.0], size=max(corners, 1))
        return cls(tuple(turns.tolist()), bend, (hills[0], hills[1]))


def road(duration_s: float, drawn: np.random.Generator | None = None) -> Scene:
    """Return a drive through hilly streets: 3 to 12 m/s, a right-angled corner every 20 s, slow in the corners."""
    reach_s = duration_s + _ROAD_LEAD_OUT_S
    knots, control_t_s = _knots(0.8, reach_s)
    streets = _Streets() if drawn is None else _Streets.drawn(drawn, int(control_t_s[-1] / _CORNER_EVERY_S) + 1)
    trajectory = RoadTrajectory(VectorSpline(knots, _road_positions(control_t_s, streets)))
    fine_t_s = np.arange(0.0, reach_s, 0.02)
    travelled_m = np.cumsum(0.02 * np.linalg.norm(trajectory.position.at(fine_t_s, 1), axis=1))
    even_m = np.arange(travelled_m[0], travelled_m[-1], _ROAD_POSE_SPACING_M)
    path = trajectory.at(np.interp(even_m, travelled_m, fine_t_s)).T_world_imu
    return Scene(trajectory, roadside(path, _ROAD_LANDMARKS_PER_POSE, drawn or np.random.default_rng(_WORLD_SEED)))


def _road_positions(t_s: Array, streets: _Streets) -> Array:
    """Return positions (N, 3) along the road, from a speed, a turn rate and a slope given as functions of time."""
    dt_s = 0.02
    fine_s = np.arange(t_s[0], t_s[-1] + dt_s, dt_s)
    speed_mps = 7.5 + 4.5 * np.cos(2.0 * np.pi * fine_s / _CORNER_EVERY_S)
    turn_radps = 0.04 * np.sin(2.0 * np.pi * fine_s / 9.0 + streets.bend_phase)
    corners_s = np.arange(0.5 * _CORNER_EVERY_S, t_s[-1], _CORNER_EVERY_S)
    for i, corner_s in enumerate(corners_s):
        # The integral of this bell is a right angle.
        bell = np.exp(-(((fine_s - corner_s) / 2.2) ** 2)) / (2.2 * np.sqrt(np.pi))
        turn_radps += streets.corner_turns[i % len(streets.corner_turns)] * 0.5 * np.pi * bell
    heading = dt_s * np.cumsum(turn_radps)
    travelled_m = dt_s * np.cumsum(speed_mps)
    x = dt_s * np.cumsum(speed_mps * np.cos(heading))
    y = dt_s * np.cumsum(speed_mps * np.sin(heading))
    long, short = streets.hill_phases
    z = 2.0 * np.sin(2.0 * np.pi * travelled_m / 180.0 + long) + 0.4 * np.sin(2.0 * np.pi * travelled_m / 47.0 + short)
    return np.stack([np.interp(t_s, fine_s, axis) for axis in (x, y, z)], axis=-1)


def hall(duration_s: float, drawn: np.random.Generator | None = None) -> Scene:
    """Return a flight of about 1 m/s through a hall of 10 x 10 x 4.5 m, turning about and shaken on all axes."""
    knots, t_s = _knots(0.2, duration_s)
    # Phases (rad) of the way along x, y and z, and of yaw, pitch and roll.
    at, turned = ((0.0, 1.0, 0.5), (0.0, 0.0, 0.7)) if drawn is None else drawn.uniform(0.0, 2.0 * np.pi, (2, 3))
    position = np.stack(
        [
            2.0 * np.sin(0.45 * t_s + at[0]) + 0.04 * np.sin(2.9 * t_s),
            1.8 * np.sin(0.60 * t_s + at[1]) + 0.04 * np.sin(3.3 * t_s),
            2.1 + 0.6 * np.sin(0.80 * t_s + at[2]) + 0.03 * np.sin(3.7 * t_s),
        ],
        axis=-1,
    )
    yaw = 0.25 * t_s + 0.4 * np.sin(0.7 * t_s + turned[0])
    pitch, roll = 0.25 * np.sin(1.1 * t_s + turned[1]), 0.2 * np.sin(1.4 * t_s + turned[2])
    zero = np.zeros_like(t_s)
    tilt = so3_exp(np.stack([zero, pitch, zero], axis=-1)) @ so3_exp(np.stack([roll, zero, zero], axis=-1))
    rotation = about_z(yaw) @ tilt @ _R_LEVEL_IMU
    trajectory = FreeTrajectory(VectorSpline(knots, position), RotationSpline(knots, rotation))
    return Scene(
        trajectory, room(HALL_LOWER_M, HALL_UPPER_M, _HALL_LANDMARKS, drawn or np.random.default_rng(_WORLD_SEED))
    )


def _knots(step_s: float, reach_s: float) -> tuple[UniformKnots, Array]:
    """Return a time base from 0 to a little beyond ``reach_s``, and the times of its control points."""
    before = SPLINE_ORDER // 2
    count = int(np.ceil(reach_s / step_s)) + 2 * before + 3
    start_s = -before * step_s
    control_t_s: Array = start_s + step_s * np.arange(count, dtype=np.float64)
    return UniformKnots(start_s, step_s), control_t_s


def room(lower_m: Array, upper_m: Array, count: int, rng: np.random.Generator) -> Array:
    """Return landmarks (count, 3) on the six faces of a box, with the same density on each face.

    They stand up to 0.3 m in front of their wall, as shelves and posters do, so that no face is a plane.
    """
    size = upper_m - lower_m
    normal = np.repeat([0, 1, 2], 2)
    share = np.prod(size) / size[normal]
    face = rng.choice(6, size=count, p=share / share.sum())
    points = lower_m + rng.uniform(size=(count, 3)) * size
    depth_m = rng.uniform(0.0, 0.3, size=count)
    rows, axis, far = np.arange(count), normal[face], face % 2 == 1
    points[rows, axis] = np.where(far, upper_m[axis] - depth_m, lower_m[axis] + depth_m)
    return points


def roadside(path: Array, per_pose: int, rng: np.random.Generator) -> Array:
    """Return landmarks (M, 3) left and right of a road given by poses (N, 4, 4) of the car, x forward, z up.

    They lie 3.5 to 22 m to a side and from the road's surface to 6 m above the poses, more of them low and
    near; none stands within 3 m of the path, where the car would drive through it.
    """
    from scipy.spatial import KDTree  # 7 MB, which no process that only runs estimators needs

    count = len(path) * per_pose
    share = rng.uniform(size=(count, 4))
    side = np.where(share[:, 0] < 0.5, -1.0, 1.0)
    offset_m = np.stack(
        [4.0 * share[:, 1] - 2.0, side * (3.5 + 18.5 * share[:, 2] ** 1.5), 7.0 * share[:, 3] ** 1.3 - 1.0], axis=-1
    )
    pose = np.repeat(path, per_pose, axis=0)
    points = (pose[:, :3, :3] @ offset_m[:, :, None])[:, :, 0] + pose[:, :3, 3]
    # The nearest pose is looked up, because all distances between an hour's path and its points would take 25 GB.
    along = path[:, :2, 3]
    _, nearest = KDTree(along).query(points[:, :2])
    squared_m2 = ((points[:, :2] - along[nearest]) ** 2).sum(axis=-1)
    return np.asarray(points[squared_m2 >= 3.0**2])
