"""The scale of vision and the position of the camera, by one linear regression on the measured motion.

The scale is the ratio of the camera's translation to the measured one. Twists measure the velocity directly. An IMU
measures its change: in the axes of a window's first frame (rotations by the gyro), the displacement of the IMU is the
twice integrated specific force plus the contributions of an unknown velocity and an unknown gravity of each window.
Accelerations then determine the scale, rotations the lever arm. Source: Martinelli, "Closed-form solution of
visual-inertial structure from motion" (2014); Qin, Li & Shen, "VINS-Mono" (2018), section V-B, with the position of the
camera as a further unknown.

Position and small rotation of the camera against the given extrinsic, and how significant they are.

Position: which of two positions the camera has, by the turns of the vehicle. The regression of `alignment` estimates
it, with the scale and the rotation of the camera as further unknowns. The systematic error of sound recordings is added
to the covariance.

Rotation: by velocities with odometry, by rates of rotation with an IMU. The regression by velocities has the scale and
the position of the camera as further unknowns (`alignment`), that by rates the gyro's bias. Slip lasts for seconds, so
the standard error is that of a jackknife over stretches that are no shorter.

The camera's velocity less the integrated specific force of an IMU, which changes by gravity alone.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from toolkit.audit.edits import keep_frames
from toolkit.audit.intervals import Intervals, interval_means, moved_by, subdivided
from toolkit.audit.robust import (
    CAUCHY_SIGMAS,
    INFLATION,
    ITERATIONS,
    Scalar,
    chance_bound,
    chance_sigmas,
    in_motion,
    slip_stretches,
    spread,
)
from toolkit.geometry import Array, IntArray, se3_inverse, skew, so3_exp
from toolkit.jackknife import STRETCHES, jackknife_cov
from toolkit.measurements import NS_PER_S, MotionKind
from toolkit.models.camera_motion import CameraMotion, camera_motion
from toolkit.sequence import Sequence

# With an IMU: duration (s) of a displacement of the camera, whose noise hardly grows with the duration, and length (s)
# of a window.
STRIDE_S, WINDOW_S = 0.25, 6.0
# Least number of equations for each unknown; with fewer a regression fits the noise.
LEAST_EQUATIONS = 3.0
# Standard deviations of the biases of an accelerometer (m/s^2), and of a gyro about its median (rad/s).
ACCEL_BIAS, GYRO_BIAS = 0.2, 0.01
# Limit of the scale beyond chance, and the largest standard error with which it is judged. Sound recordings at hand
# have up to 0.044 +- 0.007 with the odometry of cars and 0.028 +- 0.006 with an IMU. Chosen with them in view.
SYSTEMATIC_SCALE, LARGEST_SCALE_ERROR = {"twist": 0.03, "imu": 0.025}, 0.02
# Unknowns: the scale, the camera's position (3), its rotation (3), with an IMU both biases (6).
_LEVER, TURN, _COMMON = slice(1, 4), slice(4, 7), 13


class Regression(NamedTuple):
    """The unknowns (7,) that explain the difference of the velocities, in the order of ``velocity_equations``.

    ``formal`` (7, 7) is the covariance if errors of intervals were independent, ``cov`` (7, 7) that of a jackknife over
    ``stretches``, each at least as long as slip lasts. ``in_motion`` is the effective number of stretches in which the
    vehicle moved.
    """

    found: Array
    formal: Array
    cov: Array
    stretches: int
    in_motion: float


class TranslationFit(NamedTuple):
    """Relative excess of the camera's translation, and the correction (3,) m of its position in the IMU frame.

    ``lever_cov_m2`` (3, 3) is the covariance of the correction. By chance the scale exceeds ``scale_by_chance`` less
    often than ``robust.LEVEL``. ``by_velocities`` is the whole regression, with odometry.
    """

    scale: Scalar
    lever_m: Array
    lever_cov_m2: Array
    scale_by_chance: float = np.inf
    by_velocities: Regression | None = None

    @property
    def lever_error_m(self) -> Array:
        """The standard errors (3,) of the camera's position along the axes of the IMU."""
        return np.sqrt(np.diag(self.lever_cov_m2))


