"""Which parts of the filters run compiled, and how that is chosen: NumPy defines each part, a kernel computes the same.

A filter calls these functions when it is built, each with the compilation its run asked for
(:class:`toolkit.compilation.Compilation`). A function returns the NumPy definition, or a function of the same arguments
that calls a kernel. Kernels are imported only when they are used, because only they import numba.
"""

from collections.abc import Iterable
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np

from filters.kalman import track_gate, tracks_in_view, triangulation
from filters.kalman.frame_gate import FrameGate
from filters.kalman.joint import JointBelief, times_root, transposed_root_times, without_products
from filters.kalman.multiview import TrackSightings
from filters.kalman.track_gate import TestedTracks, TrackTest, WindowPoses
from filters.kalman.tracks_in_view import FollowedTracks, Information, RootedWindow
from toolkit.compilation import Compilation
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.measurements import StereoRig
from toolkit.models.gating import (
    FEWEST_SIGHTINGS,
    LEAST_DEPTH_M,
    LEAST_DISPARITY_PX,
    MISMATCHED_TRACK_FACTOR,
    huber_threshold,
)

_GATE_RULES = np.array(
    [
        triangulation.ITERATIONS,
        triangulation.FIRST_DAMPING,
        triangulation.RELATIVE_DECREASE,
        triangulation.ROUNDING,
        LEAST_DISPARITY_PX,
        LEAST_DEPTH_M,
        MISMATCHED_TRACK_FACTOR,
    ]
)
_KERNELS = "filters.kalman.kernels"


def _kernel(compilation: Compilation, name: str) -> ModuleType | None:
    return compilation.module(f"{_KERNELS}.{name}")


def share_windowed(compilation: Compilation) -> None:
    """Let processes that start together share the compilation of the windowed filters' kernels, the longest first."""
    compilation.share(f"{_KERNELS}.{name}" for name in ["track_gate", "tracks_in_view"])


def track_test(compilation: Compilation) -> TrackTest:
    """Return the function that tests tracks against a window: :func:`filters.kalman.track_gate.tested`."""
    kernel = _kernel(compilation, "track_gate")
    if kernel is None:
        return track_gate.tested

    def tested(sightings: TrackSightings, window: WindowPoses, rig: StereoRig, bounds: Array) -> TestedTracks:
        """Test tracks as the definition does; where right images are missing, the definition itself is called."""
        if sightings.left_only.any():
            return track_gate.tested(sightings, window, rig, bounds)
        points, reliable, nis, dof, worst, H, residuals, owners = kernel.test_tracks(
            _as_kernel_arrays((sightings.uvs_px, sightings.seen)),
            _as_kernel_arrays(window),
            _camera(rig),
            _GATE_RULES,
            bounds,
        )
        points = points[:-1]
        if not reliable.all():
            sightings, points = sightings.select(reliable), points[reliable]
            nis, dof, worst = nis[reliable], dof[reliable], worst[reliable]
        return TestedTracks(sightings, points, nis, dof, worst, H, residuals, owners)

    return tested


def steps_in_view(compilation: Compilation) -> tracks_in_view.Steps:
    """Return the functions of ``tracks_in_view`` that find the landmarks of tracks and the tracks' information."""
    kernel = _kernel(compilation, "tracks_in_view")
    if kernel is None:
        return tracks_in_view.NUMPY

    def followed(
        known: FollowedTracks, sightings: TrackSightings, joint: JointBelief, rig: StereoRig
    ) -> FollowedTracks:
        """Return tracks with their landmarks as the definition does, which is called where right images are missing."""
        if sightings.left_only.any():
            return tracks_in_view.followed(known, sightings, joint, rig)
        before = _as_kernel_arrays((known.sightings.track_ids, known.clone_frames, known.points, known.weights))
        now = _as_kernel_arrays((sightings.track_ids, joint.clone_frames, sightings.uvs_px, sightings.seen))
        found, points, weights = kernel.follow(
            before, now, np.ascontiguousarray(joint.clones), _camera(rig), FEWEST_SIGHTINGS, LEAST_DISPARITY_PX
        )
        return FollowedTracks(sightings, joint.clone_frames, points, weights).select(found)

    def information(tracks: FollowedTracks, window: RootedWindow, rig: StereoRig, gate: FrameGate) -> Information:
        """Gate the newest sightings as the definition does; only the bounds of ``gate`` are used, it counts nothing."""
        counted = tracks.counted
        if counted.left_only.any():
            return tracks_in_view.information(tracks, window, rig, gate)
        arrays = _as_kernel_arrays((counted.uvs_px, counted.seen, tracks.weights, tracks.points))
        poses, root = _as_kernel_arrays((window.poses, window.poses_at)), window.root
        threshold = np.inf if gate.huber is None else float(huber_threshold(3, gate.huber))
        rules = np.array([LEAST_DEPTH_M, float(gate.bound(3)), threshold])
        normals = kernel.normals_of_tracks(arrays, poses, _camera(rig), rules)
        to_points, newest, vector = normals[3], normals[5], normals[7]
        eliminated = times_root(to_points, root)
        by_root = (root, newest @ root[-newest.shape[1] :], eliminated)
        points, weights, in_front, taken, of_poses = kernel.information_with_newest(normals, by_root, rules)
        matrix = without_products(transposed_root_times(root, of_poses), eliminated)
        return Information(points, weights, in_front, matrix, root.T @ vector - eliminated.T @ taken)

    return tracks_in_view.Steps(followed, information)


def _as_kernel_arrays(arrays: Iterable[Array | BoolArray | IntArray]) -> tuple[Any, ...]:
    """Return arrays in the form kernels take."""
    return tuple(np.ascontiguousarray(array) for array in arrays)


def _intrinsics(rig: StereoRig) -> tuple[Array, Array]:
    return np.array([rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px, rig.baseline_m]), np.array(rig.T_imu_cam[None])


@lru_cache(maxsize=4)
def _camera(rig: StereoRig) -> tuple[Array, ...]:
    """Return a rig in the form that the kernels of the windowed filters take."""
    return *_intrinsics(rig), np.array(rig.whitener, order="C")
