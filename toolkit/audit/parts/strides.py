"""The measured motion integrated over strides of several frames, its residuals at states at their ends, and its noise.

The samples of an IMU are preintegrated; twists are chained, with an unknown rotation of their velocities. The
derivatives by the biases are difference quotients; for biases of usual size the integrals are linear in them. Source:
Forster, Carlone, Dellaert & Scaramuzza, "On-manifold preintegration for real-time visual-inertial odometry" (2017),
section VI.
"""

from functools import reduce
from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.intervals import interval_means, subdivided
from toolkit.geometry import Array, IntArray, se3_exp, skew, so3_exp, so3_log
from toolkit.measured_motion import ImuNoise, TwistMotion, TwistNoise, motions_between
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# Difference of a bias (rad/s, and m/s^2 or rad) for the difference quotients.
_DIFFERENCE = 1e-4
# Error of a gyro in addition to its stated noise, as a density (rad/s/sqrt(Hz)) over the time between its samples (s),
# because real gyros filter vibration. With it the only recording at hand of a vehicle (100 Hz) fits its calibration.
GYRO_ERROR = 0.1


class ImuStrides(NamedTuple):
    """An IMU's samples integrated over the strides between m + 1 frames, of durations (m,) s.

    Rotations (m, 3, 3), and changes (m, 3) of velocity and position in the axes at the begin of a stride, from rest and
    without gravity. The derivatives (m, 3, 6) are those of the rotation's logarithm and of the changes by the biases of
    gyro and accelerometer, in that order. ``whitener`` (m, 9, 9) makes the errors independent and of variance 1.
    """

    dt_s: Array
    R_a_b: Array
    faster: Array
    moved: Array
    d_turn: Array
    d_faster: Array
    d_moved: Array
    whitener: Array

    @property
    def state_size(self) -> int:
        """Number of a state's unknowns in the equations: rotation, position and velocity."""
        return 9

    @property
    def gravity_size(self) -> int:
        """Number of unknowns of gravity in the equations."""
        return 3

    def biased(self, bias: Array) -> "ImuStrides":
        """Return the strides with these biases (6,)."""
        return self._replace(
            R_a_b=self.R_a_b @ so3_exp(self.d_turn @ bias),
            faster=self.faster + self.d_faster @ bias,
            moved=self.moved + self.d_moved @ bias,
        )

    def equations(
        self, R_first_imu: Array, position: Array, velocity: Array, gravity: Array, bias: Array
    ) -> tuple[Array, Array]:
        """Return the residuals (m, 9), rotation, velocity and position, and their Jacobian (m, 9, 27) by the unknowns.

        States are m + 1 attitudes (m + 1, 3, 3), positions and velocities (m + 1, 3) in the axes of the first, with
        gravity (3,). Unknowns are the states at both ends (9 each), gravity and the biases (6,).
        """
        strides = self.biased(bias)
        dt_s, one = strides.dt_s[:, None], np.eye(3)
        R_first_a, R_first_b = R_first_imu[:-1], R_first_imu[1:]
        R_b_a = R_first_b.swapaxes(1, 2) @ R_first_a
        turn = so3_log(strides.R_a_b.swapaxes(1, 2) @ R_b_a.swapaxes(1, 2))
        faster = velocity[1:] - velocity[:-1] - gravity * dt_s - _applied(R_first_a, strides.faster)
        moved = position[1:] - position[:-1] - velocity[:-1] * dt_s
        moved = moved - 0.5 * gravity * dt_s**2 - _applied(R_first_a, strides.moved)
        d = np.zeros((len(dt_s), 9, 27))
        d[:, :3, :3], d[:, :3, 9:12], d[:, :3, 21:] = -R_b_a, one, -strides.d_turn
        d[:, 3:6, :3], d[:, 3:6, 6:9], d[:, 3:6, 15:18] = R_first_a @ skew(strides.faster), -one, one
        d[:, 3:6, 18:21], d[:, 3:6, 21:] = -dt_s[:, :, None] * one, -R_first_a @ strides.d_faster
        d[:, 6:, :3], d[:, 6:, 3:6], d[:, 6:, 12:15] = R_first_a @ skew(strides.moved), -one, one
        d[:, 6:, 6:9], d[:, 6:, 18:21] = -dt_s[:, :, None] * one, -0.5 * dt_s[:, :, None] ** 2 * one
        d[:, 6:, 21:] = -R_first_a @ strides.d_moved
        return -np.concatenate([turn, faster, moved], axis=1), d