def alignment(sequence: Sequence, camera: CameraMotion, intervals: Intervals) -> TranslationFit | None:
    """Regress the camera's translation on the measured motion; None where there is too little to solve for it."""
    if intervals.v_mps is not None:
        step_s = float(np.median(np.diff(sequence.frames_t_ns))) / NS_PER_S
        return _with_velocities(intervals, intervals.v_mps, sequence.rig.T_imu_cam, step_s)
    return _with_accelerations(sequence, camera, intervals)


def _with_velocities(intervals: Intervals, v_mps: Array, T_imu_cam: Array, step_s: float) -> TranslationFit:
    """Solve v_imu = (1 - scale) v - turn x v - w x (p + lever), with the camera's v and w in the axes of the IMU.

    Noise of the regressor biases the scale. Of the regression of one velocity on the other and the inverse regression,
    the result nearer to zero is taken, or zero where their signs differ (Frisch, "Statistical confluence analysis",
    1934).
    """
    whole = velocity_regression(intervals, v_mps, T_imu_cam, len(v_mps) * step_s)
    measured, seen, jacobian = velocity_equations(intervals, v_mps, T_imu_cam)
    cov = whole.cov
    if whole.stretches != STRETCHES:
        cov = jackknife_cov(_robust_solution, measured - seen, jacobian)
    other = float(_robust_solution(seen - measured, measured[:, :, None])[0])
    one = 1.0 / (1.0 - float(whole.found[0])) - 1.0
    scale = 0.0 if one * other < 0.0 else min(one, other, key=abs)
    error = float(np.sqrt(cov[0, 0])) * (1.0 + scale) ** 2
    by_chance = (1.0 + scale) ** 2 * _by_chance(whole)
    return TranslationFit(Scalar(scale, error), whole.found[_LEVER], cov[_LEVER, _LEVER], by_chance, whole)


def _by_chance(whole: Regression) -> float:
    """Return the bound that the scale exceeds only by chance, with errors that last as long as slip."""
    slipping, formal = np.sqrt(whole.cov[:1, 0]), np.sqrt(whole.formal[:1, 0])
    return float(chance_bound(slipping, formal, whole.in_motion, INFLATION["twist"])[0])


def velocity_regression(intervals: Intervals, v_mps: Array, T_imu_cam: Array, duration_s: float = np.inf) -> Regression:
    """Regress the difference of the camera's velocity and the measured one on the unknowns, with Cauchy weights."""
    stretches = slip_stretches(duration_s)
    measured, seen, jacobian = velocity_equations(intervals, v_mps, T_imu_cam)
    found, formal = robust_with_formal_cov(measured - seen, jacobian)
    cov = jackknife_cov(_robust_solution, measured - seen, jacobian, stretches=stretches)
    return Regression(found, formal, cov, stretches, in_motion(seen, stretches))


def velocity_equations(intervals: Intervals, v_mps: Array, T_imu_cam: Array) -> tuple[Array, Array, Array]:
    """Return the camera's velocity (M, 3) by the twists and by the tracks, and d(difference)/d(unknowns) (M, 3, 7).

    Unknowns are the scale, the camera's position and its rotation (``TURN``).
    """
    R_imu_cam, p_imu_cam = T_imu_cam[:3, :3], T_imu_cam[:3, 3]
    w_radps, seen = intervals.w_cam_radps @ R_imu_cam.T, intervals.v_cam_mps @ R_imu_cam.T
    measured = v_mps + np.cross(w_radps, p_imu_cam)
    return measured, seen, np.concatenate([-seen[:, :, None], -skew(w_radps), skew(seen)], axis=2)


