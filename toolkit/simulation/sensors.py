"""Sensor measurements of the exact motion: stereo tracks, body twists and IMU samples with known noise.

Continuous densities have Kalibr's names and units; a sample of white noise over dt has the standard deviation density /
sqrt(dt), a step of a random walk over dt has density * sqrt(dt) (Furgale et al., "Kalibr", IMU noise model).
"""

from dataclasses import dataclass

import numpy as np

from toolkit.arrays import freeze_arrays
from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse, se3_log, transform
from toolkit.measurements import NS_PER_S, ImuNoise, StereoRig, TwistNoise
from toolkit.models.stereo import CHANNELS, project
from toolkit.motion_samples import ImuSamples, MotionSamples, TwistSamples
from toolkit.sequence import Observations
from toolkit.simulation.scenes import Kinematics

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


@dataclass(frozen=True, eq=False)
class TrackNoise:
    """Standard deviations (3,) in the channels (c, d, v) of the parts of a track's error.

    A tracker that follows a patch from image to image adds a small error at every step (a random walk). One that
    matches left and right only in the first frame of a track has the same disparity error in all its frames (an
    offset). Simulators draw white noise alone, and most estimators assume it.

    ``white_px`` px of every sighting by itself; ``walk_px`` px per root frame; ``offset_px`` px of the track, constant.
    The covariance of the errors of sightings j and k, whose ages in frames are a_j and a_k, is
    ``white^2 [j = k] + walk^2 min(a_j, a_k) + offset^2``.
    """

    white_px: Array
    walk_px: Array
    offset_px: Array

    def __post_init__(self) -> None:
        freeze_arrays(self, white_px=(3,), walk_px=(3,), offset_px=(3,))

    def scaled(self, factor: float) -> "TrackNoise":
        return TrackNoise(factor * self.white_px, factor * self.walk_px, factor * self.offset_px)


@dataclass(frozen=True, eq=False)
class Odometer:
    """Body twists at the frame stamps: noise, and the standard deviation (3,) rad/s of the initial gyro bias."""

    noise: TwistNoise
    gyro_bias_sigma: Array


@dataclass(frozen=True, eq=False)
class Imu:
    """Raw IMU samples: rate, noise, and the standard deviation (6,) of the initial bias [accel, gyro]."""

    rate_hz: float
    noise: ImuNoise
    bias_sigma: Array


def stamps_ns(start_ns: int, rate_hz: float, duration_s: float) -> IntArray:
    """Return the stamps (S,) ns of a periodic sensor from the start to the end of a recording, both included."""
    count = int(np.floor(duration_s * rate_hz + 1e-9)) + 1
    return start_ns + np.round(np.arange(count) * (NS_PER_S / rate_hz)).astype(np.int64)


def imu_stamps_ns(start_ns: int, rate_hz: float, duration_s: float) -> IntArray:
    """Return the stamps (S,) ns of an IMU's samples: the midpoints of its intervals, one beyond either end.

    Each frame then lies between two intervals, and no sample is used on both sides of a frame: the measurements between
    successive pairs of frames have independent errors, as every estimator assumes.
    """
    count = int(np.floor(duration_s * rate_hz + 1e-9)) + 2
    return start_ns + np.round((np.arange(count) - 0.5) * (NS_PER_S / rate_hz)).astype(np.int64)


def visibility(points: Array, T_world_imu: Array, rig: StereoRig, camera: CameraLimits) -> BoolArray:
    """Say for each of K poses (K, 4, 4) and M landmarks (M, 3) whether the pair sees it, (K, M)."""
    T_cam_world = se3_inverse(T_world_imu @ rig.T_imu_cam)
    least, right, bottom = camera.border_px, *(size - 1 - camera.border_px for size in camera.size_px)
    seen = np.empty((len(T_world_imu), len(points)), dtype=bool)
    for begin in range(0, len(T_world_imu), _POSES_AT_ONCE):
        T = T_cam_world[begin : begin + _POSES_AT_ONCE]
        points_cam = np.swapaxes(T[:, :3, :3] @ points.T + T[:, :3, 3:], 1, 2)
        in_view = (points_cam[..., 2] >= camera.depth_m[0]) & (points_cam[..., 2] <= camera.depth_m[1])
        u_left, u_right, v = project(points_cam[in_view], rig).T
        # With a positive baseline uR < uL, so two of the four horizontal limits imply the others.
        in_view[in_view] = (u_right >= least) & (u_left <= right) & (v >= least) & (v <= bottom)
        seen[begin : begin + _POSES_AT_ONCE] = in_view
    return seen


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


