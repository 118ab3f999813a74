"""Tracks that count for a share of their information, and the residuals along them that tell it.

What is an outlier stays a matter of the stated noise, so a loss has its threshold in pixels where it was. Which share,
and why: :mod:`filters.kalman.residual_correlation`.
"""

from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np

from filters.kalman.residual_correlation import FEWEST_SIGHTINGS
from toolkit.geometry import Array, se3_inverse, transform
from toolkit.models import left_only, stereo
from toolkit.models.factors import L, X
from toolkit.sequence import StereoFrame, StereoRig


class Discounted(NamedTuple):
    """A rig whose sightings count for a share of their information, and the threshold of Huber's loss beside it."""

    rig: StereoRig
    huber: float | None


def discounted(rig: StereoRig, huber: float | None, share: float) -> Discounted:
    """Return the rig and the threshold (in sigma, None for no loss) with which sightings count for a share in (0, 1].

    The loss is of residuals in sigma, which become smaller by the root of the share: so does its threshold.
    """
    if share == 1.0:
        return Discounted(rig, huber)
    threshold = None if huber is None else huber * float(np.sqrt(share))
    return Discounted(replace(rig, cov_uv_px2=rig.cov_uv_px2 / share), threshold)


def successive_residuals(frames: list[StereoFrame], values: gtsam.Values, rig: StereoRig) -> tuple[Array, Array]:
    """Return whitened residuals (n, 3) of sightings from poses X(k), and those of the same tracks a frame later.

    Tracks of few sightings are left out: their landmarks take up too much.
    """
    sizes = [len(frame.track_ids) for frame in frames]
    index = np.repeat(np.arange(len(frames)), sizes)
    track_ids = np.concatenate([frame.track_ids for frame in frames])
    uvs_px = np.concatenate([frame.uvs_px for frame in frames])
    ids, row, count = np.unique(track_ids, return_inverse=True, return_counts=True)
    points = np.array([values.atPoint3(L(i)) for i in ids.tolist()]).reshape(-1, 3)
    T_imu_world = se3_inverse(np.array([values.atPose3(X(k)).matrix() for k in range(len(frames))]))
    predicted_px, _ = stereo.images(transform(T_imu_world[index], points[row]), rig)
    whitened = left_only.whitened_residuals(uvs_px, predicted_px, rig)
    order = np.lexsort((index, row))
    before, after = order[:-1], order[1:]
    pairs = (row[before] == row[after]) & (index[after] == index[before] + 1) & (count[row[before]] >= FEWEST_SIGHTINGS)
    return whitened[before[pairs]], whitened[after[pairs]]
