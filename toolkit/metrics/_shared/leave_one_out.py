"""Predict every sighting of a track from the track's other sightings, for known camera poses.

A track's point is q = (a, b, r): x = a z, y = b z, z = 1 / r in the left camera of the track's last view (inverse
depth; Civera, Davison and Montiel 2008). With it every measurement of every view is a ratio of two functions
linear in q, points at infinity (no disparity) are as good as any other, and a Gauss-Newton step reaches far.

One robust solution a track comes first: Levenberg-Marquardt on all of its views, Huber's weights. Leaving view i
out then subtracts its share from the normal equations and takes one Gauss-Newton step,
(H - H_i) d = -(g - g_i). That is linear in the number of sightings, but view i still influences the weights, so
tracks of at most 40 views are solved again from there without view i; in a longer one its influence is negligible.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse
from toolkit.metrics._shared.evaluation import Evaluation
from toolkit.metrics._shared.residuals import reprojection_errors_px
from toolkit.models import left_only
from toolkit.sequence import Observations, StereoRig

# Leaving one out of three leaves two, the fewest in which an outlier contradicts the motion.
FEWEST_VIEWS = 3
# 95 % quantile of the length of three whitened residuals: sqrt(chi2(3, 0.95)).
_HUBER_SIGMAS = 2.796
# Whitened residual of a view that has the point behind it: worse than any visible error, yet finite.
_BEHIND_SIGMAS = 1e4
_ITERATIONS, _ITERATIONS_AGAIN = 12, 3
_MOST_VIEWS_SOLVED_AGAIN = 40
# So many views are solved again at a time: what is computed of them fits a processor's cache, which halves the time.
_VIEWS_AT_A_TIME = 30_000
_DAMPING, _LEAST_DAMPING = 1e-3, 1e-9


_PER_VIEW = ("uv_px", "numerator", "numerator_0", "denominator", "denominator_0")


class PredictedSightings(NamedTuple):
    """Predicted (uL, uR, v) (N, 3) px, derivatives by the point (N, 3, 3), and whether it is in front (N,)."""

    uv_px: Array
    d_uv_d_point: Array
    in_front: BoolArray


class NormalEquations(NamedTuple):
    """Each view's share of its track's robust problem: H (N, 3, 3), g (N, 3), and its cost (N,)."""

    H: Array
    g: Array
    cost: Array


@dataclass(frozen=True, eq=False)
class Views:
    """The views of M tracks, N in all, sorted by track: what turns a track's point into measurements.

    ``track`` (N,) is 0 ... M-1, ``first`` (M,) the first row of each. A measurement is
    focal * (numerator @ q + numerator_0) / (denominator @ q + denominator_0) + centre, with numerators
    (N, 3, 3), (N, 3) for uL, uR and v, and denominators (N, 3), (N,). ``sqrt_information`` (3, 3), or
    one each (N, 3, 3), whitens.
    """

    track: IntArray
    first: IntArray
    uv_px: Array
    numerator: Array
    numerator_0: Array
    denominator: Array
    denominator_0: Array
    focal_px: Array
    centre_px: Array
    sqrt_information: Array

    def predict(self, points: Array) -> PredictedSightings:
        """Predict each view's measurement from a point of its own (N, 3)."""
        depth = np.einsum("ni,ni->n", self.denominator, points) + self.denominator_0
        ratio = ((self.numerator @ points[..., None])[..., 0] + self.numerator_0) / depth[:, None]
        slope = (self.numerator - ratio[:, :, None] * self.denominator[:, None, :]) / depth[:, None, None]
        uv_px = self.focal_px * ratio + self.centre_px
        return PredictedSightings(uv_px, self.focal_px[:, None] * slope, depth > 0.0)

    def normal_equations(self, points: Array) -> NormalEquations:
        """Linearise every view at its track's point (M, 3), with Huber's weights."""
        uv_px, d_uv_d_point, in_front = self.predict(points[self.track])
        residual = left_only.applied(self.sqrt_information, left_only.residuals_px(self.uv_px, uv_px))
        length = np.linalg.norm(residual, axis=1)
        visible = in_front & np.isfinite(length)
        length = np.where(visible, length, _BEHIND_SIGMAS)
        weight = visible * np.minimum(1.0, _HUBER_SIGMAS / np.maximum(length, _HUBER_SIGMAS))
        slope = np.where(visible[:, None, None], self.sqrt_information @ d_uv_d_point, 0.0)
        weighted_slope = weight[:, None, None] * np.swapaxes(slope, 1, 2)
        g = -(weighted_slope @ np.where(visible[:, None], residual, 0.0)[..., None])[..., 0]
        quadratic = 0.5 * length**2
        cost = np.where(length <= _HUBER_SIGMAS, quadratic, _HUBER_SIGMAS * (length - 0.5 * _HUBER_SIGMAS))
        return NormalEquations(weighted_slope @ slope, g, cost)

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
        chosen = {name: getattr(self, name)[other] for name in _PER_VIEW}
        if self.sqrt_information.ndim == 3:
            chosen["sqrt_information"] = self.sqrt_information[other]
        return replace(self, track=np.repeat(np.arange(rows.size), count), first=first, **chosen)

    def summed(self, shares: Array) -> Array:
        """Add up the views' shares (N, ...) to one a track (M, ...)."""
        return np.add.reduceat(shares, self.first, axis=0)


