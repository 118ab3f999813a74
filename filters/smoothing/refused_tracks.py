"""Tracks whose landmark is wrong: more of their sightings are refused than were taken, and these agree with each other.

A landmark that begins far too far away may refuse all that its track shows for as long as it lives.
"""

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, BoolArray
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DISPARITY_PX, chi2_bound, mahalanobis_squared
from toolkit.sequence import StereoFrame, StereoRig

# One mismatch is refused, and another by chance; three in succession that see the same point elsewhere are not chance.
FEWEST_REFUSED = 3


class _Refused(NamedTuple):
    """Where the first of some refused sightings was (3,) m in the world, and how many there are."""

    point: Array
    sightings: int


class RefusedTracks:
    """Counts, track by track, successive sightings that are refused and agree."""

    def __init__(self, rig: StereoRig, gate_probability: float | None) -> None:
        self._rig, self._bound = rig, chi2_bound(3, gate_probability)
        self._refused: dict[int, _Refused] = {}
        self._taken = Counter[int]()

    def forget(self, track_ids: Iterable[int]) -> None:
        """Begin to count anew for tracks whose landmarks are gone."""
        for i in track_ids:
            self._taken.pop(i, None)

    def contradicted(self, frame: StereoFrame, refused: BoolArray, T_world_imu: Array) -> set[int]:
        """Take in a frame, of which some sightings (N,) were refused, and its pose; return the tracks to begin anew."""
        self._taken.update(frame.track_ids[~refused].tolist())
        seen = frame.select(refused & (stereo.disparity_px(frame.uvs_px) > LEAST_DISPARITY_PX))
        points = stereo.triangulate_world(seen.uvs_px, T_world_imu, self._rig)
        before = [self._refused.get(i) for i in seen.track_ids.tolist()]
        expected = np.array([point if one is None else one.point for one, point in zip(before, points, strict=True)])
        off_px = seen.uvs_px - stereo.predict(expected.reshape(-1, 3), T_world_imu, self._rig).uv_px
        # Both sightings err.
        covs_px2 = np.broadcast_to(2.0 * self._rig.cov_uv_px2, (len(points), 3, 3))
        agree = mahalanobis_squared(off_px, covs_px2) <= self._bound
        found = zip(seen.track_ids.tolist(), before, points, agree.tolist(), strict=True)
        self._refused = {
            i: one._replace(sightings=one.sightings + 1) if one is not None and agrees else _Refused(point, 1)
            for i, one, point, agrees in found
        }
        least = ((i, max(FEWEST_REFUSED, self._taken[i] + 1)) for i in self._refused)
        return {i for i, sightings in least if self._refused[i].sightings >= sightings}
