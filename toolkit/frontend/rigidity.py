"""Do tracks still show the points they did some pairs ago? A slow slide passes every test from one pair to the next.

Points triangulated some pairs ago are moved by the motion that most tracks agree on since then. A track that is
elsewhere, by far more than tracks are in general, has left its point: where an edge passes before what is behind it,
the place in which they cross wanders with the camera, and the patch around it looks alike all the time.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from toolkit.frontend.cameras import RectifiedPair
from toolkit.frontend.motion import pose_of
from toolkit.geometry import Array, BoolArray, IntArray, se3_exp, skew, transform, transposed
from toolkit.models import stereo
from toolkit.sequence import StereoRig

# Tracks are held against a pair that is five to ten pairs back.
_PAIRS_BACK = 5
# A track has left its point where it is off by so many times the median of all tracks, in their own uncertainty, and
# by more than the noise that tracks are said to have (px). The factor was chosen on one rendered flight.
_MEDIANS, _LEAST_PX = 6.0, 0.5
# The motion is refined by one step, with the tracks that are off by less than so many medians.
_OF_MOTION_MEDIANS = 3.0
# Of fewer tracks no median is taken.
_FEWEST = 20


class _Earlier(NamedTuple):
    """Tracks of an earlier pair, so many pairs ago: ids (N,), in order, and uL, uR, v (N, 3) px."""

    pairs: int
    track_ids: IntArray
    uvs_px: Array


@dataclass(frozen=True, eq=False)
class Rigidity:
    """The earlier pairs that tracks are held against, the older first: the one that counts and the one that follows."""

    rig: StereoRig
    threshold_px: float
    earlier: tuple[_Earlier, ...] = ()

    @classmethod
    def of(cls, pair: RectifiedPair, threshold_px: float) -> Self:
        """Return what no pair has been seen with yet; the noise of a place is one pixel, and of v, a mean, half that
        variance."""
        pinhole_px = (pair.fx_px, pair.fy_px, pair.cx_px, pair.cy_px)
        return cls(StereoRig(*pinhole_px, pair.baseline_m, np.eye(4), np.diag([1.0, 1.0, 0.5])), threshold_px)

    def after(self, left_px: Array, right_px: Array, track_ids: IntArray) -> "Rigidity":
        """Return what the next pair is held against, after one with the tracks (N,) at (N, 2) px."""
        kept = tuple(pair._replace(pairs=pair.pairs + 1) for pair in self.earlier)
        if kept and kept[-1].pairs <= _PAIRS_BACK:
            return replace(self, earlier=kept)
        return replace(self, earlier=(*kept[-1:], _Earlier(1, track_ids, _measured(left_px, right_px))))

    def agrees(self, left_px: Array, right_px: Array, track_ids: IntArray) -> BoolArray:
        """Say of tracks (N,) at (N, 2) px whether they are where their points of some pairs ago should be.

        What is new since then is, and so are all where the motion since then cannot be told.
        """
        sound = np.ones(len(track_ids), dtype=bool)
        if not self.earlier or self.earlier[0].pairs < _PAIRS_BACK:
            return sound
        _, then, now = np.intersect1d(self.earlier[0].track_ids, track_ids, assume_unique=True, return_indices=True)
        if len(now) < _FEWEST:
            return sound
        points = stereo.triangulate(self.earlier[0].uvs_px[then], self.rig)
        T_now_then = pose_of(points, left_px[now], self.rig, self.threshold_px)
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

    Both places have a pixel of noise: that of then is carried over by the point, whose depth it makes uncertain.
    """
    moved = transform(T_now_then, points)
    now, then = stereo.projection_jacobian(moved, rig), stereo.projection_jacobian(points, rig)
    carried = now @ T_now_then[:3, :3] @ np.linalg.inv(then)
    information = np.linalg.inv(rig.cov_uv_px2 + carried @ rig.cov_uv_px2 @ transposed(carried))
    off_px = seen_px - stereo.project(moved, rig)
    sizes = np.sqrt(np.einsum("ni,nij,nj->n", off_px, information, off_px))
    return _Deviations(
        off_px, np.asarray(information, dtype=float), sizes, np.concatenate([-now @ skew(moved), now], axis=2)
    )


def _refined(found: _Deviations) -> Array:
    """Return the motion (4, 4) by which most tracks are nearer to their points: one step of Gauss and Newton."""
    rows = found.sizes < _OF_MOTION_MEDIANS * np.median(found.sizes)
    jacobian = found.d_uv_d_motion[rows]
    weighted = transposed(jacobian) @ found.information[rows]
    normal, gradient = (weighted @ jacobian).sum(axis=0), (weighted @ found.off_px[rows, :, None]).sum(axis=0)
    return se3_exp(np.linalg.solve(normal, gradient)[:, 0])
