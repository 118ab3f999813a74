"""Predict every sighting of a track from the track's other sightings, for known camera poses.

A track's point is q = (a, b, r): x = a z, y = b z, z = 1 / r in the left camera of the track's last view (inverse
depth; Civera, Davison and Montiel 2008). With it every measurement of every view is a ratio of two functions linear in
q, points at infinity (no disparity) need no special treatment, and Gauss-Newton converges from far away.

Each track is first solved robustly: Levenberg-Marquardt on all of its views with Huber's weights. Leaving view i out
then means subtracting its contribution to the normal equations and taking one Gauss-Newton step, (H - H_i) d = -(g -
g_i). That is linear in the number of sightings, but view i still influences the weights, so tracks of at most 40 views
are solved again from there without view i; in a longer one its influence is negligible.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse
from toolkit.measurements import StereoRig, is_left_only
from toolkit.models import stereo
from toolkit.sequence import Observations

# Cap of the error of an observation. A point behind the camera, or one that is not finite, has this error, so that no
# run gains by losing its points.
CAP_PX = 100.0
# Leaving one out of three leaves two, the fewest in which an outlier contradicts the motion.
FEWEST_VIEWS = 3
# 95 % quantile of the length of three whitened residuals: sqrt(chi2(3, 0.95)).
_HUBER_SIGMAS = 2.796
# Whitened residual of a view that has the point behind it: worse than any visible error, yet finite.
_BEHIND_SIGMAS = 1e4
_ITERATIONS, _ITERATIONS_AGAIN = 12, 3
_MOST_VIEWS_SOLVED_AGAIN = 40
# Views that are solved again at a time: their arrays fit a processor's cache, which halves the time.
_VIEWS_AT_A_TIME = 10_000
_DAMPING, _LEAST_DAMPING = 1e-3, 1e-9
# Rows of a robust problem's sums: the upper half of H row by row, g, and the cost. _WHOLE are the rows of all of H.
_H, _G, _COST = slice(0, 6), slice(6, 9), 9
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_WHOLE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


class _Projections(NamedTuple):
    """Projections of a point by each view: the image (3, N) in focal lengths from the centre, 1 / z and z > 0 (N,)."""

    ratio: Array
    inverse_depth: Array
    in_front: BoolArray


@dataclass(frozen=True, eq=False)
class Views:
    """The views of M tracks, N in all, sorted by track, which map a track's point to measurements.

    ``track`` (N,) is 0 ... M-1, ``first`` (M,) the first row of each. ``linear`` (3, 3, N) and ``constant`` (3, N) map
    a track's point to r times the point in the view's camera, linear @ q + constant. ``uv_px`` (3, N) was measured.
    ``sqrt_information`` (3, 3), or one each (3, 3, N), whitens. Views are the last axis, because arithmetic on whole
    rows takes a third of the time of products of small matrices.
    """

    track: IntArray
    first: IntArray
    uv_px: Array
    linear: Array
    constant: Array
    rig: StereoRig
    sqrt_information: Array

    def project(self, points: Array) -> _Projections:
        """Project a point for each view (3, N)."""
        linear, constant = self.linear, self.constant
        x, y, depth = (linear[i, 0] * points[0] + linear[i, 1] * points[1] + linear[i, 2] * points[2] for i in range(3))
        x, y, depth = x + constant[0], y + constant[1], depth + constant[2]
        inverse_depth = 1.0 / depth
        ratio = np.stack([x, x - self.rig.baseline_m * points[2], y]) * inverse_depth
        return _Projections(ratio, inverse_depth, depth > 0.0)

    def pixels(self, seen: _Projections) -> Array:
        return np.asarray(self._focal_px * seen.ratio + self._centre_px)

    def contributions(self, points: Array) -> Array:
        """Return each view's part (10, N) of its track's robust problem at the point (3, M): H, g and cost."""
        seen = self.project(np.take(points, self.track, axis=1))
        residual = self._whitened(stereo.residuals_px(self.uv_px.T, self.pixels(seen).T).T)
        length = np.sqrt(residual[0] ** 2 + residual[1] ** 2 + residual[2] ** 2)
        visible = seen.in_front & np.isfinite(length)
        slope = self._whitened(self._slope(seen))
        if not visible.all():
            length = np.where(visible, length, _BEHIND_SIGMAS)
            residual, slope = np.where(visible, residual, 0.0), np.where(visible, slope, 0.0)
        weighted = slope * (visible * np.minimum(1.0, _HUBER_SIGMAS / np.maximum(length, _HUBER_SIGMAS)))
        contributions = np.empty((10, length.size))
        for row, (i, j) in enumerate(_UPPER):
            contributions[row] = _dot(weighted[:, i], slope[:, j])
        for i in range(3):
            contributions[_G][i] = -_dot(weighted[:, i], residual)
        robust = _HUBER_SIGMAS * (length - 0.5 * _HUBER_SIGMAS)
        contributions[_COST] = np.where(length <= _HUBER_SIGMAS, 0.5 * length**2, robust)
        return contributions

    def _slope(self, seen: _Projections) -> Array:
        """Return the derivatives (3, 3, N) of pixels by the point."""
        slope = np.stack([self.linear[0], self.linear[0], self.linear[1]])
        slope[1, 2] -= self.rig.baseline_m
        slope -= seen.ratio[:, None] * self.linear[2]
        slope *= (self._focal_px * seen.inverse_depth)[:, None]
        return slope

    def _whitened(self, values: Array) -> Array:
        """Return pixels (3, ..., N) in standard deviations."""
        whitener = self.sqrt_information
        if whitener.ndim == 2:
            return np.asarray((whitener @ values.reshape(3, -1)).reshape(values.shape))
        return np.stack([_dot(row if values.ndim == 2 else row[:, None], values) for row in whitener])

    @property
    def _focal_px(self) -> Array:
        return np.array([[self.rig.fx_px], [self.rig.fx_px], [self.rig.fy_px]])

    @property
    def _centre_px(self) -> Array:
        return np.array([[self.rig.cx_px], [self.rig.cx_px], [self.rig.cy_px]])

    @property
    def count(self) -> IntArray:
        """The number of views of each track (M,)."""
        return np.diff(np.append(self.first, self.track.size))

    def others(self, rows: IntArray) -> "Views":
        """Return, for each of the rows (n,), the other views of its track, as a track of its own."""
        count = self.count[self.track[rows]] - 1
        first = np.cumsum(count) - count
        first_of_track = np.repeat(self.first[self.track[rows]], count)
        place = np.arange(count.sum()) - np.repeat(first, count)
        other = first_of_track + place
        other += other >= np.repeat(rows, count)
        per_view = {name: getattr(self, name).take(other, axis=-1) for name in ("uv_px", "linear", "constant")}
        if self.sqrt_information.ndim == 3:
            per_view["sqrt_information"] = self.sqrt_information.take(other, axis=-1)
        return replace(self, track=np.repeat(np.arange(rows.size), count), first=first, **per_view)

    def summed(self, contributions: Array) -> Array:
        """Sum the views' contributions (..., N) to one per track (..., M)."""
        return np.add.reduceat(contributions, self.first, axis=-1)


