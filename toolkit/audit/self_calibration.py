"""Self-calibration: windows of key frames adjusted to tracks and measured motion, with an unknown calibration.

From frame to frame, the noise of the tracks hides small errors of a focal length, a clock or a rotation. Points
followed over a second, together with the integrated IMU or odometry, show them. Unknowns of a window are the poses of
its key frames (rotation on the right, position in the axes of the first), their velocities and gravity; common to all
windows is the calibration (21). Points are eliminated track by track, then the window's own unknowns; what remains is
the window's information on the calibration. Source: Triggs, McLauchlan, Hartley & Fitzgibbon, "Bundle adjustment - a
modern synthesis" (2000), section 6. The samples of an IMU are preintegrated as for the estimators (`models.imu`),
twists are chained. For biases of usual size both are linear in them (Forster et al., "On-manifold preintegration for
real-time visual-inertial odometry", 2017, section VI).
"""

import functools
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from toolkit.audit.alignment import Position
from toolkit.audit.intervals import Intervals, chained, interval_means, moved_as_measured, moved_by, usual_step_s
from toolkit.audit.robust import LEVEL
from toolkit.errors import DataError
from toolkit.geometry import Array, BoolArray, IntArray, se3, se3_exp, se3_inverse, skew, so3_exp, so3_log, transform
from toolkit.measurements import NS_PER_S, ImuMotion, ImuNoise, MotionKind, StereoRig, TwistMotion, TwistNoise
from toolkit.models.camera_motion import CameraMotion
from toolkit.models.gating import CHI2_3_MEDIAN
from toolkit.models.imu import predict, preintegrate, preintegration_params
from toolkit.models.stereo import disparity_px, project, projection_jacobian, triangulate
from toolkit.models.stereo_adjustment import ReducedVision, Sightings, eliminated
from toolkit.motion_samples import motions_between
from toolkit.sequence import Sequence

# Difference of a bias (rad/s) and of a rotation (rad) for the difference quotients.
_DIFFERENCE = 1e-4
# Error of a gyro in addition to its stated noise, as a density (rad/s/sqrt(Hz)) over the time between its samples (s):
# real gyros filter vibration.
GYRO_ERROR = 0.1
POSE, STATE, GRAVITY, COMMON = 6, 9, 3, 21
# The common unknowns, in order: logarithms of fx and fy; cx and cy (px); the logarithm of the baseline; the rotation of
# the camera in its own axes (rad); its position in the IMU frame (m); the delay of the images after their stamps (s);
# the change of the delay from the first half of the recording to the second (s); the biases of gyro and accelerometer,
# or with odometry of the gyro and the rotation of the velocities (rad); the shift of the columns of the right image
# (px); the roll of the right camera about the optical axis (rad).
BASELINE, TURN, LEVER, LATE, CHANGE = 4, slice(5, 8), slice(8, 11), 11, 12
GYRO_BIAS, _BIASES, RIGHT_SHIFT, RIGHT_ROLL = slice(13, 16), slice(13, 19), 19, 20
# Those on which sightings depend.
_OF_CAMERA = np.r_[:13, RIGHT_SHIFT, RIGHT_ROLL]
_CAMERA = len(_OF_CAMERA)
CAUCHY_SIGMAS, LEAST_SCALE2 = 2.0, 1e-4
LEAST_DEPTH_M = 0.1
# Information that fixes the first pose, and a ridge far below the information of a sighting.
_GAUGE, _RIDGE = 1e10, 1e-9


