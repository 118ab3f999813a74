"""The tracks a window has seen and not yet used, one column a clone."""

import numpy as np

from filters.kalman.multiview import Sightings
from toolkit.geometry import BoolArray, IntArray
from toolkit.sequence import StereoFrame


class WindowTracks:
    """Sightings of A tracks from the W poses of the window, grown by a frame and cut by a clone at a time."""

    def __init__(self) -> None:
        self._ids: IntArray = np.empty(0, dtype=np.int64)
        self._uvs_px = np.empty((0, 0, 3))
        self._seen = np.empty((0, 0), dtype=bool)

    def add_frame(self, frame: StereoFrame) -> None:
        """Append the frame's sightings as a new column; ids unknown so far start new tracks."""
        new = np.setdiff1d(frame.track_ids, self._ids, assume_unique=True)
        ids = np.concatenate([self._ids, new])
        count, window = len(ids), self._seen.shape[1] + 1
        uvs_px, seen = np.zeros((count, window, 3)), np.zeros((count, window), dtype=bool)
        uvs_px[: len(self._ids), :-1], seen[: len(self._ids), :-1] = self._uvs_px, self._seen
        order = np.argsort(ids)
        rows = order[np.searchsorted(ids, frame.track_ids, sorter=order)]
        uvs_px[rows, -1], seen[rows, -1] = frame.uvs_px, True
        self._ids, self._uvs_px, self._seen = ids, uvs_px, seen

    def drop_column(self, column: int) -> None:
        """Forget what was seen from one pose."""
        self._uvs_px = np.delete(self._uvs_px, column, axis=1)
        self._seen = np.delete(self._seen, column, axis=1)
        self._keep(np.asarray(self._seen.any(axis=1)))

    def ended(self) -> BoolArray:
        """Say which tracks (A,) the newest pose does not see."""
        return np.asarray(~self._seen[:, -1])

    def spanning(self) -> BoolArray:
        """Say which tracks (A,) the oldest and the newest pose see."""
        return np.asarray(self._seen[:, 0] & self._seen[:, -1])

    def take(self, rows: BoolArray) -> Sightings:
        """Return those tracks (A,) and forget their sightings; a track that lives on starts anew."""
        taken = Sightings(self._ids[rows], self._uvs_px[rows], self._seen[rows])
        self._keep(np.logical_not(rows))
        return taken

    def _keep(self, rows: BoolArray) -> None:
        self._ids, self._uvs_px, self._seen = self._ids[rows], self._uvs_px[rows], self._seen[rows]
