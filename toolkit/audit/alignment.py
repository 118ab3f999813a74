"""The camera's scale, position and small rotation against odometry, and how significant they are.

One robust regression of the camera's velocities on the measured ones (``velocity_fit``) estimates all three. Slip lasts
for seconds, so its standard errors are those of a jackknife over stretches that are no shorter. ``way_gone`` says which
of two positions the camera has, with the systematic error of sound recordings added to the covariance.
``force_beside_camera`` integrates an accelerometer beside the camera's velocity.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.intervals import Intervals, chained, interval_means, subdivided
from toolkit.audit.robust import Scalar, chance_bound, in_motion, regression, slip_stretches
from toolkit.geometry import Array, IntArray, skew, so3_exp
from toolkit.jackknife import STRETCHES, jackknife_cov
from toolkit.measurements import NS_PER_S
from toolkit.models.camera_motion import CameraMotion
from toolkit.sequence import Sequence

# Unknowns of the regression: the scale, the camera's position (3) and its rotation (3).
_LEVER, _TURN = slice(1, 4), slice(4, 7)
# Logarithms of the odds at which the other position is accepted and excluded: a position is right more often than not.
LOG_ODDS, LOG_ODDS_AGAINST = float(np.log(1000.0)), float(np.log(20.0))
# The other position is excluded where the measured one is this many standard deviations away.
MOST_SIGMAS = 4.0
# Standard deviations of the systematic error of sound odometry: the distance (m) along the direction of travel to the
# point whose velocities are given (0.4 to 0.9 in ten cars), and a share of a turn's radius, by errors that last.
ALONG_TRAVEL_M, SHARE_IN_TURNS = 0.65, 0.02
# The same of sound recordings with an IMU (m), which have 0.06 at most.
BESIDE_IMU_M = 0.05
# Limit of a rotation (rad) by velocities beyond chance: slip and pitch of cars bias it.
SYSTEMATIC_RAD = 0.018
# Axes known worse than the best one by this factor are not judged, as that of the direction of travel by velocities.
MOST_ERROR_RATIO = 4.0
# Least bound (rad); without noise it would be zero.
LEAST_BOUND_RAD = 5e-6


class Turn(NamedTuple):
    """Small rotations (m,) rad about m axes that can be judged, their standard errors (m,) rad, and bounds (m,) rad.

    By chance a rotation exceeds ``by_chance_rad`` less often than ``robust.LEVEL``.
    """

    rad: Array
    error_rad: Array
    by_chance_rad: Array

    @property
    def angle(self) -> Scalar:
        angle = float(np.linalg.norm(self.rad))
        return Scalar(angle, float(np.linalg.norm(self.rad * self.error_rad)) / max(angle, 1e-12))


class Position(NamedTuple):
    """A correction (3,) m of the camera's position in the IMU frame, and its covariance (3, 3)."""

    lacking_m: Array
    cov_m2: Array

    @property
    def error_m(self) -> Array:
        return np.sqrt(np.diag(self.cov_m2))


class VelocityFit(NamedTuple):
    """Relative excess of the camera's translation over odometry's, and corrections of the camera's pose in the IMU.

    By chance the scale exceeds ``scale_by_chance`` less often than ``robust.LEVEL``.
    """

    scale: Scalar
    scale_by_chance: float
    position: Position
    turn: Turn


def velocity_fit(intervals: Intervals, step_s: float) -> VelocityFit:
    """Solve v_imu = (1 - scale) v - turn x v - w x (p + lever), with the camera's v and w in the axes of the IMU.

    The intervals, ``step_s`` long, have measured velocities. Noise of the regressor biases the scale. Of the regression
    of one velocity on the other and the inverse regression, the result nearer to zero is taken, or zero where their
    signs differ (Frisch, "Statistical confluence analysis", 1934).
    """
    measured, seen = intervals.v_measured_mps, intervals.v_seen_mps
    pose = np.concatenate([-skew(intervals.w_seen_radps), skew(seen)], axis=2)
    response, jacobian = measured - seen, np.concatenate([-seen[:, :, None], pose], axis=2)
    found, formal = regression(response, jacobian)
    stretches = slip_stretches(len(seen) * step_s)
    lasting = jackknife_cov(_robust_solution, response, jacobian, stretches=stretches)
    cov = lasting if stretches == STRETCHES else jackknife_cov(_robust_solution, response, jacobian)
    moving = in_motion(seen, stretches)
    other = float(_robust_solution(-response, np.concatenate([measured[:, :, None], -pose], axis=2))[0])
    one = 1.0 / (1.0 - float(found[0])) - 1.0
    scale = 0.0 if one * other < 0.0 else min(one, other, key=abs)
    error = float(np.sqrt(cov[0, 0])) * (1.0 + scale) ** 2
    bound = chance_bound(np.sqrt(lasting[:1, 0]), np.sqrt(formal[:1, 0]), moving)
    by_chance = (1.0 + scale) ** 2 * float(bound[0])
    turn = _tested(found[_TURN], formal[_TURN, _TURN], lasting[_TURN, _TURN], moving)
    return VelocityFit(Scalar(scale, error), by_chance, Position(found[_LEVER], cov[_LEVER, _LEVER]), turn)


def turn_by_rotations(intervals: Intervals) -> Turn:
    """Return the rotation that aligns the camera's rates of rotation with the gyro's, less its bias."""
    seen = intervals.w_seen_radps
    bias = np.tile(np.eye(3), (len(seen), 1, 1))
    response, jacobian = intervals.w_radps - seen, np.concatenate([skew(seen), bias], axis=2)
    found, formal = regression(response, jacobian)
    cov = jackknife_cov(_robust_solution, response, jacobian)
    return _tested(found[:3], formal[:3, :3], cov[:3, :3], in_motion(seen, STRETCHES))