class Strides(NamedTuple):
    """The measured motion over the m strides between key frames, of durations (m,) s.

    Rotations (m, 3, 3), and changes (m, 3) of velocity and position in the axes at the begin of a stride, from rest and
    without gravity; odometry measures no change of velocity, and its displacements are whole. The derivatives (m, 3, 6)
    are those of the rotation's logarithm and of the changes by the biases of gyro and accelerometer or, with odometry,
    of the gyro and a rotation (rad) of the velocities, which slip and pitch of a vehicle cause. ``whitener`` (m, 9, 9)
    makes the errors independent and of variance 1. ``inertial`` is 1 with an IMU, 0 with odometry.
    """

    dt_s: Array
    R_a_b: Array
    faster: Array
    moved: Array
    d_turn: Array
    d_faster: Array
    d_moved: Array
    whitener: Array
    inertial: float

    def equations(
        self, R_first_imu: Array, position: Array, velocity: Array, gravity: Array, bias: Array
    ) -> tuple[Array, Array]:
        """Return the residuals (m, 9), rotation, velocity and position, and their Jacobian (m, 9, 27) by the unknowns.

        States are m + 1 attitudes (m + 1, 3, 3), positions and velocities (m + 1, 3) in the axes of the first, with
        gravity (3,). Unknowns are the states at both ends (9 each), gravity and the biases (6,).
        """
        R_a_b = self.R_a_b @ so3_exp(self.d_turn @ bias)
        gained, way = self.faster + self.d_faster @ bias, self.moved + self.d_moved @ bias
        dt_s, one = self.dt_s[:, None], np.eye(3)
        R_first_a, R_first_b = R_first_imu[:-1], R_first_imu[1:]
        R_b_a = R_first_b.swapaxes(1, 2) @ R_first_a
        turn = so3_log(R_a_b.swapaxes(1, 2) @ R_b_a.swapaxes(1, 2))
        faster = velocity[1:] - velocity[:-1] - gravity * dt_s - _applied(R_first_a, gained)
        moved = position[1:] - position[:-1] - _applied(R_first_a, way)
        moved -= self.inertial * (velocity[:-1] * dt_s + 0.5 * gravity * dt_s**2)
        d = np.zeros((len(dt_s), 9, 27))
        d[:, :3, :3], d[:, :3, 9:12], d[:, :3, 21:] = -R_b_a, one, -self.d_turn
        d[:, 3:6, :3], d[:, 3:6, 6:9], d[:, 3:6, 15:18] = R_first_a @ skew(gained), -one, one
        d[:, 3:6, 18:21], d[:, 3:6, 21:] = -dt_s[:, :, None] * one, -R_first_a @ self.d_faster
        d[:, 6:, :3], d[:, 6:, 3:6], d[:, 6:, 12:15] = R_first_a @ skew(way), -one, one
        of_fall = -self.inertial * dt_s[:, :, None] * one
        d[:, 6:, 6:9], d[:, 6:, 18:21] = of_fall, 0.5 * dt_s[:, :, None] * of_fall
        d[:, 6:, 21:] = -R_first_a @ self.d_moved
        return -np.concatenate([turn, faster, moved], axis=1), d


def imu_strides(sequence: Sequence, t_ns: IntArray, w_bias_radps: Array) -> Strides:
    """Preintegrate an IMU's samples about a bias (3,) of the gyro, between stamps (m + 1,) of frames."""
    noise, bias, gyro_first = sequence.noise, np.append(np.zeros(3), w_bias_radps), [3, 4, 5, 0, 1, 2]
    assert isinstance(noise, ImuNoise)
    gyro = float(np.hypot(noise.gyro_noise_density, GYRO_ERROR * usual_step_s(sequence.motion.t_ns)))
    params = preintegration_params(replace(noise, gyro_noise_density=gyro), gravity_world=np.zeros(3))
    motions = [motion for motion in motions_between(sequence.motion, t_ns, None) if isinstance(motion, ImuMotion)]
    ends = [predict(preintegrate(motion, bias, params), np.eye(4), np.zeros(3), bias) for motion in motions]
    T_a_b, faster = np.array([end.T_world_imu for end in ends]), np.array([end.v_world for end in ends])
    # In the tangent of the end: its rotation, then position and velocity in its axes.
    d_end = np.array([end.transition[:9, 9:] for end in ends])[:, :, gyro_first]
    whitener = np.linalg.inv(np.linalg.cholesky(np.array([end.noise[:9, :9] for end in ends])))
    R_a_b = T_a_b[:, :3, :3]
    to_turn, to_moved, to_faster = np.split(whitener, 3, axis=2)
    R_b_a = R_a_b.swapaxes(1, 2)
    whitener = np.concatenate([to_turn, to_faster @ R_b_a, to_moved @ R_b_a], axis=2)
    d_moved, d_faster = R_a_b @ d_end[:, 3:6], R_a_b @ d_end[:, 6:]
    dt_s = np.diff(t_ns) / NS_PER_S
    return Strides(dt_s, R_a_b, faster, T_a_b[:, :3, 3], d_end[:, :3], d_faster, d_moved, whitener, inertial=1.0)


def twist_strides(sequence: Sequence, t_ns: IntArray, w_bias_radps: Array) -> Strides:
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
    T_a_b = np.array([functools.reduce(np.matmul, of_stride, at_rest) for of_stride in of_strides])
    R_a_b, moved, dt_s = T_a_b[:, :, :3, :3], T_a_b[:, :, :3, 3], np.diff(t_ns) / NS_PER_S
    turned = so3_log(R_a_b[:, :1].swapaxes(2, 3) @ R_a_b[:, 1:])
    d_turn, d_moved = (np.moveaxis(x / _DIFFERENCE, 1, -1) for x in (turned, moved[:, 1:] - moved[:, :1]))
    noise = sequence.noise
    assert isinstance(noise, TwistNoise)
    density = np.concatenate([noise.gyro_noise_density, np.full(3, np.inf), noise.velocity_noise_density])
    whitener = np.eye(9) / (np.sqrt(dt_s)[:, None] * density)[:, None]
    none = np.zeros((len(dt_s), 3, 6))
    return Strides(dt_s, R_a_b[:, 0], none[:, :, 0], moved[:, 0], d_turn, none, d_moved, whitener, inertial=0.0)


