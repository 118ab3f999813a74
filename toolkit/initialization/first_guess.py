"""The first guess for the adjustment of the first frames: each unknown by linear equations, for any motion.

The rotation of the camera by its tracks and the gyro's differ by the gyro's bias. With attitudes corrected for it, the
motion is linear in the velocity and in the gravity in the first frame. Source: Qin & Shen, "Robust initialization of
monocular visual-inertial estimation on aerial robots" (2017), section V; with stereo the scale is known.
"""

from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, BoolArray, se3, so3_exp, so3_log
from toolkit.measurements import NS_PER_S, ImuMotion, ImuNoise
from toolkit.models.camera_motion import camera_motion
from toolkit.models.gating import huber_weights
from toolkit.models.imu import Preintegration, preintegrate, preintegration_params
from toolkit.sequence import Sequence

# Iterations for the gyro's bias: the second corrects for the linearisation of the first.
_BIAS_STEPS = 2
_REWEIGHTINGS, _HUBER = 5, 1.5
# Median norm of a normal vector of three unit variances.
_MEDIAN_NORM = 1.54
# Velocity and gravity are six unknowns, and their scatter needs some intervals more than the two they take.
_FEWEST_INTERVALS = 6
# The direction of gravity is known where this many of its sigmas are within this share of its length. If its length is
# then wrong by more than both, vision and accelerometer contradict each other.
_GRAVITY_SHARE, _GRAVITY_SIGMAS = 0.15, 4.0


@dataclass(frozen=True, eq=False)
class FirstGuess:
    """Rough states of K frames: poses (K, 4, 4), velocities (K, 3) m/s in the world, and the biases (6,).

    ``contradiction`` says why vision and the motion samples cannot be of one motion, if so.
    """

    T_world_imu: Array
    v_world: Array
    bias: Array
    contradiction: str | None = None


class _SeenMotion(NamedTuple):
    """The IMU's motion T_before_after (N, 4, 4) over N intervals from the tracks alone, and where it is known (N,)."""

    T_before_after: Array
    known: BoolArray


def guess_from_vision(sequence: Sequence) -> FirstGuess:
    """Return the states that the tracks alone show; the world is the first IMU frame."""
    poses = np.array(list(accumulate(_vision_motion(sequence).T_before_after, np.matmul, initial=np.eye(4))))
    t_s = sequence.frames_s
    return FirstGuess(poses, np.gradient(poses[:, :3, 3], t_s, axis=0), np.zeros(6))


def guess_with_imu(sequence: Sequence, motions: list[ImuMotion]) -> FirstGuess:
    """Return the states that the tracks and the IMU's samples between frames show together; the world's z is up.

    Which way is up is the direction of gravity where vision determines it, else of the mean specific force.
    """
    assert isinstance(sequence.noise, ImuNoise)
    seen, params = _vision_motion(sequence), preintegration_params(sequence.noise, sequence.gravity_world)
    bias = np.zeros(6)
    for _ in range(_BIAS_STEPS):
        bias[3:] += _gyro_bias_residual([preintegrate(motion, bias, params) for motion in motions], seen)
    path = _Path.of([preintegrate(motion, bias, params) for motion in motions])
    fallen = float(np.linalg.norm(sequence.gravity_world))
    gravity, contradiction = _gravity(path, seen, fallen)
    v_first = path.velocity_that_fits(seen, gravity)
    level = se3(levelling(-gravity), np.zeros(3))
    poses = level @ se3(path.attitudes, path.positions(v_first, gravity))
    return FirstGuess(poses, path.velocities(v_first, gravity) @ level[:3, :3].T, bias, contradiction)


def _vision_motion(sequence: Sequence) -> _SeenMotion:
    moved = camera_motion(sequence)
    dt_s = np.diff(sequence.frames_t_ns) / NS_PER_S
    return _SeenMotion(moved.steps_of_imu(dt_s, sequence.rig.T_imu_cam), moved.known)


def _gyro_bias_residual(pieces: list[Preintegration], seen: _SeenMotion) -> Array:
    """Return the rate (3,) rad/s by which the gyro turns faster than the tracks show, over all known intervals.

    A bias b over dt turns by exp(-b dt) on the right, to first order.
    """
    if not seen.known.any():
        return np.zeros(3)
    turned = np.array([piece.deltaRij().matrix() for piece in pieces])
    dt_s = np.array([piece.deltaTij() for piece in pieces])
    off = so3_log(np.swapaxes(turned, 1, 2) @ seen.T_before_after[:, :3, :3])
    rate, _ = _robust(-(dt_s[:, None, None] * np.eye(3))[seen.known], off[seen.known])
    return rate