def _with_accelerations(sequence: Sequence, camera: CameraMotion, intervals: Intervals) -> TranslationFit | None:
    """Solve for the scale and the lever arm from displacements of the camera over strides within windows."""
    frame_s = (sequence.frames_t_ns - sequence.frames_t_ns[0]) / NS_PER_S
    stride = max(1, round(STRIDE_S / float(np.median(np.diff(frame_s)))))
    kept = np.arange(0, sequence.frame_count, stride)
    strides = _strides(sequence, camera, kept)
    if kept.size < 3:
        return None
    w_bias = np.median(intervals.w_radps - intervals.w_cam_radps @ sequence.rig.T_imu_cam[:3, :3].T, axis=0)
    windows = min(max(1, round(frame_s[kept[-1]] / WINDOW_S)), kept.size // 2)  # frames may be seconds apart
    edges = np.linspace(0, kept.size - 1, windows + 1).round().astype(int)
    equations = [_window(sequence, strides, kept, w_bias, range(*edge)) for edge in pairwise(edges.tolist())]
    response = np.concatenate([response for response, _, _ in equations])
    unknowns = _COMMON + 6 * windows
    if 3 * len(response) < LEAST_EQUATIONS * unknowns:
        return None
    jacobian = np.zeros((len(response), 3, unknowns))
    row = 0
    for k, (_, common, own) in enumerate(equations):
        here = slice(row, row + len(common))
        jacobian[here, :, :_COMMON], jacobian[here, :, _COMMON + 6 * k : _COMMON + 6 * (k + 1)] = common, own
        row = here.stop
    prior = np.repeat([0.0, 1.0 / ACCEL_BIAS**2, 1.0 / GYRO_BIAS**2, 0.0], [7, 3, 3, 6 * windows])
    block = np.arange(len(response)) * STRIDE_S // 1.0
    found, cov = _robust_with_cov(response, jacobian, prior, block.astype(int))
    scale = Scalar(float(found[0]), float(np.sqrt(cov[0, 0])))
    by_chance = chance_sigmas(np.unique(block).size) * scale.error
    return TranslationFit(scale, found[_LEVER], cov[_LEVER, _LEVER], by_chance)


def _strides(sequence: Sequence, camera: CameraMotion, kept: IntArray) -> CameraMotion:
    """Return the camera's motion between the frames ``kept`` (n,), from tracks that are seen in both."""
    path = chained(moved_by(camera, sequence))
    start = se3_inverse(path[kept[:-1]]) @ path[kept[1:]]
    found = camera_motion(keep_frames(sequence, kept), start)
    unknown = np.concatenate([[0], np.cumsum(~camera.known)])
    return found._replace(known=found.known & (unknown[kept[1:]] == unknown[kept[:-1]]))


def _window(
    sequence: Sequence, strides: CameraMotion, kept: IntArray, w_bias: Array, window: range
) -> tuple[Array, Array, Array]:
    """Return response (M, 3), jacobian of the common unknowns (M, 3, 13) and of the window's own (M, 3, 6), in m/s.

    The window's strides are those from ``kept[k]`` to ``kept[k + 1]``, k in ``window``, whose motion is known.
    """
    first, frames_t_ns = kept[window.start], sequence.frames_t_ns[kept[window.start] : kept[window.stop] + 1]
    path = _integrated(sequence, frames_t_ns, w_bias)
    rows = np.array([k for k in window if strides.known[k]], dtype=int)
    a, b = kept[rows] - first, kept[rows + 1] - first
    t_s = (frames_t_ns - frames_t_ns[0]) / NS_PER_S
    dt_s = (t_s[b] - t_s[a])[:, None]
    R_imu_cam, p_imu_cam = sequence.rig.T_imu_cam[:3, :3], sequence.rig.T_imu_cam[:3, 3]
    T_before_after = moved_by(strides, keep_frames(sequence, kept))[rows]
    seen = T_before_after[:, :3, 3] @ R_imu_cam.T
    R_first_a, R_a_b = path.R_first_imu[a], path.R_first_imu[a].swapaxes(1, 2) @ path.R_first_imu[b]
    displaced = (R_first_a @ (seen + p_imu_cam - R_a_b @ p_imu_cam)[:, :, None]).squeeze(-1)
    force = path.moved[b] - path.moved[a]
    lever, turn = R_first_a @ (R_a_b - np.eye(3)), R_first_a @ skew(seen)
    biases = [path.d_moved_d_accel[b] - path.d_moved_d_accel[a], path.d_moved_d_gyro[b] - path.d_moved_d_gyro[a]]
    common = np.concatenate([force[:, :, None], lever, turn, *biases], axis=2) / dt_s[:, :, None]
    later_s = 0.5 * (t_s[b] + t_s[a])[:, None, None]
    own = np.concatenate([np.tile(np.eye(3), (len(rows), 1, 1)), later_s * np.eye(3)], axis=2)
    return (displaced - force) / dt_s, common, own


class _Path(NamedTuple):
    """Orientation (n, 3, 3) and displacement (n, 3) m of an IMU in its first axes, from rest and without gravity.

    Also the derivatives (n, 3, 3) of the displacement by the biases of the accelerometer and the gyro.
    """

    R_first_imu: Array
    moved: Array
    d_moved_d_accel: Array
    d_moved_d_gyro: Array


def _integrated(sequence: Sequence, frames_t_ns: IntArray, w_bias: Array) -> _Path:
    """Integrate the samples up to every frame, by the means over short parts of each interval."""
    t_ns, frame_at = subdivided(frames_t_ns)
    h_s = np.diff(t_ns)[:, None] / NS_PER_S
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values, t_ns)
    half = so3_exp(0.5 * h_s * (mean[:, 3:] - w_bias))
    R_first_imu = chained(half @ half)
    middle = R_first_imu[:-1] @ half
    force = (middle @ mean[:, :3, None]).squeeze(-1)
    turned = _from_zero(-middle * h_s[:, :, None])
    per_gyro = -skew(force) @ (0.5 * (turned[:-1] + turned[1:]))
    twice = (_twice(force, h_s), _twice(-middle, h_s[:, :, None]), _twice(per_gyro, h_s[:, :, None]))
    return _Path(R_first_imu[frame_at], *(one[frame_at] for one in twice))


