"""Faults of real trackers that last over a track, unlike the noise of single sightings.

Injectors as in :mod:`toolkit.simulation.faults`, ``fault(sequence, dose, seed) -> Sequence``; faults of single
sightings, clocks (``camera_clock``) and the scale of samples (``linear_unit``, ``angular_unit``) are there.
"""

from dataclasses import replace

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array
from toolkit.models.stereo import CHANNELS, project, triangulate
from toolkit.sequence import Sequence
from toolkit.simulation.sensors import with_slips, with_track_noise
from toolkit.simulation.track_noise import TrackNoise

_NONE = np.zeros(3)
# Points whose tracks begin within this many seconds are on one vehicle.
_ONE_VEHICLE_S = 2.0


def track_walk(sequence: Sequence, dose: float = 0.13, seed: int = 0) -> Sequence:
    """Let every track wander by the dose (px per root frame) in mean column, disparity and row: a tracker's drift."""
    return _with_track_noise(sequence, TrackNoise(_NONE, np.full(3, dose), _NONE), seed)


def match_offset(sequence: Sequence, dose: float = 0.7, seed: int = 0) -> Sequence:
    """Give every track a constant disparity error, of the dose (px) as sigma: matched once, at its start, and wrong."""
    return _with_track_noise(sequence, TrackNoise(_NONE, _NONE, np.array([0.0, dose, 0.0])), seed)


def disparity_scale(sequence: Sequence, dose: float = 0.015, seed: int = 0) -> Sequence:
    """Make all disparities larger by a share: a wrong baseline or focal length, with which vision falls short."""
    cdv_px = sequence.observations.uv_px @ CHANNELS.T
    return _with_pixels(sequence, (cdv_px * np.array([1.0, 1.0 + dose, 1.0])) @ np.linalg.inv(CHANNELS).T)


def cut_tracks(sequence: Sequence, dose: float = 0.08, seed: int = 0) -> Sequence:
    """End every track before a share of the frames, and continue with new ones: repeated images, a tracker that fails.

    Repaired stale frames have this effect: across each, only the motion samples measure the motion.
    """
    seen = sequence.observations
    cut = np.random.default_rng(seed).uniform(size=sequence.frame_count) < dose
    cut[0] = False
    track_id = np.cumsum(cut)[seen.frame] * (int(seen.track_id.max(initial=-1)) + 1) + seen.track_id
    return replace(sequence, observations=replace(seen, track_id=track_id))


def persistent_mismatch(sequence: Sequence, dose: float = 0.05, seed: int = 0) -> Sequence:
    """Let a share of the tracks slip to a point 5 to 30 px nearer to the middle, and follow that point to their end."""
    slipped = with_slips(sequence.observations, dose, sequence.rig, np.random.default_rng(seed))
    return replace(sequence, observations=slipped)


def moving_objects(sequence: Sequence, dose: float = 0.2, seed: int = 0) -> Sequence:
    """Let a share of the points drive along the camera's course at a speed of their vehicle, up to 1.5 times its own.

    Points whose tracks begin within two seconds are on one vehicle. Raises DataError where no truth says where the
    camera was at the frames.
    """
    truth, seen, rng = sequence.truth, sequence.observations, np.random.default_rng(seed)
    if truth is None or not np.isin(sequence.frames_t_ns, truth.t_ns).all():
        raise DataError(f"{sequence.name}: moving objects need the truth at every frame")
    poses = truth.T_world_imu[np.searchsorted(truth.t_ns, sequence.frames_t_ns)] @ sequence.rig.T_imu_cam
    t_s = sequence.frames_s
    velocity = np.gradient(poses[:, :3, 3], t_s, axis=0)
    track, first, row = np.unique(seen.track_id, return_index=True, return_inverse=True)
    begin = seen.frame[first]
    vehicle = (t_s[begin] / _ONE_VEHICLE_S).astype(np.int64)
    speed = rng.uniform(0.3, 1.5, size=vehicle.max(initial=0) + 1)[vehicle] * (rng.uniform(size=track.size) < dose)
    travelled = (speed[:, None] * velocity[begin])[row] * (t_s[seen.frame] - t_s[begin][row])[:, None]
    points = triangulate(seen.uv_px, sequence.rig)
    moved = points + (np.swapaxes(poses[seen.frame][:, :3, :3], 1, 2) @ travelled[:, :, None])[..., 0]
    kept = moved[:, 2] > 0.5
    shift_px = project(moved[kept], sequence.rig) - project(points[kept], sequence.rig)
    left = seen.select(kept)
    return replace(sequence, observations=replace(left, uv_px=left.uv_px + shift_px))


def _with_track_noise(sequence: Sequence, noise: TrackNoise, seed: int) -> Sequence:
    noisy = with_track_noise(sequence.observations, noise, np.random.default_rng(seed))
    return replace(sequence, observations=noisy)


def _with_pixels(sequence: Sequence, uv_px: Array) -> Sequence:
    return replace(sequence, observations=replace(sequence.observations, uv_px=uv_px))