class TwistStrides(NamedTuple):
    """The same of odometry: durations (m,) s, rotations (m, 3, 3) and displacements (m, 3) m in the axes at the begin.

    The derivatives (m, 3, 6) are by the bias of the gyro and by a rotation (rad) of the measured velocities, which slip
    and pitch of a vehicle cause; ``whitener`` (m, 6, 6).
    """

    dt_s: Array
    R_a_b: Array
    moved: Array
    d_turn: Array
    d_moved: Array
    whitener: Array

    @property
    def state_size(self) -> int:
        """Number of a state's unknowns in the equations: rotation and position."""
        return 6

    @property
    def gravity_size(self) -> int:
        """Number of unknowns of gravity in the equations: none."""
        return 0

    def equations(
        self, R_first_imu: Array, position: Array, velocity: Array, gravity: Array, bias: Array
    ) -> tuple[Array, Array]:
        """Return the residuals (m, 6), rotation and position, and their Jacobian (m, 6, 18) by the unknowns.

        Unknowns are the poses at both ends (6 each) and the biases (6,).
        """
        R_first_a, R_first_b, one = R_first_imu[:-1], R_first_imu[1:], np.eye(3)
        R_b_a = R_first_b.swapaxes(1, 2) @ R_first_a
        R_a_b, way = self.R_a_b @ so3_exp(self.d_turn @ bias), self.moved + self.d_moved @ bias
        turn = so3_log(R_a_b.swapaxes(1, 2) @ R_b_a.swapaxes(1, 2))
        moved = position[1:] - position[:-1] - _applied(R_first_a, way)
        d = np.zeros((len(way), 6, 18))
        d[:, :3, :3], d[:, :3, 6:9], d[:, :3, 12:] = -R_b_a, one, -self.d_turn
        d[:, 3:, :3], d[:, 3:, 3:6], d[:, 3:, 9:12] = R_first_a @ skew(way), -one, one
        d[:, 3:, 12:] = -R_first_a @ self.d_moved
        return -np.concatenate([turn, moved], axis=1), d


def imu_strides(sequence: Sequence, t_ns: IntArray, w_bias_radps: Array) -> ImuStrides:
    """Integrate an IMU's samples, less a bias (3,) of the gyro, between stamps (m + 1,) of frames."""
    part_t_ns, frame_at = subdivided(t_ns)
    count, parts = len(t_ns) - 1, int(frame_at[1])
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values, part_t_ns).reshape(count, parts, 6)
    h_s = (np.diff(part_t_ns) / NS_PER_S).reshape(count, parts, 1)
    gyro_first = np.eye(6)[[3, 4, 5, 0, 1, 2]]
    off = np.concatenate([np.zeros((1, 6)), _DIFFERENCE * gyro_first])[:, None] + np.append(np.zeros(3), w_bias_radps)
    R_a_now = np.tile(np.eye(3), (7, count, 1, 1))
    faster, moved = np.zeros((7, count, 3)), np.zeros((7, count, 3))
    for k in range(parts):
        sample, step_s = mean[None, :, k] - off, h_s[None, :, k]
        half = so3_exp(0.5 * step_s * sample[..., 3:])
        middle = R_a_now @ half
        force = (middle @ sample[..., :3, None])[..., 0]
        moved = moved + step_s * faster + 0.5 * step_s**2 * force
        faster = faster + step_s * force
        R_a_now = middle @ half
    turned = so3_log(R_a_now[0].swapaxes(1, 2) @ R_a_now[1:])
    changed = (turned, faster[1:] - faster[0], moved[1:] - moved[0])
    d_turn, d_faster, d_moved = (np.moveaxis(x / _DIFFERENCE, 0, -1) for x in changed)
    dt_s = np.diff(t_ns) / NS_PER_S
    whitener = _imu_whitener(sequence, dt_s)
    return ImuStrides(dt_s, R_a_now[0], faster[0], moved[0], d_turn, d_faster, d_moved, whitener)