def _twice(rate: Array, h_s: Array) -> Array:
    """Integrate constant rates (n, ...) twice over durations, from zero: (n + 1, ...)."""
    once = _from_zero(rate * h_s)
    return _from_zero(once[:-1] * h_s + 0.5 * rate * h_s**2)


def _from_zero(steps: Array) -> Array:
    """Return the sums (n + 1, ...) of the first 0, 1, ... n steps (n, ...)."""
    return np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])


def chained(step: Array) -> Array:
    """Return the products (n + 1, d, d) of the first 0, 1, ... n matrices (n, d, d)."""
    products = np.tile(np.eye(step.shape[1]), (len(step) + 1, 1, 1))
    for k in range(len(step)):
        products[k + 1] = products[k] @ step[k]
    return products


def robust_with_formal_cov(response: Array, jacobian: Array) -> tuple[Array, Array]:
    """Solve response (M, 3) = jacobian (M, 3, m) x by least squares with Cauchy weights.

    The covariance (m, m) assumes that errors of rows are independent.
    """
    found, information, _ = _weighted(response, jacobian, np.zeros(jacobian.shape[2]))
    return found, np.asarray(np.linalg.inv(information))


def _robust_solution(response: Array, jacobian: Array) -> Array:
    return _weighted(response, jacobian, np.zeros(jacobian.shape[2]))[0]


def _robust_with_cov(response: Array, jacobian: Array, prior: Array, block: IntArray) -> tuple[Array, Array]:
    """Solve the same with the information (m,) of a prior about zero; the covariance allows errors that last a block.

    Source: Liang & Zeger, "Longitudinal data analysis using generalized linear models" (1986), the sandwich.
    """
    found, information, score = _weighted(response, jacobian, prior)
    of_block = np.zeros((block[-1] + 1, found.size))
    np.add.at(of_block, block, score)
    inverse = np.asarray(np.linalg.inv(information))
    cov = inverse @ (of_block.T @ of_block + np.diag(prior)) @ inverse
    lacking = np.maximum(np.diag(inverse) - np.diag(cov), 0.0)  # few blocks may scatter too little by chance
    return found, np.asarray(cov + np.diag(lacking))


def _weighted(response: Array, jacobian: Array, prior: Array) -> tuple[Array, Array, Array]:
    """Return the solution (m,), its information (m, m) and the weighted gradient (M, m) of every row at it."""
    unknowns = jacobian.shape[2]
    rows, flat = jacobian.reshape(-1, unknowns), response.ravel()
    found = np.linalg.lstsq(rows, flat)[0]
    for _ in range(ITERATIONS):
        residual = (flat - rows @ found).reshape(response.shape)
        scale = np.maximum(spread(residual), 1e-9)
        weight = 1.0 / (1.0 + (residual / scale) ** 2 / CAUCHY_SIGMAS**2) / scale**2
        weighted = rows * weight.reshape(-1, 1)
        information: Array = weighted.T @ rows + np.diag(prior)
        information += 1e-12 * np.trace(information) * np.eye(unknowns)
        found = np.linalg.solve(information, weighted.T @ flat)
    score = np.einsum("nij,ni->nj", weighted.reshape(jacobian.shape), (flat - rows @ found).reshape(response.shape))
    return np.asarray(found), information, score