def _tested(rad: Array, formal: Array, cov: Array, stretches: float) -> Turn:
    """Return the rotation (3,) about those principal axes of its formal covariance (3, 3) that can be judged.

    The jackknife covariance ``cov`` (3, 3) of a few stretches is too uncertain to choose the axes.
    """
    variance, axes = np.linalg.eigh(formal)
    error_rad = np.sqrt(np.maximum(np.diag(axes.T @ cov @ axes), variance))
    decidable = variance <= MOST_ERROR_RATIO**2 * variance.min()
    by_chance_rad = chance_bound(error_rad[decidable], np.sqrt(variance[decidable]), stretches)
    return Turn((axes.T @ rad)[decidable], error_rad[decidable], np.maximum(by_chance_rad, LEAST_BOUND_RAD))


def _robust_solution(response: Array, jacobian: Array) -> Array:
    return regression(response, jacobian)[0]


def way_gone(intervals: Intervals, position: Position, way_m: Array) -> Scalar:
    """Return where the camera is along a vector (3,) m from the given position: 0 is its start, 1 its end."""
    weighted = np.linalg.solve(position.cov_m2 + _systematic_cov_m2(intervals), way_m)
    information = float(weighted @ way_m)
    return Scalar(float(weighted @ position.lacking_m) / information, float(1.0 / np.sqrt(information)))


def is_there(share: Scalar) -> bool:
    """Say whether the camera is at the end of the vector, and not elsewhere."""
    return not is_excluded(share) and _log_odds(share) > LOG_ODDS


def is_excluded(share: Scalar) -> bool:
    """Say whether the camera is not at the end of the vector."""
    return abs(share.value - 1.0) > MOST_SIGMAS * share.error or _log_odds(share) < -LOG_ODDS_AGAINST


def _log_odds(share: Scalar) -> float:
    return (share.value - 0.5) / share.error**2


def metres(position: Array) -> str:
    return "(" + ", ".join(f"{x:z.2f}" for x in position) + ")"


def _systematic_cov_m2(intervals: Intervals) -> Array:
    if intervals.v_mps is None:
        return BESIDE_IMU_M**2 * np.eye(3)
    w_radps, v_mps = intervals.w_seen_radps, intervals.v_seen_mps
    speed_mps, travel = np.linalg.norm(v_mps, axis=1), np.median(v_mps, axis=0)
    travel /= max(float(np.linalg.norm(travel)), 1e-9)
    lever = skew(w_radps)
    axes = np.linalg.eigh(np.einsum("nij,nik->jk", lever, lever)).eigenvectors
    turned = np.linalg.norm(lever @ axes, axis=1)  # (M, 3) rates that move a camera which is off along each axis
    radius_m = speed_mps @ turned**2 / np.maximum(np.sum(turned**3, axis=0), 1e-12)
    in_turns = axes @ np.diag((SHARE_IN_TURNS * radius_m) ** 2) @ axes.T
    return np.asarray(in_turns + ALONG_TRAVEL_M**2 * np.outer(travel, travel))


class ForceBesideCamera(NamedTuple):
    """At the middle (n,) of each interval, the camera's velocity (n, 3) and the integral (n, 3, 3, 3) of the force.

    Velocities are in the axes of the first frame, by the rates of the gyro less its bias. The integral is that of each
    of the accelerometer's channels if it measured along each axis: [interval, axis of the IMU, channel, axis of the
    first frame].
    """

    middle_ns: IntArray
    v_mps: Array
    along_mps: Array

    @property
    def gravity_mps(self) -> Array:
        """The velocity less the integrated specific force (n, 3): without errors, a line whose slope is gravity."""
        return np.asarray(self.v_mps - np.einsum("kaai->ki", self.along_mps))


def force_beside_camera(sequence: Sequence, camera: CameraMotion, intervals: Intervals) -> ForceBesideCamera:
    """Integrate the specific force beside the camera's velocity, from the first interval on."""
    R_imu_cam, p_imu_cam = sequence.rig.T_imu_cam[:3, :3], sequence.rig.T_imu_cam[:3, 3]
    frames_t_ns, motion = sequence.frames_t_ns, sequence.motion
    middle_ns = frames_t_ns[:-1] + np.diff(frames_t_ns) // 2
    w_radps = interval_means(motion.t_ns, motion.values, frames_t_ns)[:, 3:] - intervals.bias_radps
    v_mps = camera.v_mps @ R_imu_cam.T - np.cross(w_radps, p_imu_cam)
    t_ns, middle_at = subdivided(middle_ns)
    step_s = np.diff(t_ns)[:, None] / NS_PER_S
    mean = interval_means(motion.t_ns, motion.values, t_ns)
    half = so3_exp(0.5 * step_s * (mean[:, 3:] - intervals.bias_radps))
    R_first_imu = chained(half @ half)
    gained = np.einsum("kia,kc->kaci", R_first_imu[:-1] @ half, mean[:, :3] * step_s)
    along_mps = np.concatenate([np.zeros((1, 3, 3, 3)), np.cumsum(gained, axis=0)])[middle_at]
    return ForceBesideCamera(middle_ns, (R_first_imu[middle_at] @ v_mps[:, :, None])[..., 0], along_mps)
