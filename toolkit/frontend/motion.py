"""The camera's motion by consensus of the tracks: predicts tracks, and finds tracks that have left their points.

From one pair to the next the pose is estimated from points triangulated in the last pair, by RANSAC on three points
(Fischler & Bolles 1981; Gao et al. 2003). Depth is known from stereo, so that neither standstill nor a plane nor a pure
rotation is a special case, as it is for the fundamental matrix.

A slow drift of a track passes every test from one pair to the next. So points triangulated some pairs ago are also
moved by the motion since then: a track that is farther from its prediction than most tracks by a large factor has left
its point. An example is the crossing of two edges at different depths: it moves with the camera, while the patch around
it looks the same.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray, se3, se3_exp, skew, transform, transposed
from toolkit.measurements import StereoRig
from toolkit.models import stereo

_FEWEST_OF_A_POSE, _LEAST_SHARE_OF_A_POSE = 8, 0.3
_ITERATIONS, _CONFIDENCE = 200, 0.999
# A depth from a small disparity is uncertain, and with it what is expected in the right image.
_LEAST_DISPARITY_PX = 0.5
_LEAST_DEPTH_M = 1e-3
# Tracks are held against a pair that is five to ten pairs back.
_PAIRS_BACK = 5
# A track has left its point where it is off by this many times the median of all tracks, in their own uncertainty, and
# by more than the noise that tracks are said to have (px). The factor was chosen on one rendered flight.
_MEDIANS, _LEAST_PX = 6.0, 0.5
# The motion is refined by one step, with the tracks that are off by less than this many medians.
_OF_MOTION_MEDIANS = 3.0
# Of fewer tracks no median is taken.
_FEWEST_OF_A_MEDIAN = 20


@dataclass(frozen=True, eq=False)
class StereoMotion:
    """Points (N, 3) m of tracks (N,) in the camera of the last pair, and the motion (4, 4) that led to it.

    ``T_now_before`` takes coordinates of the camera before to those of the camera now.
    """

    rig: StereoRig
    size_px: tuple[int, int]
    threshold_px: float
    track_ids: IntArray | None = None
    points: Array | None = None
    T_now_before: Array | None = None

    def at(self, left_px: Array, right_px: Array, track_ids: IntArray) -> "StereoMotion":
        """Return the motion with the points that the tracks (N,) show now."""
        nearest_px = np.minimum(right_px[:, 0], left_px[:, 0] - _LEAST_DISPARITY_PX)
        points = stereo.triangulate(np.column_stack([left_px[:, 0], nearest_px, left_px[:, 1]]), self.rig)
        return replace(self, track_ids=track_ids, points=points)

    def predicted(self, left_px: Array) -> Array:
        """Return where tracks at (N, 2) px are expected in the next left image if the camera moves on as it did."""
        if self.T_now_before is None or self.points is None:
            return left_px
        expected = self._expected(self.T_now_before, self.points)[:, [0, 2]]
        inside = ((expected >= 0.0) & (expected < np.array(self.size_px))).all(axis=1, keepdims=True)
        return np.where(inside, expected, left_px)

    def moved(self, rows: IntArray, left_px: Array) -> tuple["StereoMotion", BoolArray]:
        """Find the motion from where some of the tracks (rows) are now (M, 2) px, and which of them agree with it (M,).

        If there are too few tracks, all agree and the motion is unknown.
        """
        points = None if self.points is None else self.points[rows]
        T_now_before = None if points is None else _pose_of(points, left_px, self.rig, self.threshold_px)
        if points is None or T_now_before is None:
            return replace(self, T_now_before=None), np.ones(len(rows), dtype=bool)
        off_px = np.linalg.norm(self._expected(T_now_before, points)[:, [0, 2]] - left_px, axis=1)
        return replace(self, T_now_before=T_now_before), np.asarray(off_px < self.threshold_px)

    def agrees(self, left_px: Array, right_px: Array, track_ids: IntArray) -> BoolArray:
        """Say of tracks (N,), each known to the pair before, whether the right image shows them where it should."""
        if self.T_now_before is None or self.points is None or self.track_ids is None:
            return np.ones(len(track_ids), dtype=bool)
        expected = self._expected(self.T_now_before, self.points[np.searchsorted(self.track_ids, track_ids)])
        off_px = left_px[:, 0] - right_px[:, 0] - stereo.disparity_px(expected)
        return np.asarray(np.abs(off_px) < self.threshold_px)

    def _expected(self, T_now_before: Array, points: Array) -> Array:
        """Return (uL, uR, v) (N, 3) px of points (N, 3) of before; of one that is not in front of the camera, NaN."""
        moved = transform(T_now_before, points)
        moved[:, 2] = np.where(moved[:, 2] > _LEAST_DEPTH_M, moved[:, 2], np.nan)
        return stereo.project(moved, self.rig)


def _pose_of(points: Array, left_px: Array, rig: StereoRig, threshold_px: float) -> Array | None:
    """Return T_now_before (4, 4) from points (N, 3) m of the camera before and their places (N, 2) px in it now.

    None where fewer than eight of them, or three in ten, agree to the threshold.
    """
    import cv2

    if len(points) < _FEWEST_OF_A_POSE:
        return None
    K = np.array([[rig.fx_px, 0.0, rig.cx_px], [0.0, rig.fy_px, rig.cy_px], [0.0, 0.0, 1.0]])
    found, turn, shift, inliers = cv2.solvePnPRansac(
        *(np.ascontiguousarray(points), np.ascontiguousarray(left_px), K, np.zeros(4)),
        iterationsCount=_ITERATIONS,
        reprojectionError=threshold_px,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_P3P,
    )
    fewest = max(_FEWEST_OF_A_POSE, _LEAST_SHARE_OF_A_POSE * len(points))
    if not found or inliers is None or len(inliers) < fewest:
        return None
    return se3(np.asarray(cv2.Rodrigues(turn)[0], dtype=float), np.ravel(shift))


class _Earlier(NamedTuple):
    """Tracks of a pair that is ``pairs`` earlier: ids (N,), in order, and uL, uR, v (N, 3) px."""

    pairs: int
    track_ids: IntArray
    uvs_px: Array


@dataclass(frozen=True, eq=False)
class Rigidity:
    """The earlier pairs that tracks are held against, the older first: the one that counts and the one that follows."""

    rig: StereoRig
    threshold_px: float
    earlier: tuple[_Earlier, ...] = ()

    def after(self, left_px: Array, right_px: Array, track_ids: IntArray) -> "Rigidity":
        """Return what the next pair is held against, after one with the tracks (N,) at (N, 2) px."""
        kept = tuple(pair._replace(pairs=pair.pairs + 1) for pair in self.earlier)
        if kept and kept[-1].pairs <= _PAIRS_BACK:
            return replace(self, earlier=kept)
        return replace(self, earlier=(*kept[-1:], _Earlier(1, track_ids, _measured(left_px, right_px))))

    def agrees(self, left_px: Array, right_px: Array, track_ids: IntArray) -> BoolArray:
        """Say of tracks (N,) at (N, 2) px whether they are where their points of some pairs ago should be.

        Tracks that are newer agree, and all agree where the motion since then is unknown.
        """
        sound = np.ones(len(track_ids), dtype=bool)
        if not self.earlier or self.earlier[0].pairs < _PAIRS_BACK:
            return sound
        _, then, now = np.intersect1d(self.earlier[0].track_ids, track_ids, assume_unique=True, return_indices=True)
        if len(now) < _FEWEST_OF_A_MEDIAN:
            return sound
        points = stereo.triangulate(self.earlier[0].uvs_px[then], self.rig)
        T_now_then = _pose_of(points, left_px[now], self.rig, self.threshold_px)
        if T_now_then is None:
            return sound
        seen_px = _measured(left_px[now], right_px[now])
        T_now_then = _refined(_deviations(points, T_now_then, seen_px, self.rig)) @ T_now_then
        found = _deviations(points, T_now_then, seen_px, self.rig)
        off_px = np.linalg.norm(found.off_px, axis=1)
        sound[now] = (found.sizes < _MEDIANS * np.median(found.sizes)) | (off_px < _LEAST_PX)
        return sound


class _Deviations(NamedTuple):
    """By how much tracks are off their points (N, 3) px, the inverse of its covariance (N, 3, 3), and both as one (N,).

    ``d_uv_d_motion`` (N, 3, 6) is by the motion, perturbed on the left.
    """

    off_px: Array
    information: Array
    sizes: Array
    d_uv_d_motion: Array


def _measured(left_px: Array, right_px: Array) -> Array:
    """Return uL, uR, v (N, 3) px of tracks at (N, 2) px, v being the mean of both rows."""
    return np.column_stack([left_px[:, 0], right_px[:, 0], 0.5 * (left_px[:, 1] + right_px[:, 1])])


def _deviations(points: Array, T_now_then: Array, seen_px: Array, rig: StereoRig) -> _Deviations:
    """Hold tracks (N, 3) px against their points (N, 3) m of then.

    Both places have the rig's noise: that of then is carried over by the point, whose depth it makes uncertain.
    """
    moved = transform(T_now_then, points)
    now, then = stereo.projection_jacobian(moved, rig), stereo.projection_jacobian(points, rig)
    carried = now @ T_now_then[:3, :3] @ np.linalg.inv(then)
    information = np.asarray(np.linalg.inv(rig.cov_uv_px2 + carried @ rig.cov_uv_px2 @ transposed(carried)))
    off_px = seen_px - stereo.project(moved, rig)
    sizes = np.sqrt(np.einsum("ni,nij,nj->n", off_px, information, off_px))
    return _Deviations(off_px, information, sizes, np.concatenate([-now @ skew(moved), now], axis=2))


def _refined(found: _Deviations) -> Array:
    """Return the motion (4, 4) by which most tracks are nearer to their points: one step of Gauss and Newton."""
    rows = found.sizes < _OF_MOTION_MEDIANS * np.median(found.sizes)
    jacobian = found.d_uv_d_motion[rows]
    weighted = transposed(jacobian) @ found.information[rows]
    normal, gradient = (weighted @ jacobian).sum(axis=0), (weighted @ found.off_px[rows, :, None]).sum(axis=0)
    return se3_exp(np.linalg.solve(normal, gradient)[:, 0])