def errors_left_out(observations: Observations, evaluation: Evaluation) -> tuple[IntArray, Array]:
    """Return which sightings (M,) have enough views with a pose, and their leave-one-view-out errors (M,) px.

    They are in the order of tracks, each track's by frame.
    """
    posed = np.flatnonzero(evaluation.has_pose[observations.frame])
    by_track = posed[np.lexsort((observations.frame[posed], observations.track_id[posed]))]
    _, track, views = np.unique(observations.track_id[by_track], return_inverse=True, return_counts=True)
    rows = by_track[views[track] >= FEWEST_VIEWS]
    enough, rig = observations.select(rows), evaluation.sequence.rig
    if not rows.size:
        return rows, np.empty(0)
    T_world_cam = evaluation.poses_of_frames[enough.frame] @ rig.T_imu_cam
    predicted = predict_left_out(enough.track_id, enough.uv_px, T_world_cam, rig)
    return rows, reprojection_errors_px(predicted.uv_px, enough.uv_px, predicted.in_front)


def predict_left_out(track_ids: IntArray, uv_px: Array, T_world_cam: Array, rig: StereoRig) -> PredictedSightings:
    """Predict each sighting (N, 3) px of tracks (N,), sorted by track, from the others of its track.

    ``T_world_cam`` (N, 4, 4) is the left camera's pose at each sighting. Every track needs at least two
    views. What comes out is in the order that went in; it may not be finite where the poses are absurd.
    """
    T_last_view = _relative_to_last(track_ids, T_world_cam)
    views = _views(track_ids, uv_px, T_last_view, rig)
    points = _without_each(views, _solve(views, _start(views, T_last_view, rig), _ITERATIONS))
    again = np.flatnonzero(views.count[views.track] <= _MOST_VIEWS_SOLVED_AGAIN)
    for rows in _in_parts(again, views.count[views.track[again]] - 1):
        points[rows] = _solve(views.others(rows), points[rows], _ITERATIONS_AGAIN)
    return views.predict(points)


def _in_parts(rows: IntArray, others: IntArray) -> Iterator[IntArray]:
    """Yield the rows (n,), so many at a time that their numbers of other views (n,) add up to the most of a part."""
    part = np.cumsum(others) // _VIEWS_AT_A_TIME
    yield from (of_part for of_part in np.split(rows, np.flatnonzero(np.diff(part)) + 1) if of_part.size)


def _first_rows(track_ids: IntArray) -> IntArray:
    return np.flatnonzero(np.concatenate([[True], np.diff(track_ids) != 0]))


def _relative_to_last(track_ids: IntArray, T_world_cam: Array) -> Array:
    """Return T_last_view (N, 4, 4): from each view's camera to the camera of its track's last view."""
    first = _first_rows(track_ids)
    last = np.append(first[1:], track_ids.size) - 1
    counts = np.diff(np.append(first, track_ids.size))
    return se3_inverse(T_world_cam[np.repeat(last, counts)]) @ T_world_cam


