"""Which landmarks a window has: ids beside its points, new tracks started, those without sightings let go."""

from dataclasses import dataclass, replace

import numpy as np

from filters.smoothing.structureless import Sightings, seen_from
from filters.smoothing.window import Window
from toolkit.geometry import Array, IntArray
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DISPARITY_PX
from toolkit.sequence import StereoFrame, StereoRig


@dataclass(frozen=True, eq=False)
class Tracked:
    """A window and the track ids (M,) of its points."""

    window: Window
    track_ids: IntArray

    def points_by_id(self) -> dict[int, Array]:
        """Return the point (3,) m of every track."""
        return dict(zip(self.track_ids.tolist(), self.window.points, strict=True))

    def seeing(self, frame: StereoFrame, T_world_imu: Array, rig: StereoRig) -> "Tracked":
        """Add what the newest state sees: tracks known go on, new ones near enough start where stereo puts them."""
        known = np.isin(frame.track_ids, self.track_ids)
        new = frame.select(~known & (stereo.disparity_px(frame.uvs_px) > LEAST_DISPARITY_PX))
        used = frame.select(known | np.isin(frame.track_ids, new.track_ids))
        ids = np.concatenate([self.track_ids, new.track_ids])
        points = np.concatenate([self.window.points, stereo.triangulate_world(new.uvs_px, T_world_imu, rig)])
        order = np.argsort(ids)
        rows, seen = order[np.searchsorted(ids, used.track_ids, sorter=order)], self.window.sightings
        newest = np.full(rows.size, len(self.window.keys) - 1)
        sightings = Sightings(
            np.concatenate([seen.pose, newest]),
            np.concatenate([seen.point, rows]),
            np.concatenate([seen.uv_px, used.uvs_px]),
        )
        return Tracked(replace(self.window, points=points, sightings=sightings), ids)

    def compacted(self) -> "Tracked":
        """Let the points go that nothing sees any more."""
        seen = self.window.sightings
        kept, rows = np.unique(seen.point, return_inverse=True)
        sightings = Sightings(seen.pose, rows.astype(np.int64), seen.uv_px)
        return Tracked(replace(self.window, points=self.window.points[kept], sightings=sightings), self.track_ids[kept])

    def in_front(self, rig: StereoRig) -> tuple["Tracked", IntArray]:
        """Let the points go that are behind a camera that saw them; return the rest and the ids of those that went."""
        seen = self.window.sightings
        in_front = seen_from(self.window.poses, self.window.points, seen, rig).in_front
        behind = np.unique(seen.point[~in_front])
        if not behind.size:
            return self, self.track_ids[behind]
        left = seen.of_points(np.setdiff1d(seen.point, behind))
        return Tracked(replace(self.window, sightings=left), self.track_ids).compacted(), self.track_ids[behind]
