"""Selects the tracks that estimators are given, where their number a frame is limited; decided from the past alone.

A selected track stays until it is lost. A free place goes to the part of the view (an image cell at an octave of depth)
that has the fewest tracks, and within the part to the oldest track, because an old track tends to live on. Cvišić and
Petrović 2015, "Stereo odometry based on careful feature selection and tracking", choose by place and age as well.
"""

from itertools import pairwise

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray

# An image cell is the area that this many tracks of a full budget share, about one for each octave of depth of a scene.
_TRACKS_A_CELL = 4
# Below this disparity the depth of a track is unknown: it is selected only if no other track is left.
_LEAST_DISPARITY_PX = 1.0


def parts_of_view(uvs_px: Array, centre_px: tuple[float, float], budget: int) -> IntArray:
    """Return the part of the view (N, 3) of sightings (uL, uR, v) (N, 3) px: column, row and octave of disparity.

    The octave is negative where the depth is unknown. The image is assumed to be symmetric about its principal point.
    """
    side_px = max(2.0 * np.sqrt(abs(centre_px[0] * centre_px[1]) * _TRACKS_A_CELL / budget), 1.0)
    cells = np.floor((uvs_px[:, [0, 2]] - centre_px) / side_px)
    disparity_px = uvs_px[:, 0] - uvs_px[:, 1]
    known = disparity_px > _LEAST_DISPARITY_PX
    octave = np.where(known, np.floor(np.log2(np.where(known, disparity_px, 1.0))), -1.0)
    return np.column_stack([cells, octave]).astype(np.int64)


def within_budget(
    budget: int, frame_starts: IntArray, track_ids: IntArray, ages: IntArray, parts: IntArray
) -> BoolArray:
    """Say of each sighting (N,), sorted by frame, whether estimators are given it: at most ``budget`` a frame.

    ``frame_starts`` (K + 1,) is the first row of each frame, and N; ``ages`` (N,) count frames since the first sighting
    of the track; ``parts`` (N, 3) are those of the view.
    """
    given = np.zeros(track_ids.size, dtype=bool)
    chosen = track_ids[:0]
    for start, end in pairwise(frame_starts.tolist()):
        rows = slice(start, end)
        given[rows] = _selected(budget, np.isin(track_ids[rows], chosen), ages[rows], parts[rows])
        chosen = track_ids[rows][given[rows]]
    return given


def _selected(budget: int, kept: BoolArray, ages: IntArray, parts: IntArray) -> BoolArray:
    """Say of each sighting (n,) of one frame whether it is selected; tracks ``kept`` from the last frame always are."""
    column, row, octave = parts.T
    order = np.lexsort((-ages, ~kept, column, row, octave))
    begins = np.any(np.diff(parts[order], axis=0, prepend=-(2**31)) != 0, axis=1)
    place = np.empty(kept.size, dtype=np.int64)
    # The rank within its part: kept tracks come first, then the oldest.
    place[order] = np.arange(kept.size) - np.flatnonzero(begins)[np.cumsum(begins) - 1]
    given = np.zeros(kept.size, dtype=bool)
    given[np.lexsort((-ages, place, octave < 0, ~kept))[:budget]] = True
    return given
