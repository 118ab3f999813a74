"""The test of tracks as ``track_gate`` wants it, by the compiled kernel; imported only where that is to run."""

from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import numpy as np

from filters.kalman import multiview, track_gate, triangulation
from filters.kalman.kernels import track_gate as kernel
from filters.kalman.multiview import TrackSightings
from filters.kalman.track_gate import TestedTracks, Window
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models import correlated_noise
from toolkit.models.gating import LEAST_DEPTH_M, LEAST_DISPARITY_PX, MISMATCHED_TRACK_FACTOR
from toolkit.sequence import StereoRig
from toolkit.track_noise import CHANNELS

COMPILED = kernel.COMPILED
_RULES = np.array(
    [
        triangulation.ITERATIONS,
        triangulation.FIRST_DAMPING,
        triangulation.RELATIVE_DECREASE,
        triangulation.ROUNDING,
        LEAST_DISPARITY_PX,
        LEAST_DEPTH_M,
        multiview.REFINEMENTS,
        MISMATCHED_TRACK_FACTOR,
    ]
)


def tested(sightings: TrackSightings, window: Window, rig: StereoRig, bounds: Array) -> TestedTracks:
    """Test tracks against a window: ``track_gate.tested``, compiled where no right image is missing."""
    if sightings.left_only.any():
        return track_gate.tested(sightings, window, rig, bounds)
    points, reliable, nis, worst, ends, H, residuals = kernel.test_tracks(
        given((sightings.uvs_px, sightings.seen, sightings.ages)), given(window), camera_of(rig), _RULES, bounds
    )
    rows = ends[reliable]
    rows[1:] -= rows[:-1].copy()
    count = int(rows.sum())
    return TestedTracks(
        sightings.select(reliable),
        points[:-1][reliable],
        nis[reliable],
        worst[reliable],
        H[:count],
        residuals[:count],
        np.repeat(np.arange(len(rows)), rows),
    )


def given(arrays: Iterable[Array | BoolArray | IntArray]) -> tuple[Any, ...]:
    """Return arrays as kernels take them."""
    return tuple(np.ascontiguousarray(array) for array in arrays)


@lru_cache(maxsize=4)
def camera_of(rig: StereoRig) -> tuple[Array, ...]:
    """Return a rig as the kernel takes it."""
    intrinsics = np.array([rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px, rig.baseline_m])
    none = np.empty((0, 3))
    variances, channels = none, none
    if rig.track_noise is not None:
        noise = rig.track_noise
        white = np.maximum(noise.white_px, correlated_noise.LEAST_WHITE_PX)
        variances, channels = np.square([white, noise.walk_px, noise.offset_px]), np.array(CHANNELS)
    return intrinsics, np.array(rig.T_imu_cam[None]), np.array(rig.whitener, order="C"), variances, channels
