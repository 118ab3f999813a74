"""What a sighting makes of the next one of its track by the camera's own motion, and how far that one is off."""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.intervals import moved_by
from toolkit.geometry import Array, IntArray, se3_inverse, transform
from toolkit.models.camera_motion import CameraMotion, triangulation_jacobian, usable_pairs
from toolkit.models.gating import LEAST_DEPTH_M
from toolkit.models.stereo import project, projection_jacobian, triangulate
from toolkit.sequence import Sequence


class OneStep(NamedTuple):
    """P neighbouring sightings of a track, in time: their rows (P,), the second's residual (P, 3) px, and its noise.

    A point triangulated from the first, whose noise is R, and projected into the second's frame misses the sighting
    there by ``cov_px2`` (P, 3, 3) = J R J^T + R if both err by themselves. ``jacobian`` (P, 3, 3) is J, how far the
    second's prediction moves with the first.
    """

    before: IntArray
    after: IntArray
    residual_px: Array
    cov_px2: Array
    jacobian: Array


def one_step(sequence: Sequence, camera: CameraMotion) -> OneStep:
    """Return the residuals over the intervals in which the camera's own motion is known."""
    pairs, uv_px, rig = usable_pairs(sequence), sequence.observations.uv_px, sequence.rig
    pairs = pairs.select(camera.known[pairs.interval])
    T_after_before = se3_inverse(moved_by(camera, sequence))[pairs.interval]
    before = triangulate(uv_px[pairs.before], rig)
    after = transform(T_after_before, before)
    after[:, 2] = np.maximum(after[:, 2], LEAST_DEPTH_M)
    d_point_d_uv = np.ascontiguousarray(np.moveaxis(triangulation_jacobian(before.T, rig), -1, 0))
    d_after_d_before = T_after_before[:, :3, :3] @ d_point_d_uv
    jacobian = projection_jacobian(after, rig) @ d_after_d_before
    cov_px2 = jacobian @ rig.cov_uv_px2 @ jacobian.swapaxes(1, 2) + rig.cov_uv_px2
    return OneStep(pairs.before, pairs.after, uv_px[pairs.after] - project(after, rig), cov_px2, jacobian)
