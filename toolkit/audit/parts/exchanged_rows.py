"""Finds tracks, among others, whose image coordinates are exchanged: the row in the place of the column.

uL and uR are then the rows of both images, which differ by noise alone, and v is the column. The camera's own motion,
from the other tracks, predicts where a point of unknown depth is seen next: on a part of its epipolar line (Hartley and
Zisserman, "Multiple View Geometry", section 9.2). An exchanged track follows this line after its coordinates are
exchanged again.
"""

import numpy as np

from toolkit.audit.parts.intervals import moved_by
from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse
from toolkit.models.camera_motion import CameraMotion, neighbours
from toolkit.models.stereo import disparity_px
from toolkit.sequence import Sequence, StereoRig

# A track whose rows stand for columns: the mean of its disparities is within so many standard errors of zero.
ROW_SIGMAS = 4.0
LEAST_PAIRS = 3
# Inverse depths (1/m) along an epipolar line, from infinity to half a metre.
_INVERSE_DEPTHS = np.concatenate([[0.0], np.geomspace(1e-3, 2.0, 23)])


def exchanged_rows(sequence: Sequence, camera: CameraMotion) -> BoolArray:
    """Say of each sighting (N,) whether its track, without disparity, follows the camera's motion only if exchanged.

    Its median distance from the epipolar lines is then less than half of what it is as given.
    """
    candidates = like_rows(sequence)
    pairs = neighbours(sequence.observations)
    pairs = pairs.select(camera.known[pairs.interval] & candidates[pairs.before])
    exchanged = np.zeros(len(sequence.observations), dtype=bool)
    if not pairs.before.size:
        return exchanged
    T_after_before = se3_inverse(moved_by(camera, sequence))[pairs.interval]
    uv_px, track_id = sequence.observations.uv_px, sequence.observations.track_id[pairs.before]
    rows_px = uv_px[:, :2].mean(axis=1)
    as_given, turned = np.stack([rows_px, uv_px[:, 2]], axis=1), np.stack([uv_px[:, 2], rows_px], axis=1)
    off_px = [
        _median_of_each(track_id, _off_line_px(pixels[pairs.before], pixels[pairs.after], T_after_before, sequence.rig))
        for pixels in (as_given, turned)
    ]
    enough = np.unique(track_id, return_counts=True)[1] >= LEAST_PAIRS
    struck = np.unique(track_id)[enough & (off_px[1] < 0.5 * off_px[0])]
    return np.asarray(np.isin(sequence.observations.track_id, struck) & candidates)


def like_rows(sequence: Sequence) -> BoolArray:
    """Say of each sighting (N,) whether the disparities of its track are zero but for the noise of rows."""
    disparity = disparity_px(sequence.observations.uv_px)
    _, member, counts = np.unique(sequence.observations.track_id, return_inverse=True, return_counts=True)
    mean = np.bincount(member, weights=disparity) / counts
    spread = np.sqrt(np.maximum(np.bincount(member, weights=(disparity - mean[member]) ** 2) / counts, 0.0))
    sigma = np.minimum(spread, np.sqrt(2.0 * sequence.rig.cov_uv_px2[2, 2]))
    near = np.abs(mean) <= ROW_SIGMAS * sigma / np.sqrt(counts)
    return np.asarray((near & (counts > LEAST_PAIRS))[member])


def _off_line_px(before_px: Array, after_px: Array, T_after_before: Array, rig: StereoRig) -> Array:
    """Return how far (P,) px pixels (P, 2) in a frame are from where those before, at any depth, would come to lie."""
    focal_px, centre_px = np.array([rig.fx_px, rig.fy_px]), np.array([rig.cx_px, rig.cy_px])
    ray = np.concatenate([(before_px - centre_px) / focal_px, np.ones((len(before_px), 1))], axis=1)
    turned = (T_after_before[:, :3, :3] @ ray[:, :, None])[..., 0]
    seen = turned[:, None] + _INVERSE_DEPTHS[:, None] * T_after_before[:, None, :3, 3]
    in_front = seen[..., 2] > 0.01
    at_px = focal_px * seen[..., :2] / np.where(in_front, seen[..., 2], 1.0)[..., None] + centre_px
    distance = np.where(in_front, np.linalg.norm(at_px - after_px[:, None], axis=2), np.inf)
    return np.asarray(distance.min(axis=1))


def _median_of_each(group: IntArray, values: Array) -> Array:
    """Return the median of values (P,) over each group, in the order of the groups' numbers."""
    order = np.lexsort((values, group))
    _, first, counts = np.unique(group[order], return_index=True, return_counts=True)
    return np.asarray(values[order][first + (counts - 1) // 2])
