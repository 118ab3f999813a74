"""The scenes of the scenarios: the road of `drive` and the hall of `flight`.

A scene is a function of its duration alone, or one of a family of its kind: other corners, hills and turns, other
landmarks, drawn from a stream of random numbers.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from toolkit.geometry import Array, BoolArray, about_z, so3_exp
from toolkit.simulation.trajectory import SPLINE_ORDER as ORDER
from toolkit.simulation.trajectory import (
    FreeTrajectory,
    RoadTrajectory,
    RotationSpline,
    SmoothTrajectory,
    UniformKnots,
    VectorSpline,
)

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
    return Scene(trajectory, roadside(path, _ROAD_LANDMARKS_PER_POSE, _landmark_rng(drawn)))


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
    return Scene(trajectory, room(HALL_LOWER_M, HALL_UPPER_M, _HALL_LANDMARKS, _landmark_rng(drawn)))


def _landmark_rng(drawn: np.random.Generator | None) -> np.random.Generator:
    """Return the random stream of the landmarks: always the same one if the scene is not drawn."""
    return np.random.default_rng(_WORLD_SEED) if drawn is None else drawn


def _knots(step_s: float, reach_s: float) -> tuple[UniformKnots, Array]:
    """Return a time base from 0 to a little beyond ``reach_s``, and the times of its control points."""
    before = ORDER // 2
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
    count = len(path) * per_pose
    share = rng.uniform(size=(count, 4))
    side = np.where(share[:, 0] < 0.5, -1.0, 1.0)
    offset_m = np.stack(
        [4.0 * share[:, 1] - 2.0, side * (3.5 + 18.5 * share[:, 2] ** 1.5), 7.0 * share[:, 3] ** 1.3 - 1.0], axis=-1
    )
    pose = np.repeat(path, per_pose, axis=0)
    points = (pose[:, :3, :3] @ offset_m[:, :, None])[:, :, 0] + pose[:, :3, 3]
    return points[~_near_path(points, path, 3.0)]


def _near_path(points: Array, path: Array, radius_m: float) -> BoolArray:
    """Say which points (M, 3) are within a radius of the path (N, 4, 4), seen from above.

    The nearest pose is looked up first, because all distances between an hour's path and its points would take 25 GB.
    """
    along = path[:, :2, 3]
    from scipy.spatial import KDTree  # 7 MB, which no process that only runs estimators needs

    _, nearest = KDTree(along).query(points[:, :2])
    squared = ((points[:, :2] - along[nearest]) ** 2).sum(axis=-1)
    return np.asarray(squared < radius_m**2)
