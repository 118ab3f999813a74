"""Faults of the course recordings, planted in the simulated drive, where the truth shows what they do."""

from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from toolkit.geometry import Array, se3
from toolkit.motion_samples import TwistSamples
from toolkit.sequence import Observations, Sequence
from toolkit.simulation import SCENARIOS, simulate

STALE_SHARE = 0.15
GYRO_BIAS_RADPS = -0.01


def drive(duration_s: float, seed: int) -> Sequence:
    """Return the simulated drive without its prior, so that estimators start as on a course recording."""
    return replace(simulate(replace(SCENARIOS["drive"], duration_s=duration_s), seed), prior=None)


def like_a_course_recording(duration_s: float, seed: int) -> Sequence:
    """Return the simulated drive with all three faults."""
    return stale_frames(gyro_bias(mixed_axes(drive(duration_s, seed))))


def mixed_axes(sequence: Sequence) -> Sequence:
    """Write the camera's place in axes forward, right, down; the twists stay forward, left, up."""
    T_imu_cam = se3(np.diag([1.0, -1.0, -1.0]), np.zeros(3)) @ sequence.rig.T_imu_cam
    return replace(sequence, rig=replace(sequence.rig, T_imu_cam=T_imu_cam))


def gyro_bias(sequence: Sequence) -> Sequence:
    """Add a constant to the angular velocity about every axis."""
    motion = sequence.motion
    assert isinstance(motion, TwistSamples)
    return replace(sequence, motion=replace(motion, w_radps=motion.w_radps + GYRO_BIAS_RADPS))


def stale_frames(sequence: Sequence, seed: int = 0) -> Sequence:
    """Let every track of some frames keep its pixels, and go on with another point: the one that is there now."""
    seen, uv_px, ids = sequence.observations, sequence.observations.uv_px.copy(), sequence.observations.track_id.copy()
    stale = np.random.default_rng(seed).random(sequence.frame_count) < STALE_SHARE
    first_row = np.searchsorted(seen.frame, np.arange(sequence.frame_count + 1))
    followed_by: dict[int, int] = {}  # point -> track
    before = slice(0, 0)
    for k in range(sequence.frame_count):
        rows = np.arange(first_row[k], first_row[k + 1])
        ids[rows] = [followed_by.get(point, point) for point in seen.track_id[rows].tolist()]
        if stale[k]:
            tracks, was, now = np.intersect1d(ids[before], ids[rows], return_indices=True)
            taken = rows[now[_nearest(uv_px[before][was], uv_px[rows[now]])]]
            uv_px[taken], ids[taken] = uv_px[before][was], tracks
            followed_by |= dict(zip(seen.track_id[taken].tolist(), tracks.tolist(), strict=True))
        before = slice(first_row[k], first_row[k + 1])
    return replace(sequence, observations=Observations.sorted(seen.frame, ids, uv_px))


def _nearest(before_px: Array, now_px: Array) -> Array:
    """Return for each sighting before (n, 3) its own one of those now (n, 3), together the nearest."""
    return linear_sum_assignment(np.linalg.norm(before_px[:, None] - now_px[None], axis=2))[1]
