"""The camera's motion from each frame to the next, from its stereo tracks alone.

Points triangulated in the earlier frame are projected into the later one; Gauss-Newton on that residual with
Cauchy weights, from "no motion", many intervals of a recording at once. The points are corrected with the motion, and
every residual and Jacobian is taken at the best point for both views: with the first view's alone the noise of near
and far points biases the motion, by 0.01 rad/s where disparities are a few pixels. A residual is weighted by the noise
of both its measurements, J R J^T + R: far points determine the rotation, near ones the translation.
Source: Geiger, Ziegler & Stiller, "StereoScan" (2011), section III-A, with the points eliminated as in
Triggs, McLauchlan, Hartley & Fitzgibbon, "Bundle adjustment" (2000), section 6.1.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray, se3_exp, se3_inverse, se3_log
from toolkit.measurements import NS_PER_S, StereoRig
from toolkit.models.gating import CHI2_3_MEDIAN, LEAST_DEPTH_M, LEAST_DISPARITY_PX
from toolkit.models.stereo import disparity_px, project, projection_jacobian, triangulate
from toolkit.sequence import Observations, Sequence

# After this many iterations the median interval of a real drive is within 2e-4 rad/s and 0.02 m/s of convergence.
ITERATIONS = 6
# Sum of the weights below which an interval's motion is not used: six unknowns, three equations a track.
LEAST_SUPPORT = 8.0
# A residual of this many times the scatter of its interval has half the weight.
CAUCHY_SIGMAS = 2.0
# Floor of an interval's squared scatter, for recordings without noise.
LEAST_SCALE2 = 1e-6
# Relative ridge of matrices that one track, or a calibration far off, leaves singular: far below any noise.
RIDGE = 1e-12
# Depth given to a point that the motion puts behind the camera or at infinity.
MOST_DEPTH_M = 1e5
# Pairs of sightings that are computed at a time: they take about 10 MB, however long the recording.
PAIRS_AT_A_TIME = 10_000


class CameraMotion(NamedTuple):
    """Twist of the camera over each of the K - 1 intervals, in its own axes: (K - 1, 3) rad/s, (K - 1, 3) m/s.

    ``known`` (K - 1,) is True where enough tracks agreed; elsewhere the rows are zero.
    """

    w_radps: Array
    v_mps: Array
    known: BoolArray

    def of_imu(self, T_imu_cam: Array) -> Array:
        """Return the twists (K - 1, 6) [rad/s, m/s] of an IMU that the camera is fixed to, in its own axes."""
        w_radps = self.w_radps @ T_imu_cam[:3, :3].T
        return np.hstack([w_radps, self.v_mps @ T_imu_cam[:3, :3].T - np.cross(w_radps, T_imu_cam[:3, 3])])

    def steps_of_imu(self, dt_s: Array, T_imu_cam: Array) -> Array:
        """Return the IMU's motions T_before_after (K - 1, 4, 4) over the intervals, which last dt_s (K - 1,)."""
        steps = se3_exp(np.hstack([self.w_radps, self.v_mps]) * dt_s[:, None])
        return np.asarray(T_imu_cam @ steps @ se3_inverse(T_imu_cam))

    def first(self, intervals: int) -> "CameraMotion":
        return CameraMotion(self.w_radps[:intervals], self.v_mps[:intervals], self.known[:intervals])


class Neighbours(NamedTuple):
    """Rows of observations: ``before`` (P,) in frame ``interval`` (P,), ascending, ``after`` (P,) in the next one."""

    before: IntArray
    after: IntArray
    interval: IntArray

    def select(self, rows: BoolArray) -> "Neighbours":
        return Neighbours(self.before[rows], self.after[rows], self.interval[rows])


def neighbours(observations: Observations) -> Neighbours:
    """Pair each sighting with the same track's sighting in the next frame, where there is one."""
    frame, track_id = observations.frame, observations.track_id
    by_track = observations.by_track
    follows = (np.diff(track_id[by_track]) == 0) & (np.diff(frame[by_track]) == 1)
    before, after = by_track[:-1][follows], by_track[1:][follows]
    in_time = np.argsort(frame[before], kind="stable")
    before, after = before[in_time], after[in_time]
    return Neighbours(before, after, frame[before])


class _TwoViews(NamedTuple):
    """Points (3, P) of frame k in its camera, and their pixels (3, P) there and in k + 1.

    ``interval`` (P,) is k, increasing; the columns of interval k are first[k] to first[k + 1]. The pairs come last in
    all arrays of this file, matrices (3, 3, P) included: sums of products then run through neighbours in memory.
    """

    points: Array
    uv_before_px: Array
    uv_after_px: Array
    interval: IntArray
    first: IntArray

    def over(self, intervals: slice) -> "_TwoViews":
        """Return the views of some intervals, counted from the first of them."""
        first = self.first[intervals.start : intervals.stop + 1]
        pairs = slice(first[0], first[-1])
        pixels = (self.uv_before_px[:, pairs], self.uv_after_px[:, pairs])
        return _TwoViews(self.points[:, pairs], *pixels, self.interval[pairs] - intervals.start, first - first[0])


