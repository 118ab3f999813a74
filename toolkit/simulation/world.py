"""Landmarks, their visibility from a stereo pair, and the tracks a tracker makes of them, with realistic lengths."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse
from toolkit.measurements import StereoRig
from toolkit.models.stereo import project

# Poses projected at a time: bounds the memory of the (poses, 3, landmarks) intermediate.
_POSES_AT_ONCE = 64


@dataclass(frozen=True)
class CameraLimits:
    """The limits of a stereo pair and of its tracker.

    A landmark is seen where its true projection lies ``border_px`` or more inside both images and its depth inside
    ``depth_m``; at most ``max_tracks`` are followed at a time, and a track that could go on ends at a frame with
    probability ``loss_per_frame``. Coordinates are rounded to steps of ``step_px`` (0: not rounded); a share
    ``outlier_rate`` of the sightings is displaced by a length inside ``outlier_px``. The noise of the coordinates is
    the rig's ``cov_uv_px2``.
    """

    rate_hz: float
    size_px: tuple[int, int]
    depth_m: tuple[float, float]
    max_tracks: int
    loss_per_frame: float
    border_px: float = 6.0
    step_px: float = 2.0**-8
    outlier_rate: float = 0.0
    outlier_px: tuple[float, float] = (5.0, 30.0)


def room(lower_m: Array, upper_m: Array, count: int, rng: np.random.Generator) -> Array:
    """Return landmarks (count, 3) on the six faces of a box, with the same density on each face.

    They stand up to 0.3 m in front of their wall, as shelves and posters do, so that no face is a plane.
    """
    size = upper_m - lower_m
    normal = np.repeat([0, 1, 2], 2)
    share = np.prod(size) / size[normal]
    face = rng.choice(6, size=count, p=share / share.sum())
    points = lower_m + rng.uniform(size=(count, 3)) * size
    depth_m = rng.uniform(0.0, 0.3, size=count)
    rows, axis, far = np.arange(count), normal[face], face % 2 == 1
    points[rows, axis] = np.where(far, upper_m[axis] - depth_m, lower_m[axis] + depth_m)
    return points


def roadside(path: Array, per_pose: int, rng: np.random.Generator) -> Array:
    """Return landmarks (M, 3) left and right of a road given by poses (N, 4, 4) of the car, x forward, z up.

    They lie 3.5 to 22 m to a side and from the road's surface to 6 m above the poses, more of them low and
    near; none stands within 3 m of the path, where the car would drive through it.
    """
    count = len(path) * per_pose
    share = rng.uniform(size=(count, 4))
    side = np.where(share[:, 0] < 0.5, -1.0, 1.0)
    offset_m = np.stack(
        [4.0 * share[:, 1] - 2.0, side * (3.5 + 18.5 * share[:, 2] ** 1.5), 7.0 * share[:, 3] ** 1.3 - 1.0], axis=-1
    )
    pose = np.repeat(path, per_pose, axis=0)
    points = (pose[:, :3, :3] @ offset_m[:, :, None])[:, :, 0] + pose[:, :3, 3]
    return points[~_near_path(points, path, 3.0)]


def _near_path(points: Array, path: Array, radius_m: float) -> BoolArray:
    """Say which points (M, 3) are within a radius of the path (N, 4, 4), seen from above.

    The nearest pose is looked up first, because all distances between an hour's path and its points would take 25 GB.
    """
    along = path[:, :2, 3]
    _, nearest = cKDTree(along).query(points[:, :2])
    squared = ((points[:, :2] - along[nearest]) ** 2).sum(axis=-1)
    return np.asarray(squared < radius_m**2)


def visibility(points: Array, T_world_imu: Array, rig: StereoRig, camera: CameraLimits) -> BoolArray:
    """Say for each of K poses (K, 4, 4) and M landmarks (M, 3) whether the pair sees it, (K, M)."""
    T_cam_world = se3_inverse(T_world_imu @ rig.T_imu_cam)
    seen = np.empty((len(T_world_imu), len(points)), dtype=bool)
    for begin in range(0, len(T_world_imu), _POSES_AT_ONCE):
        T = T_cam_world[begin : begin + _POSES_AT_ONCE]
        points_cam = np.swapaxes(T[:, :3, :3] @ points.T + T[:, :3, 3:], 1, 2)
        seen[begin : begin + _POSES_AT_ONCE] = _in_view(points_cam, rig, camera)
    return seen


def _in_view(points_cam: Array, rig: StereoRig, camera: CameraLimits) -> BoolArray:
    depth = points_cam[..., 2]
    in_depth = (depth >= camera.depth_m[0]) & (depth <= camera.depth_m[1])
    result = np.zeros(depth.shape, dtype=bool)
    u_left, u_right, v = project(points_cam[in_depth], rig).T
    right, bottom = camera.size_px[0] - 1 - camera.border_px, camera.size_px[1] - 1 - camera.border_px
    # With a positive baseline uR < uL, so two of the four horizontal limits imply the others.
    result[in_depth] = (u_right >= camera.border_px) & (u_left <= right) & (v >= camera.border_px) & (v <= bottom)
    return result


@dataclass(frozen=True, eq=False)
class Tracks:
    """The landmark of each sighting: frame (N,), track id (N,) and landmark (N,), by frame then track."""

    frame: IntArray
    track_id: IntArray
    landmark: IntArray


def follow(seen: BoolArray, camera: CameraLimits, rng: np.random.Generator) -> Tracks:
    """Follow landmarks through frames as a KLT tracker does, given what is visible (K, M).

    A track ends where its landmark leaves the view or by chance; free places are filled at random from the
    visible landmarks nobody follows. A track id never comes back: a landmark seen again is a new track.
    """
    landmark, track_id = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    next_id, rows = 0, []
    for k, visible in enumerate(seen):
        kept = visible[landmark] & (rng.uniform(size=landmark.size) >= camera.loss_per_frame)
        free = visible.copy()
        free[landmark] = False  # also if its track has just been lost: it is not found again at once
        landmark, track_id = landmark[kept], track_id[kept]
        candidates = np.flatnonzero(free)
        wanted = min(max(camera.max_tracks - landmark.size, 0), candidates.size)
        found = rng.choice(candidates, size=wanted, replace=False)
        landmark = np.concatenate([landmark, found])
        track_id = np.concatenate([track_id, np.arange(next_id, next_id + wanted)])
        next_id += wanted
        rows.append(np.stack([np.full(landmark.size, k), track_id, landmark]))
    frame, track_id, landmark = np.concatenate(rows, axis=1) if rows else np.empty((3, 0), dtype=np.int64)
    return Tracks(frame, track_id, landmark)
