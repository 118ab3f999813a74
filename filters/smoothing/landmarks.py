"""Which tracks a smoother takes in, and the sightings it builds factors of."""

import numpy as np

from filters.kalman.landmarks import LEAST_DISPARITY_PX
from toolkit.estimate import Landmarks
from toolkit.geometry import BoolArray, IntArray
from toolkit.models import stereo
from toolkit.sequence import StereoFrame

# A landmark seen only once ties no poses together: it only slows the solve.
FEWEST_SIGHTINGS = 2


def worth_smoothing(frames: list[StereoFrame], known: Landmarks) -> IntArray:
    """Return the ids (M,) of the known landmarks seen often and near enough."""
    ids = np.concatenate([f.track_ids for f in frames])
    disparities_px = np.concatenate([stereo.disparity_px(f.uvs_px) for f in frames])
    unique_ids, row_of, counts = np.unique(ids, return_inverse=True, return_counts=True)
    largest_px = np.full(unique_ids.size, -np.inf)
    np.maximum.at(largest_px, row_of, disparities_px)
    good = (counts >= FEWEST_SIGHTINGS) & (largest_px >= LEAST_DISPARITY_PX)
    return np.intersect1d(unique_ids[good], known.track_ids, assume_unique=True)


def restricted(frame: StereoFrame, rows: BoolArray) -> StereoFrame:
    """Return the frame with the given sightings only."""
    return StereoFrame(frame.t_ns, frame.track_ids[rows], frame.uvs_px[rows])
