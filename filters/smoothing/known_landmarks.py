"""The landmarks of an incremental smoother, and how well their sightings so far determine them.

The position of a landmark seen once, far away, in a later nearby image is uncertain by many pixels; that of one seen
often, by a fraction of a pixel. Poses are taken as exact, because a landmark shares the error of the poses that saw it.
"""

from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np

from toolkit.geometry import Array, BoolArray
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo


class KnownLandmarks:
    """Points (3,) m in the world by track id, and for each the information (3, 3) 1/m^2 of its sightings."""

    def __init__(self, rig: StereoRig) -> None:
        self._rig = rig
        self._points: dict[int, Array] = {}
        self._information: dict[int, Array] = {}
        self._sightings = Counter[int]()

    def __contains__(self, track_id: int) -> bool:
        """Say whether a track has a landmark."""
        return track_id in self._points

    @property
    def points(self) -> Mapping[int, Array]:
        """Return all points by track id."""
        return self._points

    def among(self, track_ids: Iterable[int]) -> BoolArray:
        """Say which of the tracks (N,) have a landmark."""
        return np.array([i in self._points for i in track_ids], dtype=bool)

    def see(self, frame: StereoFrame, placed: Mapping[int, Array], T_world_imu: Array) -> None:
        """Add the sightings of a frame from a pose (4, 4), of known landmarks and of those ``placed`` here."""
        if not frame.track_ids.size:
            return
        ids = frame.track_ids.tolist()
        self._sightings.update(ids)
        points = [placed[i] if i in placed else self._points[i] for i in ids]
        expected = stereo.predict(np.array(points), T_world_imu, self._rig)
        H = stereo.whitener(frame.uvs_px, self._rig) @ stereo.seen_rows(frame.uvs_px, expected.d_uv_d_point)
        self._points.update(zip(ids, points, strict=True))
        information = zip(ids, np.swapaxes(H, 1, 2) @ H, strict=True)
        self._information.update({i: self._information.get(i, 0.0) + one for i, one in information})

    def move(self, points: Mapping[int, Array]) -> None:
        """Update the points of landmarks."""
        self._points.update({i: point for i, point in points.items() if i in self._points})

    def keep(self, points: Mapping[int, Array]) -> None:
        """Update the points of landmarks, and drop all others."""
        self.forget([i for i in self._points if i not in points])
        self.move(points)

    def forget(self, track_ids: Iterable[int]) -> None:
        """Drop landmarks; if seen again, they are started again."""
        for i in track_ids:
            self._points.pop(i, None)
            self._information.pop(i, None)
            self._sightings.pop(i, None)

    def confirmed(self, track_ids: Iterable[int]) -> BoolArray:
        """Say which of the tracks (N,) have a landmark that more than one sighting agrees on."""
        return np.array([self._sightings[i] > 1 for i in track_ids], dtype=bool)

    def of(self, track_ids: Iterable[int]) -> tuple[Array, Array]:
        """Return the points (n, 3) m of some known tracks and the covariances (n, 3, 3) m^2 of their errors."""
        ids = list(track_ids)
        points = np.array([self._points[i] for i in ids]).reshape(-1, 3)
        return points, np.linalg.inv(np.array([self._information[i] for i in ids]).reshape(-1, 3, 3))
