"""Residuals of a point that is triangulated from one sighting of a track and projected into the next frame.

The point is moved by the camera's own motion (``one_step``, ``own_one_step_px``) or by the measured motion
(``median_one_step_px``). ``agreement`` compares the medians of both; it is the test of a repaired calibration.
``step_correlation`` is the correlation of neighbouring residuals of a track under the camera's own motion.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.intervals import Intervals, moved_as_measured, moved_by, usual_step_s
from toolkit.audit.robust import Scalar
from toolkit.geometry import Array, IntArray, se3_inverse, transform
from toolkit.jackknife import jackknife_error
from toolkit.measurements import ImuNoise, TwistChangeNoise, TwistNoise
from toolkit.models.camera_motion import CameraMotion, Neighbours, triangulation_jacobian, usable_pairs
from toolkit.models.gating import LEAST_DEPTH_M, MAD_TO_SIGMA
from toolkit.models.noise import white_sigma
from toolkit.models.stereo import project, projection_jacobian, triangulate
from toolkit.sequence import Sequence

# Median one-step residual (px) beyond which samples and tracks disagree; sound recordings have 0.3 to 3.1 px.
MOST_PX = 3.0
# The limit is no less than this many times what the tracks' own scatter and the stated noise of the samples explain.
TIMES_EXPLAINED = 2.0
# Residuals beyond this many robust standard deviations are left out of the correlation, which needs so many pairs.
USUAL = 3.0
LEAST_TRIPLES = 300
# Limit of the correlation of neighbouring residuals, to be passed by so many standard errors. A random walk along the
# track, of w times the white variance per frame, gives -1 / (2 + w); real tracks have 0.1 to 0.9.
MOST_CORRELATION, CORRELATION_SIGMAS = -0.25, 5.0
# Least standard deviation of whitened residuals; below it, tracks are exact.
_NO_ERROR = 1e-6


class OneStep(NamedTuple):
    """P pairs of successive sightings of a track: their rows (P,), the second's residual (P, 3) px, and its covariance.

    The point is triangulated from the first sighting, of covariance R, and projected into the second's frame. If the
    errors of both are independent, the residual has the covariance ``cov_px2`` (P, 3, 3) = J R J^T + R, where J is the
    derivative of the second's prediction by the first sighting.
    """

    before: IntArray
    after: IntArray
    residual_px: Array
    cov_px2: Array


def one_step(sequence: Sequence, camera: CameraMotion) -> OneStep:
    """Return the residuals over the intervals in which the camera's own motion is known."""
    moved, rig = _moved(sequence, camera, moved_by(camera, sequence)), sequence.rig
    d_point_d_uv = np.moveaxis(triangulation_jacobian(moved.before.T, rig), -1, 0)
    d_after_d_before = moved.T_after_before[:, :3, :3] @ np.ascontiguousarray(d_point_d_uv)
    jacobian = projection_jacobian(moved.after, rig) @ d_after_d_before
    cov_px2 = jacobian @ rig.cov_uv_px2 @ jacobian.swapaxes(1, 2) + rig.cov_uv_px2
    return OneStep(moved.pairs.before, moved.pairs.after, moved.residual_px, cov_px2)


class _Moved(NamedTuple):
    """Pairs (P,) of sightings, their points (P, 3) m in both frames, motion (P, 4, 4) and residual (P, 3) px."""

    pairs: Neighbours
    before: Array
    after: Array
    T_after_before: Array
    residual_px: Array


def _moved(sequence: Sequence, camera: CameraMotion, T_before_after: Array) -> _Moved:
    pairs, uv_px, rig = usable_pairs(sequence), sequence.observations.uv_px, sequence.rig
    pairs = pairs.select(camera.known[pairs.interval])
    T_after_before = se3_inverse(T_before_after)[pairs.interval]
    before = triangulate(uv_px[pairs.before], rig)
    after = transform(T_after_before, before)
    after[:, 2] = np.maximum(after[:, 2], LEAST_DEPTH_M)
    return _Moved(pairs, before, after, T_after_before, uv_px[pairs.after] - project(after, rig))


def median_one_step_px(sequence: Sequence, camera: CameraMotion, T_imu_cam: Array) -> float:
    """Return the median over the sightings of the root mean square of (uL, uR, v) residuals, in pixels.

    Points are moved by the motion samples through the extrinsic ``T_imu_cam``, over intervals whose camera motion is
    known. The gyro's bias is subtracted, with odometry up to ``MOST_BIAS_RADPS``; an IMU has the camera's velocity.
    """
    return _median(_one_step_px(sequence, camera, moved_as_measured(sequence, camera, T_imu_cam))[1])


