"""One window of a bundle adjustment of key frames and measured motion with unknown calibration, linearised.

Unknowns are the poses of the key frames (6 each: rotation on the right, position in the axes of the first), with an IMU
their velocities (3) and the gravity of the window (3), and the calibration that all windows share (21). Points are
eliminated track by track, then the window's own unknowns; what remains is the window's information on the calibration.
Source: Triggs, McLauchlan, Hartley & Fitzgibbon, "Bundle adjustment - a modern synthesis" (2000), section 6; Forster et
al. (2017), as in `strides`.

The measured motion integrated over strides of several frames, its residuals at states at their ends, and its noise.

The samples of an IMU are preintegrated as for the estimators (`models.imu`). Twists are chained, with an unknown
rotation of their velocities, and their derivatives by it and by the gyro's bias are difference quotients. For biases of
usual size the integrals are linear in them. Source: Forster, Carlone, Dellaert & Scaramuzza, "On-manifold
preintegration for real-time visual-inertial odometry" (2017), section VI.
"""

import functools
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from toolkit.audit.intervals import usual_step_s
from toolkit.geometry import Array, IntArray, se3, se3_exp, skew, so3_exp, so3_log
from toolkit.measurements import NS_PER_S, ImuMotion, ImuNoise, StereoRig, TwistMotion, TwistNoise
from toolkit.models.gating import CHI2_3_MEDIAN
from toolkit.models.imu import predict, preintegrate, preintegration_params
from toolkit.models.stereo import project, projection_jacobian
from toolkit.models.stereo_adjustment import ReducedVision, Sightings, eliminated
from toolkit.motion_samples import motions_between
from toolkit.sequence import Sequence

# Difference of a bias (rad/s) and of a rotation (rad) for the difference quotients.
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
    return ImuStrides(dt_s, R_a_b, faster, T_a_b[:, :3, 3], d_end[:, :3], d_faster, d_moved, whitener)


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
    T_a_b = np.array([functools.reduce(np.matmul, of_stride, at_rest) for of_stride in of_strides])
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


POSE, COMMON = 6, 21
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
        """Return the calibration after a step (21,) of the unknowns."""
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
    strides: ImuStrides | TwistStrides
    key: IntArray
    track: IntArray
    uv_px: Array
    points: Array

    @property
    def unknowns(self) -> int:
        """Number of the window's own unknowns, without its points."""
        return self.strides.state_size * len(self.position) + self.strides.gravity_size

    def moved(self, own: Array, points: Array) -> "KeyFrameWindow":
        """Return the window after steps of its own unknowns and of its points (T, 3)."""
        count = len(self.position)
        state, gravity = np.split(own, [self.strides.state_size * count])
        state = state.reshape(count, -1)
        after = self._replace(
            R_first_imu=self.R_first_imu @ so3_exp(state[:, :3]),
            position=self.position + state[:, 3:POSE],
            points=self.points + points,
        )
        if not gravity.size:
            return after
        return after._replace(velocity=self.velocity + state[:, POSE:], gravity=self.gravity + gravity)


class Reduced(NamedTuple):
    """A window's information (21, 21) on the calibration, and the gradients (B, 21) of parts with independent errors.

    The parts are the tracks, within which errors may be correlated, and the strides of a second each. ``back`` computes
    the step of the window's own unknowns from a step of the calibration.
    """

    information: Array
    gradients: Array
    back: "_Back"


class _Back(NamedTuple):
    """Own unknowns (U,) = own - per_common @ step; the points (T, 3) follow from what was eliminated with them.

    ``seen`` (E,) are the unknowns in the equations of the tracks.
    """

    own: Array
    per_common: Array
    seen: IntArray
    vision: ReducedVision

    def steps(self, common: Array) -> tuple[Array, Array]:
        own = self.own - self.per_common @ common
        return own, self.vision.point_steps(np.append(own, common)[self.seen])


def moved(window: KeyFrameWindow, reduced: Reduced, step: Array) -> KeyFrameWindow:
    """Return the window after a step (21,) of the calibration and the step of its own unknowns that follows from it."""
    return window.moved(*reduced.back.steps(step))


def reduce(window: KeyFrameWindow, calibration: Calibration) -> Reduced:
    """Linearise the window and eliminate its own unknowns and its points."""
    (vision, of_tracks), by_stride = _tracks(window, calibration), _strides(window, calibration)
    own, seen, information = window.unknowns, _seen(window), by_stride.information
    information[seen[:, None], seen] += vision.information
    gradients = np.zeros((len(of_tracks) + len(by_stride.gradients), own + COMMON))
    gradients[: len(of_tracks), seen], gradients[len(of_tracks) :] = of_tracks, by_stride.gradients
    gradient = gradients.sum(axis=0)
    information[np.arange(6), np.arange(6)] += _GAUGE
    information[np.arange(own), np.arange(own)] += _RIDGE
    cross = information[:own, own:]
    solution = np.linalg.solve(information[:own, :own], np.column_stack([cross, gradient[:own]]))
    per_common = solution[:, :-1]
    return Reduced(
        information[own:, own:] - cross.T @ per_common,
        gradients[:, own:] - gradients[:, :own] @ per_common,
        _Back(solution[:, -1], per_common, seen, vision),
    )


def _seen(window: KeyFrameWindow) -> IntArray:
    """Return the unknowns (E,) that sightings depend on: the poses and the calibration except for the biases."""
    of_poses = window.strides.state_size * np.arange(len(window.position))[:, None] + np.arange(POSE)
    return np.concatenate([of_poses.ravel(), window.unknowns + _OF_CAMERA])


class _Normal(NamedTuple):
    information: Array
    gradients: Array


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


def _strides(window: KeyFrameWindow, calibration: Calibration) -> _Normal:
    """Return the normal equations of the motion between the key frames, with gradients by parts of a second or more."""
    residual, jacobian = stride_equations(window, calibration)
    whitener, state = window.strides.whitener, window.strides.state_size
    residual, jacobian = _applied(whitener, residual), whitener @ jacobian
    to_unknowns, count, own = jacobian.swapaxes(1, 2), len(residual), window.unknowns
    squared, pulled = to_unknowns @ jacobian, _applied(to_unknowns, residual)
    shared = np.append(np.arange(own - window.strides.gravity_size, own), own + np.arange(COMMON)[_BIASES])
    both = np.concatenate([state * np.arange(count)[:, None] + np.arange(2 * state), np.tile(shared, (count, 1))], 1)
    information, gradients = np.zeros((own + COMMON, own + COMMON)), np.zeros((count, own + COMMON))
    np.add.at(information, (both[:, :, None], both[:, None, :]), squared)
    gradients[np.arange(count)[:, None], both] = pulled
    elapsed_s = np.cumsum(window.strides.dt_s)
    part = np.flatnonzero(np.diff((elapsed_s - elapsed_s[0]) // 1.0, prepend=-1.0))
    return _Normal(information, np.add.reduceat(gradients, part))


def stride_equations(window: KeyFrameWindow, calibration: Calibration) -> tuple[Array, Array]:
    """Return the residuals (m, k) of the strides and their derivatives (m, k, j) by states, gravity and biases."""
    attitudes, position, velocity = window.R_first_imu, window.position, window.velocity
    return window.strides.equations(attitudes, position, velocity, window.gravity, calibration.bias)


def _applied(matrix: Array, vector: Array) -> Array:
    """Return the products (N, i) of matrices (N, i, j) and vectors (N, j)."""
    return np.asarray((matrix @ vector[:, :, None])[..., 0])
