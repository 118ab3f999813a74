"""The camera's motion from each frame to the next, from its own stereo tracks and nothing else.

Points triangulated in the earlier frame are projected into the later one; Gauss-Newton on that residual with
Cauchy weights, from "no motion", all intervals of a recording at once. A residual is weighted by the noise of
both its measurements, J_after R J_after^T + R: far points determine the rotation, near ones the translation.
Source: Geiger, Ziegler & Stiller, "StereoScan" (2011), section III-A, with the two-view covariance added.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.tracks import Neighbours, neighbours
from toolkit.geometry import Array, BoolArray, IntArray, se3_exp, se3_inverse, se3_log, skew
from toolkit.models.gating import LEAST_DEPTH_M, LEAST_DISPARITY_PX
from toolkit.models.stereo import disparity_px, project, projection_jacobian, triangulate
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence, StereoRig

# After so many the median interval of a real drive is within 2e-4 rad/s and 0.02 m/s of where it would end.
ITERATIONS = 6
# Sum of the weights below which an interval's motion is not used: six unknowns, three equations a track.
LEAST_SUPPORT = 8.0
# A residual that is this many times the scatter of its interval has half the weight.
CAUCHY_SIGMAS = 2.0
# Floor of an interval's squared scatter, for recordings without noise.
LEAST_SCALE2 = 1e-6
# Median of a chi-square variable with three degrees of freedom.
CHI2_3_MEDIAN = 2.366


class CameraMotion(NamedTuple):
    """Twist of the camera over each of the K - 1 intervals, in its own axes: (K - 1, 3) rad/s, (K - 1, 3) m/s.

    ``known`` (K - 1,) is True where enough tracks agreed; elsewhere the rows are zero.
    """

    w_radps: Array
    v_mps: Array
    known: BoolArray


class _TwoViews(NamedTuple):
    """Points (P, 3) of frame k in its camera, a root of their covariance (P, 3, 3), and their pixels in k + 1.

    ``interval`` (P,) is k, increasing; the rows of interval k are first[k] to first[k + 1].
    """

    points: Array
    root_cov: Array
    uv_after_px: Array
    interval: IntArray
    first: IntArray


def usable_pairs(sequence: Sequence) -> Neighbours:
    """Return the neighbouring sightings that are finite and near enough to be triangulated."""
    pairs, uv_px = neighbours(sequence.observations), sequence.observations.uv_px
    usable = (disparity_px(uv_px) > LEAST_DISPARITY_PX) & np.isfinite(uv_px).all(axis=1)
    return pairs.select(usable[pairs.before] & usable[pairs.after])


def camera_motion(sequence: Sequence) -> CameraMotion:
    """Estimate the camera's twist over every interval between frames."""
    intervals = max(sequence.frame_count - 1, 0)
    views = _two_views(sequence, intervals)
    if views.interval.size == 0:
        return CameraMotion(np.zeros((intervals, 3)), np.zeros((intervals, 3)), np.zeros(intervals, dtype=bool))
    T_before_after, support = np.tile(np.eye(4), (intervals, 1, 1)), np.zeros(intervals)
    for _ in range(ITERATIONS):
        step, support = _gauss_newton(views, T_before_after, sequence.rig)
        T_before_after = T_before_after @ se3_exp(step)
    known = support > LEAST_SUPPORT
    dt_s = np.diff(sequence.frames_t_ns)[known] / NS_PER_S
    twist = np.zeros((intervals, 6))
    twist[known] = se3_log(T_before_after[known]) / dt_s[:, None]
    return CameraMotion(twist[:, :3], twist[:, 3:], known)


def _two_views(sequence: Sequence, intervals: int) -> _TwoViews:
    pairs, uv_px, rig = usable_pairs(sequence), sequence.observations.uv_px, sequence.rig
    points = triangulate(uv_px[pairs.before], rig)
    d_point_d_uv = np.linalg.inv(projection_jacobian(points, rig))
    first = np.searchsorted(pairs.interval, np.arange(intervals + 1))
    root_cov = d_point_d_uv @ np.linalg.cholesky(rig.cov_uv_px2)
    return _TwoViews(points, root_cov, uv_px[pairs.after], pairs.interval, first)


def _gauss_newton(views: _TwoViews, T_before_after: Array, rig: StereoRig) -> tuple[Array, Array]:
    """Return one step (K - 1, 6) for every interval, on the right of its motion, and the sum of its weights."""
    T_after_before = se3_inverse(T_before_after)[views.interval]
    rotation = T_after_before[:, :3, :3]
    points = (rotation @ views.points[:, :, None])[..., 0] + T_after_before[:, :3, 3]
    points[:, 2] = np.maximum(points[:, 2], LEAST_DEPTH_M)  # a point behind is a gross outlier, not a division by zero
    d_uv_d_point = projection_jacobian(points, rig)
    spread = d_uv_d_point @ rotation @ views.root_cov
    information = np.linalg.inv(rig.cov_uv_px2 + spread @ np.swapaxes(spread, 1, 2))
    residual_px = (views.uv_after_px - project(points, rig))[:, :, None]
    weighted_px = information @ residual_px
    weight = _cauchy_weights((residual_px * weighted_px).sum(axis=(1, 2)), views)
    d_uv_d_step = np.concatenate([d_uv_d_point @ skew(points), -d_uv_d_point], axis=-1)
    transposed = np.swapaxes(d_uv_d_step, 1, 2) * weight[:, None, None]
    hessian = _sum_by_interval(transposed @ information @ d_uv_d_step, views.first)
    gradient = _sum_by_interval(transposed @ weighted_px, views.first)
    # The ridge keeps an interval without tracks where it is; it is far below one sighting's information.
    step = np.asarray(np.linalg.solve(hessian + 1e-6 * np.eye(6), gradient)[..., 0], dtype=np.float64)
    return step, _sum_by_interval(weight, views.first)


def _cauchy_weights(chi2: Array, views: _TwoViews) -> Array:
    """Return the weights (P,) of squared residuals (P,), scaled by the median of their own interval."""
    order = np.lexsort((chi2, views.interval))
    middle = np.minimum((views.first[:-1] + views.first[1:]) // 2, chi2.size - 1)
    scale2 = np.maximum(chi2[order][middle] / CHI2_3_MEDIAN, LEAST_SCALE2)
    weights: Array = 1.0 / (1.0 + chi2 / (CAUCHY_SIGMAS**2 * scale2[views.interval]))
    return weights


def _sum_by_interval(values: Array, first: IntArray) -> Array:
    """Sum the rows (P, ...) of each interval, which are consecutive, to (K - 1, ...)."""
    filled = np.flatnonzero(np.diff(first))
    sums = np.zeros((first.size - 1, *values.shape[1:]))
    sums[filled] = np.add.reduceat(values, first[filled], axis=0)
    return sums