def _views(track_ids: IntArray, uv_px: Array, T_last_view: Array, rig: StereoRig) -> Views:
    first = _first_rows(track_ids)
    T_view_last = se3_inverse(T_last_view)
    # r times the point in the view's camera: R (a, b, 1) + r t, linear in q = (a, b, r).
    linear, constant = T_view_last[:, :3, [0, 1, 3]], T_view_last[:, :3, 2]
    right = linear[:, 0] - np.array([0.0, 0.0, rig.baseline_m])
    return Views(
        track=np.repeat(np.arange(first.size), np.diff(np.append(first, track_ids.size))),
        first=first,
        uv_px=uv_px,
        numerator=np.stack([linear[:, 0], right, linear[:, 1]], axis=1),
        numerator_0=constant[:, [0, 0, 1]],
        denominator=linear[:, 2],
        denominator_0=constant[:, 2],
        focal_px=np.array([rig.fx_px, rig.fx_px, rig.fy_px]),
        centre_px=np.array([rig.cx_px, rig.cx_px, rig.cy_px]),
        sqrt_information=left_only.whitener(uv_px, rig),
    )


def _start(views: Views, T_last_view: Array, rig: StereoRig) -> Array:
    """Start each track (M, 3) at the median, by component, of what its views see in stereo one by one."""
    ray = np.stack([(views.uv_px[:, 0] - rig.cx_px) / rig.fx_px, (views.uv_px[:, 2] - rig.cy_px) / rig.fy_px], axis=1)
    inverse_depth = (views.uv_px[:, 0] - views.uv_px[:, 1]) / (rig.fx_px * rig.baseline_m)
    homogeneous = np.column_stack([ray, np.ones(len(ray)), inverse_depth])
    in_last = (T_last_view[:, :3] @ homogeneous[..., None])[..., 0]
    seen = np.column_stack([in_last[:, :2], inverse_depth]) / in_last[:, 2:]
    return np.stack([_median_by_track(views, component) for component in seen.T], axis=1)


def _median_by_track(views: Views, values: Array) -> Array:
    """Return the lower median (M,) of values (N,) over each track's views, those apart that are NaN."""
    order, known = np.lexsort((values, views.track)), np.add.reduceat((~np.isnan(values)).astype(np.int64), views.first)
    median: Array = values[order][views.first + np.maximum(known - 1, 0) // 2]
    return np.where(np.isfinite(median), median, 0.0)


def _without_each(views: Views, points: Array) -> Array:
    """Return for each view its track's point (N, 3) one Gauss-Newton step after the view's share is taken out."""
    shares = views.normal_equations(points)
    H = views.summed(shares.H)[views.track] - shares.H
    g = views.summed(shares.g)[views.track] - shares.g
    return points[views.track] - _damped_solve(H, g, np.full(len(g), _LEAST_DAMPING))


def _solve(views: Views, points: Array, iterations: int) -> Array:
    """Minimise the robust cost of every track at once, each with a damping of its own (Levenberg-Marquardt)."""
    damping = np.full(len(points), _DAMPING)
    H, g, cost = (views.summed(share) for share in views.normal_equations(points))
    for _ in range(iterations):
        moved = points - _damped_solve(H, g, damping)
        H_moved, g_moved, cost_moved = (views.summed(share) for share in views.normal_equations(moved))
        better = cost_moved <= cost
        points, g = np.where(better[:, None], moved, points), np.where(better[:, None], g_moved, g)
        H, cost = np.where(better[:, None, None], H_moved, H), np.where(better, cost_moved, cost)
        damping = np.where(better, np.maximum(0.1 * damping, _LEAST_DAMPING), 10.0 * damping)
    return points


def _damped_solve(H: Array, g: Array, damping: Array) -> Array:
    """Solve (H + damping diag(H)) d = g (..., 3); where H is not finite or empty, the step is zero."""
    diagonal = np.diagonal(H, axis1=-2, axis2=-1)
    solvable: BoolArray = np.asarray(
        np.isfinite(H).all(axis=(-2, -1)) & np.isfinite(g).all(axis=-1) & (diagonal > 0.0).all(axis=-1)
    )
    damped = H + damping[:, None, None] * diagonal[:, :, None] * np.eye(3)
    matrix = np.where(solvable[:, None, None], damped, np.eye(3))
    vector = np.where(solvable[:, None], g, 0.0)
    return np.asarray(np.linalg.solve(matrix, vector[..., None])[..., 0])