class Calibration(NamedTuple):
    """The unknowns that all windows share: the rig, the delay of the camera against its stamps (s), the biases (6,).

    ``change_s`` is the delay in the second half of the recording less that in the first; ``right_shift_px`` and
    ``right_roll_rad`` are the errors of the right image against a rectified one.
    """

    rig: StereoRig
    late_s: float
    bias: Array
    change_s: float = 0.0
    right_shift_px: float = 0.0
    right_roll_rad: float = 0.0

    def moved(self, step: Array) -> "Calibration":
        rig, scale = self.rig, np.exp(step[[0, 1, BASELINE]])
        R_imu_cam = rig.T_imu_cam[:3, :3] @ so3_exp(step[TURN])
        after = replace(
            rig,
            fx_px=float(rig.fx_px * scale[0]),
            fy_px=float(rig.fy_px * scale[1]),
            cx_px=float(rig.cx_px + step[2]),
            cy_px=float(rig.cy_px + step[3]),
            baseline_m=float(rig.baseline_m * scale[2]),
            T_imu_cam=se3(R_imu_cam, rig.T_imu_cam[:3, 3] + step[LEVER]),
        )
        late_s, change_s = self.late_s + float(step[LATE]), self.change_s + float(step[CHANGE])
        shift_px, roll_rad = (
            self.right_shift_px + float(step[RIGHT_SHIFT]),
            self.right_roll_rad + float(step[RIGHT_ROLL]),
        )
        return Calibration(after, late_s, self.bias + step[_BIASES], change_s, shift_px, roll_rad)


class KeyFrameWindow(NamedTuple):
    """A window of n key frames and T points, in the axes of the IMU at the first key frame.

    Attitudes (n, 3, 3), positions, velocities and, in the IMU's own axes, rates of rotation (n, 3); gravity (3,), the
    measured motion between key frames, and points (T, 3). N sightings (N, 3) px are sorted by track, with the key frame
    (N,) and the track (N,) of each. ``later`` is the share of the window in the second half of the recording, less 1/2.
    """

    R_first_imu: Array
    position: Array
    velocity: Array
    w_radps: Array
    gravity: Array
    later: float
    strides: Strides
    key: IntArray
    track: IntArray
    uv_px: Array
    points: Array

    @property
    def unknowns(self) -> int:
        return STATE * len(self.position) + GRAVITY

    def moved(self, own: Array, points: Array) -> "KeyFrameWindow":
        state = own[:-GRAVITY].reshape(-1, STATE)
        return self._replace(
            R_first_imu=self.R_first_imu @ so3_exp(state[:, :3]),
            position=self.position + state[:, 3:POSE],
            velocity=self.velocity + state[:, POSE:],
            gravity=self.gravity + own[-GRAVITY:],
            points=self.points + points,
        )


class Reduced(NamedTuple):
    """A window's information (21, 21) on the calibration, and the gradients (B, 21) of parts with independent errors.

    The parts are the tracks, within which errors may be correlated, and the strides of a second each. From a step of
    the calibration follows that of the own unknowns (U,) = own - per_common @ step, and of the points by ``vision``,
    of whose equations the unknowns are ``seen`` (E,).
    """

    information: Array
    gradients: Array
    own: Array
    per_common: Array
    seen: IntArray
    vision: ReducedVision

    def moved(self, window: KeyFrameWindow, step: Array) -> KeyFrameWindow:
        own = self.own - self.per_common @ step
        return window.moved(own, self.vision.point_steps(np.append(own, step)[self.seen]))


def reduce(window: KeyFrameWindow, calibration: Calibration) -> Reduced:
    (vision, of_tracks), (information, of_strides) = _tracks(window, calibration), _strides(window, calibration)
    # Sightings depend on the poses, and on the calibration except for the biases.
    own, of_poses = window.unknowns, STATE * np.arange(len(window.position))[:, None] + np.arange(POSE)
    seen = np.concatenate([of_poses.ravel(), own + _OF_CAMERA])
    information[seen[:, None], seen] += vision.information
    gradients = np.zeros((len(of_tracks) + len(of_strides), own + COMMON))
    gradients[: len(of_tracks), seen], gradients[len(of_tracks) :] = of_tracks, of_strides
    gradient = gradients.sum(axis=0)
    information[np.arange(6), np.arange(6)] += _GAUGE
    information[np.arange(own), np.arange(own)] += _RIDGE
    cross = information[:own, own:]
    solution = np.linalg.solve(information[:own, :own], np.column_stack([cross, gradient[:own]]))
    per_common = solution[:, :-1]
    information, gradients = (
        information[own:, own:] - cross.T @ per_common,
        gradients[:, own:] - gradients[:, :own] @ per_common,
    )
    return Reduced(information, gradients, solution[:, -1], per_common, seen, vision)


