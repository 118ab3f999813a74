"""The map of the decoupled filters: one small Gaussian per tracked landmark, and an archive of those that were lost."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from toolkit.arrays import is_among
from toolkit.estimate import Landmarks
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DISPARITY_PX


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """The landmarks in the state: ids (M,) ascending, points in the world (M, 3) m, covariances (M, 3, 3)."""

    track_ids: IntArray
    points: Array
    covs: Array

    @classmethod
    def empty(cls) -> Self:
        """Return a map without landmarks."""
        return cls(np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))

    def __len__(self) -> int:
        return self.track_ids.size

    def match(self, track_ids: IntArray) -> tuple[IntArray, IntArray]:
        """Return the rows of the map and of the ids (N,) that match."""
        if not len(self) or not track_ids.size:
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        slots = np.minimum(np.searchsorted(self.track_ids, track_ids), len(self) - 1)
        rows = np.flatnonzero(self.track_ids[slots] == track_ids)
        return slots[rows], rows

    def select(self, slots: IntArray | BoolArray) -> "LandmarkMap":
        """Return the landmarks of some rows (m,), or of a mask (M,); the ids must stay ascending."""
        return LandmarkMap(self.track_ids[slots], self.points[slots], self.covs[slots])

    def merged(self, other: "LandmarkMap") -> "LandmarkMap":
        """Return the union of both maps, which must not share an id."""
        ids = np.concatenate([self.track_ids, other.track_ids])
        order = np.argsort(ids)
        points, covs = np.concatenate([self.points, other.points]), np.concatenate([self.covs, other.covs])
        return LandmarkMap(ids[order], points[order], covs[order])

    def corrected(self, rows: BoolArray, points: Array, covs: Array) -> "LandmarkMap":
        """Return the map with new values (M, 3), (M, 3, 3) where the mask (M,) is True."""
        return replace(
            self,
            points=np.where(rows[:, None], points, self.points),
            covs=np.where(rows[:, None, None], covs, self.covs),
        )


def started(uvs_px: Array, T_world_imu: Array, rig: StereoRig) -> tuple[Array, Array]:
    """Return N landmarks triangulated from a pose (4, 4): points (N, 3), covariances (N, 3, 3) (Kang, eqs. 3-5).

    The covariance is that of the measurements (N, 3) px by the rig's weight of tracks, propagated through the
    triangulation.
    """
    points_cam = stereo.triangulate(uvs_px, rig)
    T_world_cam = T_world_imu @ rig.T_imu_cam
    d_point_d_uv = T_world_cam[:3, :3] @ np.linalg.inv(stereo.projection_jacobian(points_cam, rig))
    points = points_cam @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    cov_px2 = rig.cov_uv_px2 / rig.track_weight
    return points, d_point_d_uv @ cov_px2 @ np.swapaxes(d_point_d_uv, 1, 2)


def first_sighting(frame: StereoFrame, rows: IntArray, T_world_imu: Array, rig: StereoRig) -> LandmarkMap:
    """Start the landmarks of rows (m,) of a frame from its pose (4, 4).

    Tracks whose disparity is too small are left for a later frame.
    """
    uvs_px = frame.uvs_px[rows]
    near = stereo.disparity_px(uvs_px) > LEAST_DISPARITY_PX
    return LandmarkMap(frame.track_ids[rows][near], *started(uvs_px[near], T_world_imu, rig))


class TrackedMap:
    """The landmarks in view, updated frame by frame: lost ones move from the state to an archive, new ones start."""

    def __init__(self, rig: StereoRig) -> None:
        self._rig = rig
        self._in_view = LandmarkMap.empty()
        self._left: list[LandmarkMap] = []

    def seen_again(self, frame: StereoFrame) -> tuple[LandmarkMap, Array]:
        """Return the landmarks that the frame sees again and their measurements (N, 3) px; archive the others."""
        slots, rows = self._in_view.match(frame.track_ids)
        lost = np.ones(len(self._in_view), dtype=bool)
        lost[slots] = False
        self._left.append(self._in_view.select(lost))
        return self._in_view.select(slots), frame.uvs_px[rows]

    def keep(self, seen: LandmarkMap, frame: StereoFrame, T_world_imu: Array) -> None:
        """Keep the updated landmarks seen again; start the frame's other tracks from its pose (4, 4)."""
        new = np.flatnonzero(~is_among(frame.track_ids, seen.track_ids))
        self._in_view = seen.merged(first_sighting(frame, new, T_world_imu, self._rig))

    def landmarks(self) -> Landmarks:
        """Return the last estimate of every landmark of the run."""
        parts = [*self._left, self._in_view]
        ids = np.concatenate([p.track_ids for p in parts])
        points, covs = np.concatenate([p.points for p in parts]), np.concatenate([p.covs for p in parts])
        last = ids.size - 1 - np.unique(ids[::-1], return_index=True)[1]
        return Landmarks(ids[last], points[last], covs[last])
