"""The camera's motion between two pairs, as most tracks agree on it: what to expect of a track, and which do not fit.

Points triangulated in the pair before and their places now give the pose by RANSAC on three points (Fischler & Bolles
1981; Gao et al. 2003). Depth is known from stereo, so that neither standstill nor a plane nor a pure rotation is a
special case, as it is for the fundamental matrix.
"""

from dataclasses import dataclass, replace

import numpy as np

from toolkit.frontend.cameras import RectifiedPair
from toolkit.geometry import Array, BoolArray, IntArray, se3, transform
from toolkit.sequence import StereoRig

_FEWEST = 8
_ITERATIONS, _CONFIDENCE = 200, 0.999
# A depth from a small disparity is uncertain, and with it what is expected in the right image.
_LEAST_DISPARITY_PX = 0.5


@dataclass(frozen=True, eq=False)
class StereoMotion:
    """Points (N, 3) m of tracks (N,) in the camera of the last pair, and the motion (4, 4) that led to it.

    ``T_now_before`` takes coordinates of the camera before to those of the camera now.
    """

    rig: RectifiedPair
    threshold_px: float
    track_ids: IntArray | None = None
    points: Array | None = None
    T_now_before: Array | None = None

    def at(self, left_px: Array, right_px: Array, track_ids: IntArray) -> "StereoMotion":
        """Return the motion with the points that the tracks (N,) show now."""
        rig = self.rig
        depth = rig.fx_px * rig.baseline_m / np.maximum(left_px[:, 0] - right_px[:, 0], _LEAST_DISPARITY_PX)
        rays = np.stack(
            [
                (left_px[:, 0] - rig.cx_px) / rig.fx_px,
                (left_px[:, 1] - rig.cy_px) / rig.fy_px,
                np.ones(len(left_px)),
            ],
            axis=1,
        )
        return replace(self, track_ids=track_ids, points=rays * depth[:, None])

    def predicted(self, left_px: Array) -> Array:
        """Return where tracks at (N, 2) px are expected in the next left image if the camera moves on as it did."""
        if self.T_now_before is None or self.points is None:
            return left_px
        expected = self._projected(transform(self.T_now_before, self.points))
        width, height = self.rig.size_px
        inside = (expected[:, [0, 2]] >= 0.0).all(axis=1) & (expected[:, 0] < width) & (expected[:, 2] < height)
        return np.where(inside[:, None], expected[:, [0, 2]], left_px)

    def moved(self, rows: IntArray, left_px: Array) -> tuple["StereoMotion", BoolArray]:
        """Find the motion from where some of the tracks (rows) are now (M, 2) px, and which of them agree with it (M,).

        Where they are too few to tell, all agree and the motion is unknown.
        """
        unknown = replace(self, T_now_before=None), np.ones(len(rows), dtype=bool)
        if self.points is None:
            return unknown
        T_now_before = pose_of(self.points[rows], left_px, self.rig, self.threshold_px)
        if T_now_before is None:
            return unknown
        moved = replace(self, T_now_before=T_now_before)
        expected = self._projected(transform(T_now_before, self.points[rows]))
        off_px = np.linalg.norm(expected[:, [0, 2]] - left_px, axis=1)
        return moved, np.asarray(off_px < self.threshold_px)

    def agrees(self, left_px: Array, right_px: Array, track_ids: IntArray) -> BoolArray:
        """Say of tracks (N,), each known to the pair before, whether the right image shows them where it should."""
        if self.T_now_before is None or self.points is None or self.track_ids is None:
            return np.ones(len(track_ids), dtype=bool)
        rows = np.searchsorted(self.track_ids, track_ids)
        expected = self._projected(transform(self.T_now_before, self.points[rows]))
        off_px = (left_px[:, 0] - right_px[:, 0]) - (expected[:, 0] - expected[:, 1])
        return np.asarray(np.abs(off_px) < self.threshold_px)

    def _projected(self, points: Array) -> Array:
        """Return (uL, uR, v) (N, 3) px of points (N, 3); of a point that is not in front of the camera, NaN."""
        rig = self.rig
        depth = np.where(points[:, 2] > 1e-3, points[:, 2], np.nan)
        u = rig.fx_px * points[:, 0] / depth + rig.cx_px
        v = rig.fy_px * points[:, 1] / depth + rig.cy_px
        return np.stack([u, u - rig.fx_px * rig.baseline_m / depth, v], axis=1)


def pose_of(points: Array, left_px: Array, rig: RectifiedPair | StereoRig, threshold_px: float) -> Array | None:
    """Return T_now_before (4, 4) from points (N, 3) m of the camera before and their places (N, 2) px in it now.

    None where fewer than eight of them, or three in ten, agree to the threshold.
    """
    import cv2

    if len(points) < _FEWEST:
        return None
    K = np.array([[rig.fx_px, 0.0, rig.cx_px], [0.0, rig.fy_px, rig.cy_px], [0.0, 0.0, 1.0]])
    found, turn, shift, inliers = cv2.solvePnPRansac(
        *(np.ascontiguousarray(points), np.ascontiguousarray(left_px), K, np.zeros(4)),
        iterationsCount=_ITERATIONS,
        reprojectionError=threshold_px,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not found or inliers is None or len(inliers) < max(_FEWEST, 0.3 * len(points)):
        return None
    return se3(np.asarray(cv2.Rodrigues(turn)[0], dtype=float), np.ravel(shift))