class Predicted(NamedTuple):
    """Predicted sightings (N, 3) px and their Jacobians by pose and camera (N, 3, 6 + 15), and by the point."""

    uv_px: Array
    d_seen: Array
    d_point: Array


def predicted(window: KeyFrameWindow, calibration: Calibration) -> Predicted:
    """Predict every sighting: the point in the IMU frame, moved on over the camera's delay, then projected.

    If a pose changes by [phi, rho] on its right, a point q in its axes changes by [q]x phi - rho. The Jacobians neglect
    the dependence of the shift by the delay on pose and velocity, and that on the roll of the right image. For
    milliseconds and hundredths of a radian both are negligible.
    """
    rig, key, track = calibration.rig, window.key, window.track
    R_imu_first, R_cam_imu = window.R_first_imu[key].swapaxes(1, 2), rig.T_imu_cam[:3, :3].T
    q = _applied(R_imu_first, window.points[track] - window.position[key])
    turn_of_q = skew(q)
    later = _applied(turn_of_q, window.w_radps[key] - calibration.bias[:3])
    later -= _applied(R_imu_first, window.velocity[key])
    late_s = calibration.late_s + window.later * calibration.change_s
    q_cam = (q + late_s * later - rig.T_imu_cam[:3, 3]) @ R_cam_imu.T
    q_cam[:, 2] = np.maximum(q_cam[:, 2], LEAST_DEPTH_M)
    uv_px, d_cam = project(q_cam, rig), projection_jacobian(q_cam, rig)
    d_imu = d_cam @ R_cam_imu
    d_point = d_imu @ R_imu_first
    d = np.zeros((len(key), 3, POSE + _CAMERA))
    d_pose, d_camera = d[:, :, :POSE], d[:, :, POSE:]
    np.matmul(d_imu, turn_of_q, out=d_pose[:, :, :3])
    d_pose[:, :, 3:] = -d_point
    d_camera[:, :2, 0], d_camera[:, 2, 1] = uv_px[:, :2] - rig.cx_px, uv_px[:, 2] - rig.cy_px
    d_camera[:, :2, 2] = d_camera[:, 2, 3] = 1.0
    d_camera[:, 1, BASELINE] = -rig.fx_px * rig.baseline_m / q_cam[:, 2]
    np.matmul(d_cam, skew(q_cam), out=d_camera[:, :, TURN])
    d_camera[:, :, LEVER] = -d_imu
    d_camera[:, :, LATE] = _applied(d_imu, later)
    d_camera[:, :, CHANGE] = window.later * d_camera[:, :, LATE]
    # Of the right image; v is the mean of both images' rows, and pixels need not be square.
    d_right, aspect = d_camera[:, :, CHANGE + 1 :], rig.fx_px / rig.fy_px
    d_right[:, 1, 0], d_right[:, 1, 1] = 1.0, aspect * (uv_px[:, 2] - rig.cy_px)
    d_right[:, 2, 1] = -0.5 / aspect * (uv_px[:, 1] - rig.cx_px)
    uv_px = uv_px + d_right @ np.array([calibration.right_shift_px, calibration.right_roll_rad])
    return Predicted(uv_px, d, d_point)


def _weighted(residual_px: Array, rig: StereoRig) -> Array:
    """Return matrices (N, 3, 3) that whiten residuals (N, 3) px and apply the root of Cauchy weights."""
    chi2 = np.sum((residual_px @ rig.whitener.T) ** 2, axis=1)
    scale2 = max(float(np.median(chi2)) / CHI2_3_MEDIAN, LEAST_SCALE2)
    return np.asarray(rig.whitener / np.sqrt(scale2 + chi2 / CAUCHY_SIGMAS**2)[:, None, None])


def _tracks(window: KeyFrameWindow, calibration: Calibration) -> tuple[ReducedVision, Array]:
    """Eliminate the points of all tracks; return what is left on poses and camera, and each track's gradient (T, E)."""
    seen, counts = predicted(window, calibration), (len(window.position), len(window.points))
    off_px = window.uv_px - seen.uv_px
    weight = _weighted(off_px, calibration.rig)
    residual, d_seen = _applied(weight, off_px), weight @ seen.d_seen
    sightings = Sightings(window.key, window.track, window.uv_px)
    vision = eliminated(residual, d_seen[..., :POSE], weight @ seen.d_point, sightings, counts, d_seen[..., POSE:])
    pulled, by_pose = _applied(d_seen.swapaxes(1, 2), residual), np.zeros((counts[1], counts[0], POSE))
    by_pose[window.track, window.key] = pulled[:, :POSE]
    of_camera = np.add.reduceat(pulled[:, POSE:], np.searchsorted(window.track, np.arange(counts[1])))
    of_points = np.einsum("emd,md->me", vision.coupling.reshape(-1, counts[1], 3), vision.point_vector)
    return vision, np.concatenate([by_pose.reshape(counts[1], -1), of_camera], axis=1) - of_points