def _dot(first: Array, second: Array) -> Array:
    """Return the sum of products over the first axis, of length three."""
    return np.asarray(first[0] * second[0] + first[1] * second[1] + first[2] * second[2])


def errors_left_out(observations: Observations, poses: Array, rig: StereoRig) -> tuple[IntArray, Array]:
    """Return which sightings (M,) have enough views with a pose, and their leave-one-view-out errors (M,) px.

    They are in the order of tracks, each track's by frame. ``poses`` (K, 4, 4) T_world_imu are those of all frames, NaN
    where there is none.
    """
    posed = np.flatnonzero(np.isfinite(poses[observations.frame]).all(axis=(1, 2)))
    by_track = posed[np.lexsort((observations.frame[posed], observations.track_id[posed]))]
    _, track, views = np.unique(observations.track_id[by_track], return_inverse=True, return_counts=True)
    rows = by_track[views[track] >= FEWEST_VIEWS]
    enough = observations.select(rows)
    if not rows.size:
        return rows, np.empty(0)
    T_world_cam = poses[enough.frame] @ rig.T_imu_cam
    predicted_px, in_front = predict_left_out(enough.track_id, enough.uv_px, T_world_cam, rig)
    return rows, reprojection_errors_px(predicted_px, enough.uv_px, in_front)


def predict_left_out(track_ids: IntArray, uv_px: Array, T_world_cam: Array, rig: StereoRig) -> tuple[Array, BoolArray]:
    """Predict each sighting (N, 3) px of tracks (N,), sorted by track, from the others; say if the point is in front.

    ``T_world_cam`` (N, 4, 4) is the left camera's pose at each sighting. Every track needs at least two views. The
    results are in the order of the input; they may not be finite where the poses are absurd.
    """
    views, T_last_view = _views(track_ids, uv_px, T_world_cam, rig)
    points = _without_each(views, _solve(views, _start(views, T_last_view, rig), _ITERATIONS))
    again = np.flatnonzero(views.count[views.track] <= _MOST_VIEWS_SOLVED_AGAIN)
    part = np.cumsum(views.count[views.track[again]] - 1) // _VIEWS_AT_A_TIME
    for rows in np.split(again, np.flatnonzero(np.diff(part)) + 1) if again.size else ():
        points[:, rows] = _solve(views.others(rows), points[:, rows], _ITERATIONS_AGAIN)
    seen = views.project(points)
    return views.pixels(seen).T, seen.in_front