def one_step_px_by_interval(sequence: Sequence, camera: CameraMotion, T_imu_cam: Array) -> Array:
    """Return the median of the same residuals (M,) px in each known interval that has any."""
    interval, each_px = _one_step_px(sequence, camera, moved_as_measured(sequence, camera, T_imu_cam))
    first = np.flatnonzero(np.diff(interval, prepend=-1))
    return np.array([_median(part) for part in np.split(each_px, first[1:])]) if interval.size else np.empty(0)


def own_one_step_px(sequence: Sequence, camera: CameraMotion) -> float:
    """Return the same median (px) where the points are moved by a motion of the camera, for example its own."""
    return _median(_one_step_px(sequence, camera, moved_by(camera, sequence))[1])


def _one_step_px(sequence: Sequence, camera: CameraMotion, T_before_after: Array) -> tuple[IntArray, Array]:
    """Return interval (P,) and residual (P,) px under the camera's motion (K - 1, 4, 4) in the known intervals."""
    moved = _moved(sequence, camera, T_before_after)
    return moved.pairs.interval, np.sqrt(np.mean(moved.residual_px**2, axis=1))


def _median(values: Array) -> float:
    return float(np.median(values)) if values.size else float("nan")


class Agreement(NamedTuple):
    """Median one-step residuals (px): under the measured motion, under the camera's own, and the limit of both."""

    residual_px: float
    own_px: float
    limit_px: float


def agreement(sequence: Sequence, camera: CameraMotion, intervals: Intervals) -> Agreement:
    own_px = own_one_step_px(sequence, camera)
    limit_px = max(MOST_PX, TIMES_EXPLAINED * _explained_px(sequence, intervals, own_px))
    return Agreement(median_one_step_px(sequence, camera, sequence.rig.T_imu_cam), own_px, limit_px)


def _explained_px(sequence: Sequence, intervals: Intervals, own_px: float) -> float:
    """Return the residual (px) that the tracks' scatter and the samples' noise over a usual interval explain.

    With an IMU also the scatter of the camera's rotation about the gyro's, which takes that one's place: in a narrow
    view its errors are large, and compensate those of the camera's velocity.
    """
    noise, focal_px = sequence.noise, sequence.rig.fx_px
    step_s = usual_step_s(sequence.frames_t_ns)
    turned_px = moved_px = mixed_px = 0.0
    if not isinstance(noise, TwistChangeNoise):
        turned_px = focal_px * np.sqrt(step_s) * float(np.max(noise.gyro_noise_density))
    if isinstance(noise, TwistNoise):
        uv_px = sequence.observations.uv_px[usable_pairs(sequence).before]
        depth_m = float(np.median(triangulate(uv_px, sequence.rig)[:, 2])) if len(uv_px) else np.inf
        moved_px = focal_px / depth_m * np.sqrt(step_s) * float(np.max(noise.velocity_noise_density))
    if isinstance(noise, ImuNoise):
        seen = intervals.w_seen_radps
        scatter_radps = np.minimum(white_sigma(intervals.w_radps - seen), white_sigma(seen))  # clocks may differ
        mixed_px = focal_px * step_s * float(np.sqrt(np.mean(scatter_radps**2)))
    return float(np.sqrt(own_px**2 + turned_px**2 + moved_px**2 + mixed_px**2))


def step_correlation(sequence: Sequence, steps: OneStep) -> Scalar | None:
    """Return the correlation of neighbouring one-step residuals; None with too few of them, or if all are zero."""
    first, second = _neighbouring_residuals(sequence, steps)
    if len(first) < LEAST_TRIPLES or not (first.any() and second.any()):
        return None
    return Scalar(_correlation(first, second), jackknife_error(_correlation, first, second))


def errors_are_independent(correlation: Scalar | None) -> bool:
    """Say whether the correlation of `step_correlation` shows that the sightings of a track err independently."""
    return correlation is not None and correlation.value + CORRELATION_SIGMAS * correlation.error < MOST_CORRELATION


def _neighbouring_residuals(sequence: Sequence, steps: OneStep) -> tuple[Array, Array]:
    """Return whitened residuals (T, 3), without outliers, of the two steps between three sightings of a track."""
    whitened = np.linalg.solve(np.linalg.cholesky(steps.cov_px2), steps.residual_px[:, :, None])[..., 0]
    sigma = MAD_TO_SIGMA * np.median(np.abs(whitened), axis=0)
    scaled = whitened / np.maximum(sigma, _NO_ERROR)
    step_from = np.full(len(sequence.observations), -1)
    step_from[steps.before] = np.arange(len(steps.before))
    following = step_from[steps.after]
    first = np.flatnonzero(following >= 0)
    pair = np.stack([scaled[first], scaled[following[first]]])
    return tuple(pair[:, (np.abs(pair) < USUAL).all(axis=(0, 2))])


def _correlation(first: Array, second: Array) -> float:
    return float((first * second).sum() / (0.5 * (first**2 + second**2).sum()))