def _strides(window: KeyFrameWindow, calibration: Calibration) -> tuple[Array, Array]:
    """Return the information of the motion between the key frames, and its gradients by parts of a second or more."""
    residual, jacobian = stride_equations(window, calibration)
    whitener, own = window.strides.whitener, window.unknowns
    residual, jacobian = _applied(whitener, residual), whitener @ jacobian
    to_unknowns, count = jacobian.swapaxes(1, 2), len(residual)
    squared, pulled = to_unknowns @ jacobian, _applied(to_unknowns, residual)
    shared = np.append(np.arange(own - GRAVITY, own), own + np.arange(COMMON)[_BIASES])
    both = np.concatenate([STATE * np.arange(count)[:, None] + np.arange(2 * STATE), np.tile(shared, (count, 1))], 1)
    information, gradients = np.zeros((own + COMMON, own + COMMON)), np.zeros((count, own + COMMON))
    np.add.at(information, (both[:, :, None], both[:, None, :]), squared)
    gradients[np.arange(count)[:, None], both] = pulled
    elapsed_s = np.cumsum(window.strides.dt_s)
    part = np.flatnonzero(np.diff((elapsed_s - elapsed_s[0]) // 1.0, prepend=-1.0))
    return information, np.add.reduceat(gradients, part)


def stride_equations(window: KeyFrameWindow, calibration: Calibration) -> tuple[Array, Array]:
    """Return the residuals (m, k) of the strides and their derivatives (m, k, j) by states, gravity and biases."""
    attitudes, position, velocity = window.R_first_imu, window.position, window.velocity
    return window.strides.equations(attitudes, position, velocity, window.gravity, calibration.bias)


def _applied(matrix: Array, vector: Array) -> Array:
    """Return the products (N, i) of matrices (N, i, j) and vectors (N, j)."""
    return np.asarray((matrix @ vector[:, :, None])[..., 0])


# Time (s) between key frames, approximate length (s) of a window, and least number of key frames of one. There is one
# window or an even number, so that no window contains the middle of the recording, where the clock may change.
STRIDE_S, WINDOW_S, FEWEST_KEYS = 0.2, 4.0, 4
# Least number of key frames in which a track is seen, least disparity (px) of a sighting, least number of tracks of a
# window. The longest tracks are used.
FEWEST_SIGHTINGS, LEAST_DISPARITY_PX, FEWEST_TRACKS = 3, 2.0, 20


class Effort(NamedTuple):
    """The largest numbers of windows, of tracks in a window, and of iterations."""

    windows: int
    tracks: int
    iterations: int


# In long recordings, the windows are spread evenly with an IMU, whose clock may change, and are those with the most
# rotation with odometry, because cars drive straight ahead for long.
MOST: dict[MotionKind, Effort] = {"imu": Effort(6, 200, 10), "twist": Effort(4, 100, 14)}
# Converged where the step is less than this share of the standard errors.
SETTLED = 0.4
# A step of more than this many prior standard deviations diverges.
STRAYED = 10.0
# Least share of the information on the camera's position that is taken to come from the data.
LEAST_BY_DATA = 1e-3
# The errors of the right image, the last unknowns, are estimated only where one step from the converged calibration has
# them beyond this many standard errors: they make focal length and baseline less certain.
_RECTIFIED, RIGHT = RIGHT_SHIFT, slice(RIGHT_SHIFT, COMMON)
RIGHT_SIGMAS: dict[MotionKind, float] = {"imu": 4.0, "twist": 6.0}
# Of the unknowns in the order above, how many they are, and for an IMU and odometry the standard deviation of the
# prior and the largest result that is accepted. The position is accepted far beyond its prior: `lever_arm` reports it.
_UNKNOWNS = (
    (2, 0.2, 0.2, 0.2, 0.2),  # logarithms of the focal lengths
    (2, 70.0, 70.0, 70.0, 70.0),  # principal point, px
    (1, 0.2, 0.2, 0.2, 0.2),  # logarithm of the baseline
    (3, 0.3, 0.3, 0.3, 0.3),  # rotation of the camera, rad
    (3, 0.3, 2.0, 2.0, 10.0),  # its position, with odometry also that of the point whose velocities are given, m
    (1, 0.03, 0.03, 0.06, 0.06),  # its clock, s; a twist may describe the interval before or after its stamp
    (1, 0.1, 0.1, 0.1, 0.1),  # the change of that, s
    (3, 0.1, 0.1, 0.1, 0.1),  # bias of the gyro, rad/s
    (3, 0.3, 0.3, 0.02, 0.1),  # bias of the accelerometer, m/s^2; rotation of velocities by slip and pitch, rad
    (1, 5.0, 5.0, 5.0, 5.0),  # columns of the right image, px
    (1, 0.1, 0.1, 0.1, 0.1),  # roll of the right camera, rad
)
_COUNTS, *_SIZES = zip(*_UNKNOWNS, strict=True)
_OF_IMU, _NEAR_IMU, _OF_TWIST, _NEAR_TWIST = (np.repeat(size, _COUNTS) for size in _SIZES)
PRIOR: dict[MotionKind, Array] = {"imu": _OF_IMU, "twist": _OF_TWIST}
NEAR: dict[MotionKind, Array] = {"imu": _NEAR_IMU, "twist": _NEAR_TWIST}


class SelfCalibration(NamedTuple):
    """Corrections of the calibration, or values of the biases, (21,) in the order above, and their covariance.

    ``windows`` is the number of windows; with one, a change of the clock is not determined. For a pair that looks
    rectified, the corrections of the right image are zero, with the covariance that they have if all are estimated.
    """

    value: Array
    cov: Array
    windows: int

    @property
    def error(self) -> Array:
        return np.sqrt(np.diag(self.cov))

    @property
    def position(self) -> Position:
        """The camera's position without its prior, by the share of the information that comes from the data."""
        by_data = np.maximum(1.0 - (self.error[LEVER] / PRIOR["imu"][LEVER]) ** 2, LEAST_BY_DATA)
        root = np.sqrt(by_data)
        return Position(self.value[LEVER] / by_data, self.cov[LEVER, LEVER] / root / root[:, None])


def self_calibration(
    sequence: Sequence, camera: CameraMotion, intervals: Intervals, fewest_windows: int = 1
) -> SelfCalibration | None:
    """Estimate the calibration from tracks and measured motion.

    None where no window has enough tracks, or the adjustment finds no calibration near the given one.
    """
    w_bias = intervals.bias_radps
    windows = _windows(sequence, camera, w_bias, fewest_windows)
    if not windows:
        return None
    kind = sequence.motion_kind
    try:
        found, cov = _fitted(_Adjustment(windows, Calibration(sequence.rig, 0.0, np.zeros(6)), np.zeros(COMMON)), kind)
    except (np.linalg.LinAlgError, DataError):  # diverging steps: singular, or an impossible rig
        return None
    value = found.moved_by + found.step
    if not found.settled or (np.abs(value) > NEAR[kind]).any():
        return None
    value[GYRO_BIAS] += w_bias
    return SelfCalibration(value, cov, len(windows))


class _Adjustment(NamedTuple):
    """Windows, calibration and its corrections so far (21,), linearised there with the next step, and if converged."""

    windows: list[KeyFrameWindow]
    calibration: Calibration
    moved_by: Array
    all_reduced: list[Reduced] = []  # noqa: RUF012 - never changed
    step: Array = np.zeros(COMMON)
    settled: bool = False


def _fitted(at: _Adjustment, kind: MotionKind) -> tuple[_Adjustment, Array]:
    """Return the adjustment and its covariance (21, 21), of a rectified pair unless one step of all is significant."""
    rectified, prior = _adjusted(at, kind, _RECTIFIED), PRIOR[kind]
    right = _step(rectified.all_reduced, rectified.moved_by, prior)[RIGHT]
    # Windows of a pair that is not rectified fit different calibrations, so their scatter is not included.
    by_parts, _ = _cov_of_parts(rectified.all_reduced, prior, COMMON)
    if rectified.settled and (np.abs(right) > RIGHT_SIGMAS[kind] * np.sqrt(np.diag(by_parts)[RIGHT])).any():
        found = _adjusted(rectified, kind, COMMON)
        return found, _cov(found.all_reduced, prior)
    cov = _cov(rectified.all_reduced, prior)
    cov[:_RECTIFIED], cov[:, :_RECTIFIED] = 0.0, 0.0
    cov[:_RECTIFIED, :_RECTIFIED] = _cov(rectified.all_reduced, prior, _RECTIFIED)
    return rectified, cov


def _adjusted(at: _Adjustment, kind: MotionKind, free: int) -> _Adjustment:
    prior, after = PRIOR[kind], at
    for _ in range(MOST[kind].iterations):
        reduced = [reduce(window, after.calibration) for window in after.windows]
        step = _step(reduced, after.moved_by, prior, free)
        at = _Adjustment(after.windows, after.calibration, after.moved_by, reduced, step)
        if not (np.abs(step) < STRAYED * prior).all():
            return at
        error = np.sqrt(np.diag(np.linalg.inv(_information(reduced, prior)[:free, :free])))
        if (np.abs(step[:free]) < SETTLED * error).all():
            return at._replace(settled=True)
        windows = [one.moved(window, step) for window, one in zip(at.windows, reduced, strict=True)]
        after = _Adjustment(windows, at.calibration.moved(step), at.moved_by + step)
    return at


def _step(all_reduced: list[Reduced], value: Array, prior: Array, free: int = COMMON) -> Array:
    """Return the step (21,) of the first ``free`` unknowns from all windows and the prior about zero."""
    gradient = sum(reduced.gradients.sum(axis=0) for reduced in all_reduced) - value / prior**2
    step = np.zeros(COMMON)
    step[:free] = np.linalg.solve(_information(all_reduced, prior)[:free, :free], gradient[:free])
    return step


def _information(all_reduced: list[Reduced], prior: Array) -> Array:
    return np.asarray(np.diag(prior**-2.0) + sum(reduced.information for reduced in all_reduced))


def _cov(all_reduced: list[Reduced], prior: Array, free: int = COMMON) -> Array:
    """Return the covariance of the first ``free`` unknowns, which also allows errors that are constant in a window.

    The scatter of the windows, of which there are two to six, is used only where it is beyond chance.
    """
    cov, inverse = _cov_of_parts(all_reduced, prior, free)
    by_window = np.array([reduced.gradients[:, :free].sum(axis=0) for reduced in all_reduced]) @ inverse
    dof = len(all_reduced) - 1
    if dof == 0:
        return cov
    scatter = np.sum((by_window - by_window.mean(axis=0)) ** 2, axis=0) * (dof + 1) / dof
    beyond = scatter > np.diag(cov) * chdtri(dof, LEVEL) / dof
    return np.asarray(cov + np.diag(np.where(beyond, np.maximum(scatter - np.diag(cov), 0.0), 0.0)))


def _cov_of_parts(all_reduced: list[Reduced], prior: Array, free: int) -> tuple[Array, Array]:
    """Return the covariance that allows errors constant along a track or for a second, and the usual one.

    It is no less than that of independent errors, because a few parts may scatter too little by chance. Source: Liang &
    Zeger, "Longitudinal data analysis using generalized linear models" (1986), the sandwich.
    """
    inverse = np.linalg.inv(_information(all_reduced, prior)[:free, :free])
    gradients = np.concatenate([reduced.gradients[:, :free] for reduced in all_reduced])
    cov = inverse @ (gradients.T @ gradients + np.diag(prior[:free] ** -2.0)) @ inverse
    return np.asarray(cov + np.diag(np.maximum(np.diag(inverse) - np.diag(cov), 0.0))), np.asarray(inverse)


def _windows(sequence: Sequence, camera: CameraMotion, w_bias: Array, fewest: int = 1) -> list[KeyFrameWindow]:
    stride = max(1, round(STRIDE_S / usual_step_s(sequence.frames_t_ns)))
    keys = np.arange(0, sequence.frame_count, stride)
    whole = round(sequence.duration_s / WINDOW_S)
    count = max(fewest, whole - whole % 2, 1)
    edges = np.linspace(0, keys.size - 1, count + 1).round().astype(int)
    spans = [keys[edges[k] : edges[k + 1] + 1] for k in range(count)]
    spans = [spans[k] for k in _chosen(sequence, spans)]
    T_before_after, known = _roughly_moved(sequence, camera)
    spans = [span for span in spans if span.size >= FEWEST_KEYS and known[span[0] : span[-1]].all()]
    found = [_window(sequence, span, T_before_after[span[0] : span[-1]], w_bias) for span in spans]
    return [window for window in found if window is not None]


def _chosen(sequence: Sequence, spans: list[IntArray]) -> list[int]:
    """Return the indices of the spans of frames that are used, in the order of time."""
    count, most = len(spans), MOST[sequence.motion_kind].windows
    if sequence.motion_kind == "imu" or count <= most:
        return [int(k) for k in np.unique(np.linspace(0, count - 1, min(count, most)).round())]
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values[:, 3:], sequence.frames_t_ns)
    rates = mean - np.median(mean, axis=0)
    turned = [float(np.linalg.norm(rates[span[0] : span[-1]], axis=1).sum()) for span in spans]
    return sorted(int(k) for k in np.argsort(turned)[-most:])


def _roughly_moved(sequence: Sequence, camera: CameraMotion) -> tuple[Array, BoolArray]:
    T_before_after, known = moved_by(camera, sequence), camera.known
    if sequence.motion_kind != "twist":
        return T_before_after, known
    measured = moved_as_measured(sequence, camera, sequence.rig.T_imu_cam)
    return np.where(known[:, None, None], T_before_after, measured), np.ones_like(known)


def _window(sequence: Sequence, keys: IntArray, T_before_after: Array, w_bias: Array) -> KeyFrameWindow | None:
    """Return a window of frames (n,), initialised by the camera's own motion; None with too few tracks."""
    sighting, key, track = _long_tracks(sequence, keys)
    if track.size == 0 or track[-1] + 1 < FEWEST_TRACKS:
        return None
    T_imu_cam, uv_px = sequence.rig.T_imu_cam, sequence.observations.uv_px[sighting]
    T_first_cam = T_imu_cam @ chained(T_before_after)[keys - keys[0]]
    T_first_imu = T_first_cam @ se3_inverse(T_imu_cam)
    strides = (imu_strides if sequence.motion_kind == "imu" else twist_strides)(
        sequence, sequence.frames_t_ns[keys], w_bias
    )
    nearest_first = np.lexsort((-disparity_px(uv_px), track))
    nearest = nearest_first[np.searchsorted(track, np.arange(track[-1] + 1))]
    points = transform(T_first_cam[key[nearest]], triangulate(uv_px[nearest], sequence.rig))
    velocity, gravity = _velocities(T_first_imu, strides)
    w_radps = _rates(sequence, keys) - w_bias
    position, later = T_first_imu[:, :3, 3], float(np.mean(keys[1:] > sequence.frame_count // 2)) - 0.5
    return KeyFrameWindow(
        T_first_imu[:, :3, :3], position, velocity, w_radps, gravity, later, strides, key, track, uv_px, points
    )


def _long_tracks(sequence: Sequence, keys: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return rows (N,) of the longest tracks' sightings in key frames, sorted by track, and key and track (N,)."""
    seen = sequence.observations
    begin, end = np.searchsorted(seen.frame, [keys[0], keys[-1] + 1])
    key_of = np.full(keys[-1] - keys[0] + 1, -1)
    key_of[keys - keys[0]] = np.arange(keys.size)
    usable = (disparity_px(seen.uv_px) > LEAST_DISPARITY_PX) & np.isfinite(seen.uv_px).all(axis=1)
    row = begin + np.flatnonzero((key_of[seen.frame[begin:end] - keys[0]] >= 0) & usable[begin:end])
    _, track, sightings = np.unique(seen.track_id[row], return_inverse=True, return_counts=True)
    longest = np.argsort(-sightings, kind="stable")[: MOST[sequence.motion_kind].tracks]
    chosen = longest[sightings[longest] >= FEWEST_SIGHTINGS]
    row = row[np.isin(track, chosen)]
    row = row[np.argsort(seen.track_id[row], kind="stable")]
    _, track = np.unique(seen.track_id[row], return_inverse=True)
    return row, key_of[seen.frame[row] - keys[0]], track


def _velocities(T_first_imu: Array, strides: Strides) -> tuple[Array, Array]:
    """Return velocities (n, 3) and gravity (3,) at poses (n, 4, 4): least squares, or means of odometry's strides."""
    n, dt_s = len(T_first_imu), strides.dt_s
    R_first_a, position = T_first_imu[:-1, :3, :3], T_first_imu[:, :3, 3]
    if not strides.inertial:
        v_mps = (R_first_a @ strides.moved[:, :, None])[..., 0] / dt_s[:, None]
        ends = np.concatenate([v_mps[:1], v_mps, v_mps[-1:]])
        return 0.5 * (ends[1:] + ends[:-1]), np.zeros(3)
    rows, jacobian = np.arange(n - 1), np.zeros((2, n - 1, n + 1))
    jacobian[0, rows, rows], jacobian[0, :, n] = dt_s, 0.5 * dt_s**2
    jacobian[1, rows, rows], jacobian[1, rows, rows + 1], jacobian[1, :, n] = -1.0, 1.0, -dt_s
    by_force = (R_first_a @ np.stack([strides.moved, strides.faster])[..., None])[..., 0]
    response = np.stack([np.diff(position, axis=0) - by_force[0], by_force[1]])
    found = np.linalg.lstsq(jacobian.reshape(-1, n + 1), response.reshape(-1, 3))[0]
    return found[:n], found[n]


def _rates(sequence: Sequence, keys: IntArray) -> Array:
    """Return the gyro's means (n, 3) rad/s over the two intervals around each of the frames (n,)."""
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values[:, 3:], sequence.frames_t_ns)
    return np.asarray(0.5 * (mean[np.maximum(keys - 1, 0)] + mean[np.minimum(keys, len(mean) - 1)]))
