"""Sensor measurements of the exact motion: stereo pixels, body twists and IMU samples with known noise.

Continuous densities have Kalibr's names and units; a sample of white noise over dt has the standard deviation density /
sqrt(dt), a step of a random walk over dt has density * sqrt(dt) (Furgale et al., "Kalibr", IMU noise model).
"""

from dataclasses import dataclass

import numpy as np

from toolkit.geometry import Array, IntArray, se3_inverse, se3_log, transform
from toolkit.measurements import NS_PER_S, ImuNoise, StereoRig, TwistNoise
from toolkit.models.stereo import CHANNELS, project
from toolkit.motion_samples import ImuSamples, MotionSamples, TwistSamples
from toolkit.sequence import Observations
from toolkit.simulation.track_noise import TrackNoise
from toolkit.simulation.trajectory import SmoothTrajectory
from toolkit.simulation.world import CameraLimits, Tracks


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


@dataclass(frozen=True, eq=False)
class MotionMeasurements:
    """Motion samples and the bias (S, 6), [accel, gyro], contained in each of them."""

    samples: MotionSamples
    bias: Array


def stamps_ns(start_ns: int, rate_hz: float, duration_s: float) -> IntArray:
    """Return the stamps (S,) ns of a periodic sensor from the start to the end of a recording, both included."""
    count = int(np.floor(duration_s * rate_hz + 1e-9)) + 1
    return start_ns + np.round(np.arange(count) * (NS_PER_S / rate_hz)).astype(np.int64)


@dataclass(frozen=True, eq=False)
class ImuStamps:
    """Stamps (S,) of IMU samples, and the stamp of the trajectory's time 0 s.

    They are the midpoints of the IMU's intervals, from one before the start of a recording to one after its end. Each
    frame then lies between two intervals, and no sample is used on both sides of a frame: the measurements between
    successive pairs of frames have independent errors, as every estimator assumes.
    """

    t_ns: IntArray
    start_ns: int

    @classmethod
    def over(cls, start_ns: int, rate_hz: float, duration_s: float) -> "ImuStamps":
        """Return the stamps for a recording."""
        count = int(np.floor(duration_s * rate_hz + 1e-9)) + 2
        return cls(start_ns + np.round((np.arange(count) - 0.5) * (NS_PER_S / rate_hz)).astype(np.int64), start_ns)


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
    """End every track where it leaves the image."""
    limit_px = np.array([size_px[0], size_px[0], size_px[1]]) - 1
    outside = ((seen.uv_px < 0.0) | (seen.uv_px > limit_px)).any(axis=1)
    track, row = np.unique(seen.track_id, return_inverse=True)
    end = np.full(track.size, np.iinfo(np.int64).max)
    np.minimum.at(end, row[outside], seen.frame[outside])
    return seen.select(seen.frame < end[row])


def measure_twist(
    odometer: Odometer, scale: float, t_ns: IntArray, T_world_imu: Array, rng: np.random.Generator
) -> MotionMeasurements:
    """Measure the exact mean body twist of each interval between stamps: log(T_k^-1 T_k+1) / dt, plus noise.

    Takes stamps (S + 1,) and poses (S + 1, 4, 4) and returns S samples; sample k is the motion from k to k + 1.
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
    return MotionMeasurements(samples, np.hstack([np.zeros_like(gyro_bias), gyro_bias]))


def measure_imu(
    imu: Imu, scale: float, stamps: ImuStamps, trajectory: SmoothTrajectory, gravity: Array, rng: np.random.Generator
) -> MotionMeasurements:
    """Measure the instantaneous specific force and angular velocity at stamps, plus noise and bias.

    ``gravity`` (3,) m/s^2 is that of the world.
    """
    t_ns = stamps.t_ns
    t_s = (t_ns - stamps.start_ns) / NS_PER_S
    dt_s = 1.0 / imu.rate_hz
    motion = trajectory.at(t_s)
    R_imu_world = np.swapaxes(motion.T_world_imu[:, :3, :3], 1, 2)
    exact = np.hstack([(R_imu_world @ (motion.a_world - gravity)[:, :, None])[:, :, 0], motion.w_imu])
    white_rng, walk_rng, start_rng = rng.spawn(3)
    white, walk = white_rng.standard_normal((t_ns.size, 6)), walk_rng.standard_normal((t_ns.size, 6))
    noise = imu.noise
    density = np.repeat([noise.accel_noise_density, noise.gyro_noise_density], 3)
    walk_density = np.repeat([noise.accel_random_walk, noise.gyro_random_walk], 3)
    bias = scale * _walk(imu.bias_sigma * start_rng.standard_normal(6), walk_density * np.sqrt(dt_s) * walk)
    measured = exact + bias + scale * white * density / np.sqrt(dt_s)
    return MotionMeasurements(ImuSamples(t_ns, measured[:, :3], measured[:, 3:], "middle"), bias)


def _walk(start: Array, steps: Array) -> Array:
    """Return a random walk (S, d) from its start (d,) and its steps (S, d), the first of which is not taken."""
    walked: Array = start + np.cumsum(np.vstack([np.zeros_like(start), steps[:-1]]), axis=0)
    return walked