def reprojection_errors_px(uv_predicted_px: Array, uv_measured_px: Array, in_front: BoolArray) -> Array:
    """Return the root mean square of the uL, uR and v residuals (N,), no more than CAP_PX.

    Predictions and measurements are (N, 3); an observation that is not ``in_front`` (N,) counts as CAP_PX. One that
    lacks the right image has the root mean square of uL and v.
    """
    squares_px2 = (uv_measured_px - uv_predicted_px) ** 2
    means_px2 = np.where(is_left_only(uv_measured_px), squares_px2[:, [0, 2]].mean(axis=1), squares_px2.mean(axis=1))
    errors_px = np.sqrt(means_px2)
    return np.where(in_front & (errors_px < CAP_PX), errors_px, CAP_PX)


def _views(track_ids: IntArray, uv_px: Array, T_world_cam: Array, rig: StereoRig) -> tuple[Views, Array]:
    """Return the views of sorted tracks, and T_last_view (N, 4, 4) from each to the last view of its track."""
    _, first, track, count = np.unique(track_ids, return_index=True, return_inverse=True, return_counts=True)
    T_last_view = se3_inverse(T_world_cam[(first + count - 1)[track]]) @ T_world_cam
    T_view_last = se3_inverse(T_last_view)
    # r times the point in the view's camera: R (a, b, 1) + r t, linear in q = (a, b, r).
    linear, constant = T_view_last[:, :3, [0, 1, 3]], T_view_last[:, :3, 2]
    whitener = stereo.whitener(uv_px, rig)
    views = Views(
        track=track,
        first=first,
        uv_px=np.ascontiguousarray(uv_px.T),
        linear=np.ascontiguousarray(linear.transpose(1, 2, 0)),
        constant=np.ascontiguousarray(constant.T),
        rig=rig,
        sqrt_information=whitener if whitener.ndim == 2 else np.ascontiguousarray(whitener.transpose(1, 2, 0)),
    )
    return views, T_last_view


def _start(views: Views, T_last_view: Array, rig: StereoRig) -> Array:
    """Return the initial point of each track (3, M): the median, by component, of its views' stereo points."""
    u_left_px, u_right_px, v_px = views.uv_px
    ray = np.stack([(u_left_px - rig.cx_px) / rig.fx_px, (v_px - rig.cy_px) / rig.fy_px], axis=1)
    inverse_depth = (u_left_px - u_right_px) / (rig.fx_px * rig.baseline_m)
    homogeneous = np.column_stack([ray, np.ones(len(ray)), inverse_depth])
    in_last = (T_last_view[:, :3] @ homogeneous[..., None])[..., 0]
    seen = np.column_stack([in_last[:, :2], inverse_depth]) / in_last[:, 2:]
    return np.stack([_median_by_track(views, component) for component in seen.T])


def _median_by_track(views: Views, values: Array) -> Array:
    """Return the lower median (M,) of values (N,) over each track's views, NaN left out."""
    order, known = np.lexsort((values, views.track)), np.add.reduceat((~np.isnan(values)).astype(np.int64), views.first)
    median: Array = values[order][views.first + np.maximum(known - 1, 0) // 2]
    return np.where(np.isfinite(median), median, 0.0)


def _without_each(views: Views, points: Array) -> Array:
    """Return for each view its track's point (3, N) one Gauss-Newton step after the view is taken out."""
    contributions = views.contributions(points)
    rest = np.take(views.summed(contributions), views.track, axis=1) - contributions
    step = _damped_step(rest, np.full(views.track.size, _LEAST_DAMPING))
    return np.asarray(np.take(points, views.track, axis=1) - step)


def _solve(views: Views, points: Array, iterations: int) -> Array:
    """Minimise the robust cost of every track (3, M) at once, each with a damping of its own (Levenberg-Marquardt)."""
    damping = np.full(points.shape[1], _DAMPING)
    sums = views.summed(views.contributions(points))
    for _ in range(iterations):
        moved = points - _damped_step(sums, damping)
        sums_moved = views.summed(views.contributions(moved))
        better = sums_moved[_COST] <= sums[_COST]
        points, sums = np.where(better, moved, points), np.where(better, sums_moved, sums)
        damping = np.where(better, np.maximum(0.1 * damping, _LEAST_DAMPING), 10.0 * damping)
    return points


def _damped_step(sums: Array, damping: Array) -> Array:
    """Solve (H + damping diag(H)) d = g of problems (10, M) for d (3, M); where H is not finite or empty, d is zero."""
    diagonal = sums[[0, 3, 5]]
    solvable: BoolArray = np.asarray(np.isfinite(sums[:_COST]).all(axis=0) & (diagonal > 0.0).all(axis=0))
    H = sums[_WHOLE]
    H[range(3), range(3)] = diagonal + damping * diagonal
    matrix = np.where(solvable, H, np.eye(3)[:, :, None]).transpose(2, 0, 1)
    vector = np.where(solvable, sums[_G], 0.0).T
    return np.linalg.solve(matrix, vector[..., None])[..., 0].T