def usable_pairs(sequence: Sequence) -> Neighbours:
    """Return the neighbouring sightings that are finite and near enough to be triangulated."""
    pairs, uv_px = neighbours(sequence.observations), sequence.observations.uv_px
    usable = (disparity_px(uv_px) > LEAST_DISPARITY_PX) & np.isfinite(uv_px).all(axis=1)
    return pairs.select(usable[pairs.before] & usable[pairs.after])


def camera_motion(sequence: Sequence, start: Array | None = None) -> CameraMotion:
    """Estimate the camera's twist over every interval between frames.

    ``start`` (K - 1, 4, 4) is the initial value, "at rest" by default; large motions need a better one.
    """
    intervals = max(sequence.frame_count - 1, 0)
    views = _two_views(sequence, intervals)
    if views.interval.size == 0:
        return CameraMotion(np.zeros((intervals, 3)), np.zeros((intervals, 3)), np.zeros(intervals, dtype=bool))
    T_before_after = np.tile(np.eye(4), (intervals, 1, 1)) if start is None else start.copy()
    support = np.zeros(intervals)
    for stretch in _stretches(views.first):
        there = views.over(stretch)
        T_before_after[stretch], support[stretch] = _motion_over(there, T_before_after[stretch], sequence.rig)
    steps_s = np.diff(sequence.frames_t_ns) / NS_PER_S
    known = (support > LEAST_SUPPORT) & np.isfinite(T_before_after).all(axis=(1, 2)) & (steps_s > 0.0)
    twist = np.zeros((intervals, 6))
    twist[known] = se3_log(T_before_after[known]) / steps_s[known, None]
    return CameraMotion(twist[:, :3], twist[:, 3:], known)


def _stretches(first: IntArray) -> Iterator[slice]:
    """Yield slices of the intervals that have pairs; ``first`` (K,) is the row of each interval's first pair."""
    begin, last = 0, first.size - 1
    while begin < last and first[begin] < first[-1]:
        full = int(np.searchsorted(first, first[begin] + PAIRS_AT_A_TIME, side="right")) - 1
        end = max(full, begin + 1)
        yield slice(begin, end)
        begin = end


def _motion_over(views: _TwoViews, T_before_after: Array, rig: StereoRig) -> tuple[Array, Array]:
    """Return the motion (K, 4, 4) over every interval, from an initial value, and the sum of its weights (K,)."""
    support = np.zeros(views.first.size - 1)
    for _ in range(ITERATIONS):
        step, support, points = _gauss_newton(views, T_before_after, rig)
        T_before_after, views = T_before_after @ se3_exp(step), views._replace(points=points)
    return T_before_after, support


def _two_views(sequence: Sequence, intervals: int) -> _TwoViews:
    pairs, uv_px, rig = usable_pairs(sequence), sequence.observations.uv_px, sequence.rig
    points = triangulate(uv_px[pairs.before], rig)
    first = np.searchsorted(pairs.interval, np.arange(intervals + 1))
    return _TwoViews(_last(points), _last(uv_px[pairs.before]), _last(uv_px[pairs.after]), pairs.interval, first)


def _last(of_pairs: Array) -> Array:
    """Return an array (P, ...) with the axis of the pairs last (..., P)."""
    return np.moveaxis(of_pairs, 0, -1).copy()


def _gauss_newton(views: _TwoViews, T_before_after: Array, rig: StereoRig) -> tuple[Array, Array, Array]:
    """Return one step (K - 1, 6) for every interval, on the right of its motion, the sum of its weights, and points."""
    T_after_before = np.take(_last(se3_inverse(T_before_after)), views.interval, axis=-1)
    rotation = T_after_before[:3, :3]
    moved = _applied(rotation, views.points) + T_after_before[:3, 3]
    moved[2] = np.maximum(moved[2], LEAST_DEPTH_M)  # makes a point behind the camera a gross outlier
    d_point_d_uv, d_after = triangulation_jacobian(views.points, rig), _last(projection_jacobian(moved.T, rig))
    d_uv_d_before = _product(_product(d_after, rotation), d_point_d_uv)
    before_px = views.uv_before_px - project(views.points.T, rig).T
    residual_px = views.uv_after_px - project(moved.T, rig).T - _applied(d_uv_d_before, before_px)
    spread = rig.cov_uv_px2 @ d_uv_d_before
    whitener = _whitener(_ridged(rig.cov_uv_px2[..., None] + np.einsum("ijp,kjp->ikp", spread, d_uv_d_before)))
    white = _applied(whitener, residual_px)
    weight = _cauchy_weights((white**2).sum(axis=0), views)
    root = np.sqrt(weight)
    normal = _normal_by_interval(_equations(root * _product(whitener, d_after), moved, root * white), views.first)
    # The ridge gives an interval without tracks a step of zero; it is far below one sighting's information.
    hessian = np.moveaxis(_ridged(normal[:6, :6]), -1, 0) + 1e-6 * np.eye(6)
    step = np.asarray(np.linalg.solve(hessian, np.moveaxis(normal[:6, 6:], -1, 0))[..., 0], dtype=np.float64)
    # The least-squares point of both views is the first view's, corrected by its share of the residual.
    share_px = np.einsum("jip,jp->ip", _product(whitener, spread), white)
    points = views.points + _applied(d_point_d_uv, before_px + share_px)
    points[2] = np.clip(points[2], LEAST_DEPTH_M, MOST_DEPTH_M)
    support = np.bincount(views.interval, weight, len(step)).astype(np.float64)
    return step, support, points