@dataclass(frozen=True, eq=False)
class _Path:
    """The motion over N intervals by the IMU alone, in the axes of the first frame.

    ``t_s`` (N + 1,), ``attitudes`` (N + 1, 3, 3), and ``gained_mps``, ``gained_m`` (N + 1, 3): velocity and position
    that the specific force has given since the first frame, from rest and without gravity.
    """

    t_s: Array
    attitudes: Array
    gained_mps: Array
    gained_m: Array

    @classmethod
    def of(cls, pieces: list[Preintegration]) -> "_Path":
        """Chain the preintegrated intervals."""
        t_s, turn, speed, place = [0.0], [np.eye(3)], [np.zeros(3)], [np.zeros(3)]
        for piece in pieces:
            dt_s = piece.deltaTij()
            place.append(place[-1] + dt_s * speed[-1] + turn[-1] @ piece.deltaPij())
            speed.append(speed[-1] + turn[-1] @ piece.deltaVij())
            turn.append(turn[-1] @ piece.deltaRij().matrix())
            t_s.append(t_s[-1] + dt_s)
        return cls(np.array(t_s), np.array(turn), np.array(speed), np.array(place))

    def positions(self, v_first: Array, gravity: Array) -> Array:
        """Return the positions (N + 1, 3) m from the first velocity and gravity (3,)."""
        return np.asarray(self.gained_m + self.t_s[:, None] * v_first + 0.5 * self.t_s[:, None] ** 2 * gravity)

    def velocities(self, v_first: Array, gravity: Array) -> Array:
        """Return the velocities (N + 1, 3) m/s from the first velocity and gravity (3,)."""
        return np.asarray(self.gained_mps + v_first + self.t_s[:, None] * gravity)

    def translation_residuals(self, seen: _SeenMotion) -> Array:
        """Return the known translations of the camera (M, 3) m less those that the specific force explains."""
        seen_m = (self.attitudes[:-1] @ seen.T_before_after[:, :3, 3:])[..., 0]
        return np.asarray((seen_m - np.diff(self.gained_m, axis=0))[seen.known])

    def velocity_that_fits(self, seen: _SeenMotion, gravity: Array) -> Array:
        """Return the first velocity (3,) m/s that explains the seen translations best; zero where none is known."""
        if not seen.known.any():
            return np.zeros(3)
        per_gravity = 0.5 * np.diff(self.t_s**2)[seen.known]
        per_velocity = np.diff(self.t_s)[seen.known, None, None] * np.eye(3)
        return _robust(per_velocity, self.translation_residuals(seen) - per_gravity[:, None] * gravity)[0]


def _gravity(path: _Path, seen: _SeenMotion, length: float) -> tuple[Array, str | None]:
    """Return gravity (3,) m/s^2 in the first frame, and the contradiction, if there is one."""
    down = -path.gained_mps[-1]
    contradiction = None
    if seen.known.sum() >= _FEWEST_INTERVALS:
        per_velocity, per_gravity = (np.diff(t)[seen.known] for t in (path.t_s, 0.5 * path.t_s**2))
        design = np.concatenate([per_velocity[:, None, None] * np.eye(3), per_gravity[:, None, None] * np.eye(3)], 2)
        found, cov = _robust(design, path.translation_residuals(seen))
        uncertain = _GRAVITY_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(cov[3:, 3:])[-1]))
        share = _GRAVITY_SHARE * length
        if uncertain < share:
            down, found_length = found[3:], float(np.linalg.norm(found[3:]))
            if abs(found_length - length) > share + uncertain:
                contradiction = f"stereo and accelerometer show a gravity of {found_length:.1f} m/s^2, not {length:.1f}"
    return length * down / max(float(np.linalg.norm(down)), 1e-9), contradiction


def _robust(design: Array, observed: Array) -> tuple[Array, Array]:
    """Solve design (N, 3, d) x = observed (N, 3) with Huber's weights; return x (d,) and its covariance (d, d).

    The scale is that of the median residual.
    """
    weights = np.ones(len(observed))
    size = design.shape[2]
    for _ in range(_REWEIGHTINGS):
        weighted = np.swapaxes(design, 1, 2) * weights[:, None, None]
        normal = (weighted @ design).sum(axis=0)
        solution = np.linalg.solve(normal, (weighted @ observed[..., None]).sum(axis=0)[:, 0])
        off2 = ((observed - design @ solution) ** 2).sum(axis=1)
        scale = max(float(np.sqrt(np.median(off2))) / _MEDIAN_NORM, 1e-12)
        weights = huber_weights(off2 / scale**2, _HUBER)
    freedom = max(3 * len(observed) - size, 1) / (3 * len(observed))
    return solution, np.linalg.inv(normal) * scale**2 / freedom


def levelling(up: Array) -> Array:
    """Return the least rotation (3, 3) that takes a direction (3,) to the z-axis; of straight down a half turn.

    No direction at all, as where an accelerometer reads zeros, is left as it is.
    """
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    half_turn = np.array([np.pi, 0.0, 0.0]) if up[2] < 0.0 else np.zeros(3)
    return so3_exp(axis / sine * np.arctan2(sine, up[2]) if sine > 1e-12 else half_turn)
