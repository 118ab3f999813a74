"""Stereo tracks simulated along a given trajectory: a room around it, what the pair sees of it, and pixel noise."""

from dataclasses import dataclass

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array
from toolkit.sequence import Observations, StereoRig
from toolkit.simulation import sensors, world
from toolkit.simulation.world import Camera

# The walls stand this far outside the box of all positions: below, beside and above.
_MARGIN_LOWER_M, _MARGIN_UPPER_M = np.array([2.0, 2.0, 1.0]), np.array([2.0, 2.0, 1.5])
# So dense that a pair with EuRoC's field of view has 100 landmarks before it at 2 m from a wall.
_LANDMARKS_PER_M2 = 20.0
# A hall of 100 m by 100 m by 20 m; what flies farther flies outdoors, and a damaged truth farther still.
_MOST_SURFACE_M2 = 28_000.0
_WORLD_SEED = 20  # draws the landmarks, the same for every seed of the noise


@dataclass(frozen=True, eq=False)
class RoomTracks:
    """The tracks, and the landmarks (M, 3) in the world that they are of."""

    observations: Observations
    points: Array


def tracks_in_a_room(T_world_imu: Array, rig: StereoRig, camera: Camera, seed: int) -> RoomTracks:
    """Simulate what a tracker sees from poses (K, 4, 4), with the noise of the rig's covariance.

    The room belongs to the trajectory; the seed draws the chance ends of tracks, what is followed, and the
    noise, each from a stream of its own. The same arguments give the same bits. Raises DataError where the
    trajectory is too large for a room.
    """
    tracks_rng, pixels_rng = (np.random.default_rng(stream) for stream in np.random.SeedSequence(seed).spawn(2))
    points = _room_around(T_world_imu[:, :3, 3])
    tracks = world.follow(world.visibility(points, T_world_imu, rig, camera), camera, tracks_rng)
    exact = sensors.sightings(tracks, points, T_world_imu, rig)
    noisy = sensors.with_pixel_noise(exact, 1.0, rig.cov_uv_px2, camera.step_px, pixels_rng)
    # Track ids grow with time and a frame's places keep their order, so the rows are sorted already.
    return RoomTracks(noisy, points)


def _room_around(positions: Array) -> Array:
    lower, upper = positions.min(axis=0) - _MARGIN_LOWER_M, positions.max(axis=0) + _MARGIN_UPPER_M
    size = upper - lower
    surface_m2 = 2.0 * float(size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
    if not surface_m2 < _MOST_SURFACE_M2:
        raise DataError(f"the truth spans {np.ptp(positions, axis=0).max():.3g} m, more than a room; check its unit")
    count = round(_LANDMARKS_PER_M2 * surface_m2)
    return world.room(lower, upper, count, np.random.default_rng(_WORLD_SEED))