def sightings(tracks: Tracks, points: Array, T_world_imu: Array, rig: StereoRig) -> Observations:
    """Return the exact observations of tracks over landmarks (M, 3) from the poses (K, 4, 4) of the frames."""
    T_cam_world = se3_inverse(T_world_imu @ rig.T_imu_cam)
    uv_px = project(transform(T_cam_world[tracks.frame], points[tracks.landmark]), rig)
    return Observations(tracks.frame, tracks.track_id, uv_px)


def with_pixel_noise(
    exact: Observations, scale: float, cov_uv_px2: Array, step_px: float, rng: np.random.Generator
) -> Observations:
    """Add noise of the covariance (3, 3) px^2, its standard deviations scaled, and round to the step (0: none)."""
    spread = scale * np.linalg.cholesky(cov_uv_px2)
    noisy_px = exact.uv_px + rng.standard_normal((len(exact), 3)) @ spread.T
    if step_px > 0.0:
        noisy_px = np.round(noisy_px / step_px) * step_px
    return Observations(exact.frame, exact.track_id, noisy_px)


def with_track_noise(clean: Observations, noise: TrackNoise, rng: np.random.Generator) -> Observations:
    """Add white noise, a random walk from the first sighting on and an offset to every track, in c, d, v.

    These are mean column, disparity and row. Frames in which a track is not seen count for its walk as well.
    """
    order = np.lexsort((clean.frame, clean.track_id))
    frame = clean.frame[order]
    track, first, row = np.unique(clean.track_id[order], return_index=True, return_inverse=True)
    steps = np.diff(frame, prepend=0)
    steps[first] = 0
    walk = np.cumsum(np.sqrt(steps)[:, None] * rng.standard_normal((len(clean), 3)), axis=0)
    errors_px = noise.walk_px * (walk - walk[first][row])
    errors_px += noise.offset_px * rng.standard_normal((track.size, 3))[row]
    errors_px += noise.white_px * rng.standard_normal((len(clean), 3))
    uv_px = clean.uv_px.copy()
    uv_px[order] += errors_px @ np.linalg.inv(CHANNELS).T
    return Observations(clean.frame, clean.track_id, uv_px)


def with_outliers(clean: Observations, camera: CameraLimits, rng: np.random.Generator) -> Observations:
    """Displace a share of the sightings, both images alike, like a tracker that has slipped to another corner.

    The displacement points towards the middle of the image, so that the sighting stays inside it.
    """
    struck = np.flatnonzero(rng.uniform(size=len(clean)) < camera.outlier_rate)
    length_px = rng.uniform(*camera.outlier_px, size=struck.size)
    angle = rng.uniform(0.0, 0.5 * np.pi, size=struck.size)
    uv_px = clean.uv_px.copy()
    middle_px = 0.5 * np.array(camera.size_px)
    towards = np.where(uv_px[struck][:, [0, 2]] < middle_px, 1.0, -1.0)
    shift_px = towards * (length_px * np.stack([np.cos(angle), np.sin(angle)])).T
    uv_px[struck] += shift_px[:, [0, 0, 1]]
    return Observations(clean.frame, clean.track_id, uv_px)


def with_slips(clean: Observations, share: float, rig: StereoRig, rng: np.random.Generator) -> Observations:
    """Let a share of the tracks slip to another point, 5 to 30 px away, and follow that point to their end.

    The other point is nearer to the middle of the image, so that it is inside the image.
    """
    track, first, row, length = np.unique(clean.track_id, return_index=True, return_inverse=True, return_counts=True)
    slips = rng.uniform(size=track.size) < share
    at, angle = rng.uniform(size=track.size) * length, rng.uniform(0.0, 0.5 * np.pi, track.size)
    length_px = slips * rng.uniform(5.0, 30.0, track.size)
    towards = np.where(clean.uv_px[first][:, [0, 2]] < [rig.cx_px, rig.cy_px], 1.0, -1.0)
    away_px = towards * (length_px * np.stack([np.cos(angle), np.sin(angle)])).T
    slipped = clean.frame - clean.frame[first][row] > at[row]
    return Observations(clean.frame, clean.track_id, clean.uv_px + slipped[:, None] * away_px[row][:, [0, 0, 1]])