# Logarithms of the odds at which the other position is accepted (1000 to 1) and excluded (20 to 1 against it). They
# differ because the position in a file is right more often than not.
LOG_ODDS, LOG_ODDS_AGAINST = float(np.log(1000.0)), float(np.log(20.0))
# The other position is excluded where the measured one is this many standard deviations away.
MOST_SIGMAS = 4.0
# Standard deviations of the systematic error of sound odometry, chosen with the recordings at hand in view: the
# distance along the direction of travel to the point whose velocities are given (m; 0.4 to 0.9 in ten cars), and a
# relative error of the velocity that lasts as long as a turn, which looks like this share of the turn's radius. The
# share agrees with SYSTEMATIC_RAD and SYSTEMATIC_SCALE.
ALONG_TRAVEL_M, SHARE_IN_TURNS = 0.65, 0.02
# The same of sound recordings with an IMU (m), which have 0.06 at most.
BESIDE_IMU_M = 0.05
# Limits beyond the standard errors for a rotation (rad) estimated by velocities, which slip and pitch of cars bias, and
# by rates of rotation. Chosen with the sound recordings at hand in view.
SYSTEMATIC_RAD = {"twist": 0.018, "imu": 0.01}
# Axes whose standard error is more than this many times that of the best axis are not judged: velocities do not
# determine the rotation about their own direction, and slip would bias it.
MOST_ERROR_RATIO = 4.0
# Least bound (rad); without noise it would be zero.
LEAST_BOUND_RAD = 5e-6


def way_gone(sequence: Sequence, intervals: Intervals, found: TranslationFit, way_m: Array) -> Scalar:
    """Return where the camera is along a vector (3,) m from the given position: 0 is its start, 1 its end."""
    return share_of_way(found.lever_m, found.lever_cov_m2 + _systematic_cov_m2(sequence, intervals), way_m)


def share_of_way(lacking_m: Array, cov_m2: Array, way_m: Array) -> Scalar:
    """Return the same for a measured correction (3,) m with its covariance (3, 3), by weighted least squares."""
    weighted = np.linalg.solve(cov_m2, way_m)
    information = float(weighted @ way_m)
    return Scalar(float(weighted @ lacking_m) / information, float(1.0 / np.sqrt(information)))


def is_there(share: Scalar) -> bool:
    """Say whether the camera is at the end of the vector, and not elsewhere."""
    return not is_excluded(share) and _log_odds(share) > LOG_ODDS


def is_excluded(share: Scalar) -> bool:
    """Say whether the camera is not at the end of the vector."""
    return abs(share.value - 1.0) > MOST_SIGMAS * share.error or _log_odds(share) < -LOG_ODDS_AGAINST


def _log_odds(share: Scalar) -> float:
    """Return the logarithm of the odds of the vector's end against its start, for normal errors."""
    return (share.value - 0.5) / share.error**2


def metres(position: Array) -> str:
    """Return a position (3,) m as text."""
    return "(" + ", ".join(f"{x:z.2f}" for x in position) + ")"


def _systematic_cov_m2(sequence: Sequence, intervals: Intervals) -> Array:
    """Return the covariance (3, 3) of the systematic error of the position in sound recordings."""
    if intervals.v_mps is None:
        return BESIDE_IMU_M**2 * np.eye(3)
    R_imu_cam = sequence.rig.T_imu_cam[:3, :3]
    w_radps, v_mps = intervals.w_cam_radps @ R_imu_cam.T, intervals.v_cam_mps @ R_imu_cam.T
    speed_mps, travel = np.linalg.norm(v_mps, axis=1), np.median(v_mps, axis=0)
    travel /= max(float(np.linalg.norm(travel)), 1e-9)
    lever = skew(w_radps)
    axes = np.linalg.eigh(np.einsum("nij,nik->jk", lever, lever)).eigenvectors
    turned = np.linalg.norm(lever @ axes, axis=1)  # (M, 3) rates that move a camera which is off along each axis
    radius_m = speed_mps @ turned**2 / np.maximum(np.sum(turned**3, axis=0), 1e-12)
    in_turns = axes @ np.diag((SHARE_IN_TURNS * radius_m) ** 2) @ axes.T
    return np.asarray(in_turns + ALONG_TRAVEL_M**2 * np.outer(travel, travel))