def _equations(d_white: Array, moved: Array, white: Array) -> Array:
    """Return the whitened equations (7, 3, P) of a step [phi, rho] on the right of the motion: Jacobian and residual.

    The step moves a point p of the later view, one of ``moved`` (3, P), by [p]x phi - rho.
    """
    d_x, d_y, d_z = d_white.swapaxes(0, 1)
    x, y, z = moved
    return np.stack([d_y * z - d_z * y, d_z * x - d_x * z, d_x * y - d_y * x, -d_x, -d_y, -d_z, white])


def _product(a: Array, b: Array) -> Array:
    """Return the products (i, k, P) of matrices (i, j, P) and (j, k, P)."""
    return np.asarray(np.einsum("ijp,jkp->ikp", a, b))


def _applied(matrix: Array, vector: Array) -> Array:
    """Return the products (i, P) of matrices (i, j, P) and vectors (j, P)."""
    return np.asarray(np.einsum("ijp,jp->ip", matrix, vector))


def triangulation_jacobian(points: Array, rig: StereoRig) -> Array:
    """Return d(point)/d(uL, uR, v) (3, 3, P) of points (3, P) in the camera: the inverse of the projection's."""
    x, y, z = points
    d_z_px = z**2 / (rig.fx_px * rig.baseline_m)
    jacobian = np.zeros((3, 3, len(z)))
    jacobian[:, 1] = x / z * d_z_px, y / z * d_z_px, d_z_px
    jacobian[:, 0] = -jacobian[:, 1]
    jacobian[0, 0] += z / rig.fx_px
    jacobian[1, 2] = z / rig.fy_px
    return jacobian


def _ridged(matrices: Array) -> Array:
    """Return symmetric matrices (d, d, N) with a ridge on each, so that a singular one can be solved."""
    ridged, diagonal = matrices.copy(), np.arange(len(matrices))
    ridged[diagonal, diagonal] += RIDGE * np.trace(matrices)
    return ridged


def _whitener(cov: Array) -> Array:
    """Return the lower triangular W (3, 3, N) with W cov W^T = 1: the inverses of cov's Cholesky factors, all at once.

    cov = L D L^T with ones on the diagonal of L, so W = D^(-1/2) L^(-1).
    """
    (a, b, c), (_, d, e), (_, _, f) = cov
    l10, l20 = b / a, c / a
    pivot1 = d - l10 * b
    l21 = (e - l20 * b) / pivot1
    pivot2 = f - l20 * c - l21 * l21 * pivot1
    whitener = np.zeros_like(cov)
    whitener[0, 0], whitener[1, 1], whitener[2, 2] = np.sqrt(1.0 / np.stack([a, pivot1, pivot2]))
    whitener[1, 0] = -l10 * whitener[1, 1]
    whitener[2, 1] = -l21 * whitener[2, 2]
    whitener[2, 0] = (l10 * l21 - l20) * whitener[2, 2]
    return whitener


def _cauchy_weights(chi2: Array, views: _TwoViews) -> Array:
    """Return the weights (P,) of squared residuals (P,), scaled by the median of their own interval."""
    tracks = np.diff(views.first)
    # One row per interval, padded with NaN, which sorts last.
    by_interval = np.full((tracks.size, tracks.max()), np.nan)
    by_interval[views.interval, np.arange(chi2.size) - views.first[views.interval]] = chi2
    by_interval.sort(axis=1)
    middle = by_interval[np.arange(tracks.size), np.minimum(tracks // 2, tracks.max() - 1)]
    scale2 = np.maximum(middle / CHI2_3_MEDIAN, LEAST_SCALE2)
    weights: Array = 1.0 / (1.0 + chi2 / (CAUCHY_SIGMAS**2 * scale2[views.interval]))
    return weights


def _normal_by_interval(equations: Array, first: IntArray) -> Array:
    """Return A^T A (d, d, K - 1) of the equations (d, 3, P) of each interval, zero for one that has none.

    The equations of an interval are consecutive.
    """
    normal, seen = np.zeros((len(equations), len(equations), first.size - 1)), np.diff(first) > 0
    for k, row in enumerate(equations):
        products = np.einsum("ip,jip->jp", row, equations[k:])
        normal[k, k:, seen] = np.add.reduceat(products, first[:-1][seen], axis=1).T
        normal[k:, k] = normal[k, k:]
    return normal