def while_in_image(seen: Observations, size_px: tuple[int, int]) -> Observations:
    limit_px = np.array([size_px[0], size_px[0], size_px[1]]) - 1
    outside = ((seen.uv_px < 0.0) | (seen.uv_px > limit_px)).any(axis=1)
    track, row = np.unique(seen.track_id, return_inverse=True)
    end = np.full(track.size, np.iinfo(np.int64).max)
    np.minimum.at(end, row[outside], seen.frame[outside])
    return seen.select(seen.frame < end[row])


def measure_twist(
    odometer: Odometer, scale: float, t_ns: IntArray, T_world_imu: Array, rng: np.random.Generator
) -> tuple[MotionSamples, Array]:
    """Measure the exact mean body twist of each interval between stamps: log(T_k^-1 T_k+1) / dt, plus noise.

    Takes stamps (S + 1,) and poses (S + 1, 4, 4). Returns S samples, of which k is the motion from k to k + 1, and the
    biases (S, 6), [accel, gyro], contained in them.
    """
    dt_s = np.diff(t_ns)[:, None] / NS_PER_S
    exact = se3_log(se3_inverse(T_world_imu[:-1]) @ T_world_imu[1:]) / dt_s
    white_rng, walk_rng, start_rng = rng.spawn(3)
    white, walk = white_rng.standard_normal((dt_s.size, 6)), walk_rng.standard_normal((dt_s.size, 3))
    noise = odometer.noise
    start = odometer.gyro_bias_sigma * start_rng.standard_normal(3)
    gyro_bias = scale * _walk(start, noise.gyro_random_walk * np.sqrt(dt_s) * walk)
    density = np.concatenate([noise.gyro_noise_density, noise.velocity_noise_density])
    measured = exact + scale * white * density / np.sqrt(dt_s)
    samples = TwistSamples(t_ns[:-1], measured[:, 3:], measured[:, :3] + gyro_bias, "start")
    return samples, np.hstack([np.zeros_like(gyro_bias), gyro_bias])


def measure_imu(
    imu: Imu, scale: float, t_ns: IntArray, motion: Kinematics, gravity: Array, rng: np.random.Generator
) -> tuple[MotionSamples, Array]:
    """Measure the instantaneous specific force and angular velocity at stamps (S,), plus noise and bias.

    ``motion`` is the exact one there, ``gravity`` (3,) m/s^2 that of the world. Returns also the biases (S, 6).
    """
    dt_s = 1.0 / imu.rate_hz
    R_imu_world = np.swapaxes(motion.T_world_imu[:, :3, :3], 1, 2)
    exact = np.hstack([(R_imu_world @ (motion.a_world - gravity)[:, :, None])[:, :, 0], motion.w_imu])
    white_rng, walk_rng, start_rng = rng.spawn(3)
    white, walk = white_rng.standard_normal((t_ns.size, 6)), walk_rng.standard_normal((t_ns.size, 6))
    noise = imu.noise
    density = np.repeat([noise.accel_noise_density, noise.gyro_noise_density], 3)
    walk_density = np.repeat([noise.accel_random_walk, noise.gyro_random_walk], 3)
    bias = scale * _walk(imu.bias_sigma * start_rng.standard_normal(6), walk_density * np.sqrt(dt_s) * walk)
    measured = exact + bias + scale * white * density / np.sqrt(dt_s)
    return ImuSamples(t_ns, measured[:, :3], measured[:, 3:], "middle"), bias


def _walk(start: Array, steps: Array) -> Array:
    """Return a random walk (S, d) from its start (d,) and its steps (S, d), the first of which is not taken."""
    walked: Array = start + np.cumsum(np.vstack([np.zeros_like(start), steps[:-1]]), axis=0)
    return walked