class Turn(NamedTuple):
    """Small rotations (m,) rad about m axes that can be judged, their standard errors (m,) rad, and bounds (m,) rad.

    By chance a rotation exceeds ``by_chance_rad`` less often than ``robust.LEVEL``.
    """

    rad: Array
    error_rad: Array
    by_chance_rad: Array


def angle_of(turn: Turn) -> Scalar:
    """Return the angle of a rotation about the axes that can be judged."""
    angle = float(np.linalg.norm(turn.rad))
    return Scalar(angle, float(np.linalg.norm(turn.rad * turn.error_rad)) / max(angle, 1e-12))


def turn_by_velocities(whole: Regression) -> Turn:
    """Return the rotation that aligns the camera's velocities with those of odometry."""
    return _tested(whole.found[TURN], whole.formal[TURN, TURN], whole.cov[TURN, TURN], whole.in_motion, "twist")


def turn_by_rotations(intervals: Intervals, T_imu_cam: Array) -> Turn:
    """Return the rotation that aligns the camera's rates of rotation with those of the gyro."""
    seen = intervals.w_cam_radps @ T_imu_cam[:3, :3].T
    bias = np.tile(np.eye(3), (len(seen), 1, 1))
    response, jacobian = intervals.w_radps - seen, np.concatenate([skew(seen), bias], axis=2)
    found, formal = robust_with_formal_cov(response, jacobian)
    cov = jackknife_cov(lambda *rows: robust_with_formal_cov(*rows)[0], response, jacobian)
    return _tested(found[:3], formal[:3, :3], cov[:3, :3], in_motion(seen, STRETCHES), "imu")


def _tested(rad: Array, formal: Array, cov: Array, stretches: float, kind: MotionKind) -> Turn:
    """Return the rotation (3,) about those principal axes of its formal covariance (3, 3) that can be judged.

    The jackknife covariance ``cov`` (3, 3) of a few stretches is too uncertain to choose the axes.
    """
    variance, axes = np.linalg.eigh(formal)
    error_rad = np.sqrt(np.maximum(np.diag(axes.T @ cov @ axes), variance))
    decidable = variance <= MOST_ERROR_RATIO**2 * variance.min()
    by_chance_rad = chance_bound(error_rad[decidable], np.sqrt(variance[decidable]), stretches, INFLATION[kind])
    return Turn((axes.T @ rad)[decidable], error_rad[decidable], np.maximum(by_chance_rad, LEAST_BOUND_RAD))


class IntegratedGravity(NamedTuple):
    """The middle (K - 1,) of each interval, and the camera's velocity less the integrated specific force (K - 1, 3).

    Velocities are in the axes of the first frame, by the rates of the gyro less its bias. Without errors the difference
    is a straight line in time, whose slope is gravity.
    """

    middle_ns: IntArray
    velocity_mps: Array


def integrated_gravity(sequence: Sequence, camera: CameraMotion, intervals: Intervals) -> IntegratedGravity:
    """Subtract the specific force, integrated from the first interval on, from the camera's velocity."""
    bias_radps = np.median(intervals.w_radps - intervals.w_cam_radps @ sequence.rig.T_imu_cam[:3, :3].T, axis=0)
    R_imu_cam, p_imu_cam = sequence.rig.T_imu_cam[:3, :3], sequence.rig.T_imu_cam[:3, 3]
    frames_t_ns, motion = sequence.frames_t_ns, sequence.motion
    middle_ns = frames_t_ns[:-1] + np.diff(frames_t_ns) // 2
    w_radps = interval_means(motion.t_ns, motion.values, frames_t_ns)[:, 3:] - bias_radps
    v_mps = camera.v_mps @ R_imu_cam.T - np.cross(w_radps, p_imu_cam)
    t_ns, middle_at = subdivided(middle_ns)
    step_s = np.diff(t_ns)[:, None] / NS_PER_S
    mean = interval_means(motion.t_ns, motion.values, t_ns)
    half = so3_exp(0.5 * step_s * (mean[:, 3:] - bias_radps))
    R_first_imu = chained(half @ half)
    v_first = (R_first_imu[middle_at] @ v_mps[:, :, None]).squeeze(-1)
    gained = (R_first_imu[:-1] @ half @ mean[:, :3, None]).squeeze(-1) * step_s
    return IntegratedGravity(
        middle_ns, v_first - np.concatenate([np.zeros((1, 3)), np.cumsum(gained, axis=0)])[middle_at]
    )