def _imu_whitener(sequence: Sequence, dt_s: Array) -> Array:
    """Return the whitener (m, 9, 9) of the errors of an IMU's strides: the samples' noise, integrated twice.

    The part of a position's error that is independent of the velocity's has the variance density^2 dt^3 / 12.
    """
    noise = sequence.noise
    assert isinstance(noise, ImuNoise)
    sample_s = float(np.median(np.diff(sequence.motion.t_ns))) / NS_PER_S
    gyro, accel = float(np.hypot(noise.gyro_noise_density, GYRO_ERROR * sample_s)), noise.accel_noise_density
    whitener, one = np.zeros((len(dt_s), 9, 9)), np.eye(3)
    rest = (np.sqrt(12.0 / dt_s**3) / accel)[:, None, None]
    whitener[:, :3, :3] = (1.0 / np.sqrt(dt_s) / gyro)[:, None, None] * one
    whitener[:, 3:6, 3:6] = (1.0 / np.sqrt(dt_s) / accel)[:, None, None] * one
    whitener[:, 6:, 6:], whitener[:, 6:, 3:6] = rest * one, -0.5 * dt_s[:, None, None] * rest * one
    return whitener


def twist_strides(sequence: Sequence, t_ns: IntArray, w_bias_radps: Array) -> TwistStrides:
    """Chain the twists, less a bias (3,) of the gyro, between stamps (m + 1,) of frames."""
    off = np.concatenate([np.zeros((1, 6)), _DIFFERENCE * np.eye(6)])[:, None]
    motions = [motion for motion in motions_between(sequence.motion, t_ns, None) if isinstance(motion, TwistMotion)]
    w_radps = np.concatenate([motion.w_radps for motion in motions]) - w_bias_radps - off[:, :, :3]
    v_mps = np.concatenate([motion.v_mps for motion in motions])
    v_mps = v_mps + np.cross(off[:, :, 3:], v_mps)
    part_s = np.concatenate([motion.dt_s for motion in motions])[:, None]
    steps = se3_exp(part_s * np.concatenate([w_radps, v_mps], axis=2)).swapaxes(0, 1)
    of_strides = np.split(steps, np.cumsum([motion.dt_s.size for motion in motions])[:-1])
    at_rest = np.tile(np.eye(4), (7, 1, 1))
    T_a_b = np.array([reduce(np.matmul, of_stride, at_rest) for of_stride in of_strides])
    R_a_b, moved, dt_s = T_a_b[:, :, :3, :3], T_a_b[:, :, :3, 3], np.diff(t_ns) / NS_PER_S
    turned = so3_log(R_a_b[:, :1].swapaxes(2, 3) @ R_a_b[:, 1:])
    d_turn, d_moved = (np.moveaxis(x / _DIFFERENCE, 1, -1) for x in (turned, moved[:, 1:] - moved[:, :1]))
    return TwistStrides(dt_s, R_a_b[:, 0], moved[:, 0], d_turn, d_moved, _twist_whitener(sequence, dt_s))


def _twist_whitener(sequence: Sequence, dt_s: Array) -> Array:
    """Return the whitener (m, 6, 6) of the errors of odometry's strides: the stated noise of its twists."""
    noise = sequence.noise
    assert isinstance(noise, TwistNoise)
    density = np.concatenate([noise.gyro_noise_density, noise.velocity_noise_density])
    return np.asarray(np.eye(6) / (np.sqrt(dt_s)[:, None] * density)[:, None])


def _applied(matrix: Array, vector: Array) -> Array:
    """Return the products (N, i) of matrices (N, i, j) and vectors (N, j)."""
    return np.asarray((matrix @ vector[:, :, None])[..., 0])
