"""The motion over each interval between frames, by the motion samples and by the camera, and ratios of both."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from toolkit.audit.robust import Scalar, median_error
from toolkit.errors import DataError
from toolkit.geometry import Array, BoolArray, IntArray, nearest_rotation, se3_exp, se3_inverse
from toolkit.measurements import NS_PER_S, ImuNoise, MotionNoise, TwistNoise
from toolkit.models.camera_motion import CameraMotion
from toolkit.models.noise import white_sigma
from toolkit.motion_samples import ImuSamples, NoSamples, TwistSamples
from toolkit.sequence import Sequence, check_runnable

# With fewer intervals than this the camera's motion is not compared.
LEAST_INTERVALS = 30
# Longest step (s) in the integration of an IMU's samples, with the orientation in its middle.
STEP_S = 0.02
# Largest bias (rad/s) of a gyro with odometry; a larger difference is another fault, such as wrong axes.
MOST_BIAS_RADPS = 0.2


def usual_step_s(t_ns: IntArray) -> float:
    """Return the median time (s) from one of at least two stamps (N,) to the next."""
    return float(np.median(np.diff(t_ns))) / NS_PER_S


class Intervals(NamedTuple):
    """The M intervals whose camera motion is known.

    ``interval`` (M,) is the index of the earlier frame. ``w_radps`` (M, 3) and, for twists, ``v_mps`` (M, 3)
    are the means of the motion samples over the interval, in the IMU frame; ``w_cam_radps`` and ``v_cam_mps``
    (M, 3) are the camera's own motion in the camera's axes. ``T_imu_cam`` (4, 4) relates the two.
    """

    interval: IntArray
    w_radps: Array
    v_mps: Array | None
    w_cam_radps: Array
    v_cam_mps: Array
    T_imu_cam: Array

    @property
    def w_seen_radps(self) -> Array:
        """The camera's rates of rotation (M, 3) in the IMU's axes."""
        return np.asarray(self.w_cam_radps @ self.T_imu_cam[:3, :3].T)

    @property
    def v_seen_mps(self) -> Array:
        """The camera's velocity (M, 3) by its own motion, in the IMU's axes."""
        return np.asarray(self.v_cam_mps @ self.T_imu_cam[:3, :3].T)

    @property
    def v_measured_mps(self) -> Array:
        """The camera's velocity (M, 3) by the samples, in the IMU's axes; only where these are twists."""
        assert self.v_mps is not None
        return np.asarray(self.v_mps + np.cross(self.w_seen_radps, self.T_imu_cam[:3, 3]))

    @property
    def bias_radps(self) -> Array:
        """The constant difference (3,) of the gyro's rates and the camera's, their median."""
        return np.asarray(np.median(self.w_radps - self.w_seen_radps, axis=0))

    def select(self, rows: BoolArray) -> "Intervals":
        v_mps = None if self.v_mps is None else self.v_mps[rows]
        seen = self.w_cam_radps[rows], self.v_cam_mps[rows], self.T_imu_cam
        return Intervals(self.interval[rows], self.w_radps[rows], v_mps, *seen)


def compare(sequence: Sequence, camera: CameraMotion) -> Intervals | None:
    """Return both motions over the known intervals; None if these are too few or no motion was measured."""
    rows = np.flatnonzero(camera.known)
    if isinstance(sequence.motion, NoSamples) or rows.size < LEAST_INTERVALS:
        return None
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values, sequence.frames_t_ns)[rows]
    v_mps = mean[:, :3] if isinstance(sequence.motion, TwistSamples) else None
    seen = camera.w_radps[rows], camera.v_mps[rows], sequence.rig.T_imu_cam
    return Intervals(rows, mean[:, 3:], v_mps, *seen)


def is_comparable(sequence: Sequence) -> bool:
    """Say whether time increases, values are finite and the samples span the frames, which every comparison needs."""
    try:
        check_runnable(sequence)
    except DataError:
        return False
    return True


class Integral(NamedTuple):
    """Samples (S, d) at stamps (S,), linear between them and constant beyond the ends, and their integral up to each.

    Once it is computed, the time for means over intervals depends on their number only.
    """

    t_ns: IntArray
    values: Array
    up_to: Array

    @classmethod
    def of(cls, t_ns: IntArray, values: Array) -> "Integral":
        pieces = 0.5 * (values[1:] + values[:-1]) * (np.diff(t_ns) / NS_PER_S)[:, None]
        return cls(t_ns, values, np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(pieces, axis=0)]))

    def means(self, frames_t_ns: IntArray) -> Array:
        """Return the mean (..., K - 1, d) over each interval between stamps (..., K)."""
        return np.asarray(np.diff(self._at(frames_t_ns), axis=-2) / (np.diff(frames_t_ns) / NS_PER_S)[..., None])

    def _at(self, t_ns: IntArray) -> Array:
        row = np.clip(np.searchsorted(self.t_ns, t_ns, side="right") - 1, 0, len(self.t_ns) - 1)
        following = np.minimum(row + 1, len(self.t_ns) - 1)
        since_s = ((t_ns - self.t_ns[row]) / NS_PER_S)[..., None]
        step_s = np.maximum(self.t_ns[following] - self.t_ns[row], 1)[..., None] / NS_PER_S
        slope = np.where(since_s > 0.0, (self.values[following] - self.values[row]) / step_s, 0.0)
        return np.asarray(self.up_to[row] + since_s * (self.values[row] + 0.5 * since_s * slope))


def chained(step: Array) -> Array:
    """Return the products (n + 1, d, d) of the first 0, 1, ... n matrices (n, d, d)."""
    products = np.tile(np.eye(step.shape[1]), (len(step) + 1, 1, 1))
    for k in range(len(step)):
        products[k + 1] = products[k] @ step[k]
    return products


def interval_means(t_ns: IntArray, values: Array, frames_t_ns: IntArray) -> Array:
    """Return the mean (K - 1, d) over each interval between frames of linearly interpolated samples (S, d)."""
    return Integral.of(t_ns, values).means(frames_t_ns)


def subdivided(t_ns: IntArray) -> tuple[IntArray, IntArray]:
    """Return stamps (n,) that divide each interval between stamps (K,) into equal parts, and the rows (K,) of these.

    Over a part, no longer than STEP_S, an IMU's specific force and rate of rotation are taken as constant. Taken as
    constant between two frames, vibration of several hertz would bias a scale by 8 %.
    """
    parts = max(1, int(np.ceil(np.median(np.diff(t_ns)) / NS_PER_S / STEP_S)))
    index = np.arange(len(t_ns)) * parts
    since_ns = np.interp(np.arange(index[-1] + 1), index, t_ns - t_ns[0])
    return t_ns[0] + since_ns.round().astype(np.int64), index


def moved_as_measured(sequence: Sequence, camera: CameraMotion, T_imu_cam: Array) -> Array:
    """Return the camera's motion (K - 1, 4, 4) by the motion samples and an extrinsic, less the gyro's bias."""
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values, sequence.frames_t_ns)
    w_radps, v_mps = mean[:, 3:], mean[:, :3]
    R_imu_cam = T_imu_cam[:3, :3]
    bias_radps = np.median((w_radps - camera.w_radps @ R_imu_cam.T)[camera.known], axis=0)
    if not isinstance(sequence.motion, TwistSamples):
        return moved_by(camera._replace(w_radps=(w_radps - bias_radps) @ R_imu_cam), sequence)
    if float(np.linalg.norm(bias_radps)) <= MOST_BIAS_RADPS:
        w_radps = w_radps - bias_radps
    dt_s = np.diff(sequence.frames_t_ns)[:, None] / NS_PER_S
    T_before_after_imu = se3_exp(dt_s * np.concatenate([w_radps, v_mps], axis=1))
    return np.asarray(se3_inverse(T_imu_cam) @ T_before_after_imu @ T_imu_cam)


def moved_by(camera: CameraMotion, sequence: Sequence) -> Array:
    """Return the camera's motion (K - 1, 4, 4) over every interval, from its velocities."""
    dt_s = np.diff(sequence.frames_t_ns)[:, None] / NS_PER_S
    return se3_exp(dt_s * np.concatenate([camera.w_radps, camera.v_mps], axis=1))


# Largest ratios, of speeds and rates of rotation and of specific force, that an error of a scale explains; beyond them
# there is a `disagreement`. Sound recordings have ratios of speeds of 0.96 to 1.02.
MOST_RATIO, MOST_FORCE_RATIO = 1.25, 1.5
# A stated noise of this share of the samples' own scatter, or more, was estimated from them and is in their unit.
FROM_SCATTER = 0.5


def rotation_ratio(intervals: Intervals) -> Scalar:
    """Return the ratio of the samples' rates of rotation to the camera's, independent of their axes.

    It is the scale of the similarity between the rates less their medians (Umeyama 1991, eqs. 39-42), which the noise
    of the samples does not bias.
    """
    measured, seen = (w - np.median(w, axis=0) for w in (intervals.w_radps, intervals.w_cam_radps))
    turn, overlaps = nearest_rotation(measured.T @ seen)
    total = float(np.sum(seen**2))
    if not total > 0.0:
        return Scalar(1.0, np.inf)
    turned, scale = seen @ turn.T, float(overlaps.sum()) / total
    moment = np.sum(turned * (measured - scale * turned), axis=1)
    return Scalar(scale, float(np.sqrt(np.sum(moment**2))) / total)


def speed_ratio(intervals: Intervals | None) -> Scalar | None:
    """Return the ratio of the samples' speeds to the camera's; None where the samples have none."""
    if intervals is None or intervals.v_mps is None:
        return None
    return ratio_of_speeds(intervals.v_mps, intervals.v_cam_mps)


def ratio_of_speeds(one: Array, other: Array) -> Scalar | None:
    """Return the median ratio of the norms of velocities (M, 3), over the faster half, where noise matters least."""
    speed = np.linalg.norm(other, axis=1)
    fast = (speed > 0.0) & (speed >= np.median(speed)) if speed.size else np.zeros(0, dtype=bool)
    if fast.sum() < 2:
        return None
    ratio = (np.linalg.norm(one[fast], axis=1) / speed[fast])[:, None]
    return Scalar(float(np.median(ratio)), float(median_error(ratio)[0]))


def force_ratio(sequence: Sequence) -> Scalar | None:
    """Return the median ratio of the norm of the specific force to gravity; None for twists."""
    if not isinstance(sequence.motion, ImuSamples) or not sequence.motion.t_ns.size:
        return None
    ratio = np.linalg.norm(sequence.motion.accel_mps2, axis=1)[:, None] / np.linalg.norm(sequence.gravity_world)
    return Scalar(float(np.median(ratio)), float(median_error(ratio)[0]))


def is_from_scatter(density: Array, values: Array, t_ns: IntArray) -> bool:
    """Say whether a density (3,) of white noise looks as if estimated from the scatter of the samples (S, 3)."""
    root_dt = np.sqrt(np.median(np.diff(t_ns)) / NS_PER_S)
    return bool((density > FROM_SCATTER * white_sigma(values) * root_dt).all())


def stated_densities(noise: MotionNoise) -> Array:
    """Return the stated densities (6,) of the white noise of linear and angular samples."""
    if isinstance(noise, TwistNoise):
        return np.concatenate([noise.velocity_noise_density, noise.gyro_noise_density])
    assert isinstance(noise, ImuNoise)
    return np.repeat([noise.accel_noise_density, noise.gyro_noise_density], 3)


class Quantity(NamedTuple):
    """A size of the motion by the samples: its ratio to another source in words, where that is sound, and its units.

    ``units`` have the factors of those to convert from. A ratio ``within`` a factor of a unit's is of that unit.
    ``columns`` are those of the samples.
    """

    summary: str
    ratio_of: Callable[[Sequence, Intervals | None], Scalar | None]
    least: float
    most: float
    units: Mapping[str, float]
    within: float
    columns: slice
    by_camera: bool = True


# Vision's speed is accurate to 5 % in sound recordings, which distinguishes km/h from ft/s, a factor of 1.1 apart. The
# noise of the camera's rotation lowers the ratio of rates. The factors of mg and cm/s^2 differ by 2 %, too little.
SPEED = Quantity(
    "the samples' speed is {:.3g} +- {:.1g} times the camera's",
    lambda _, intervals: speed_ratio(intervals),
    least=1.0 / MOST_RATIO,
    most=MOST_RATIO,
    units={"km/h": 3.6, "ft/s": 3.281, "mph": 2.237, "cm/s": 100.0, "mm/s": 1000.0},
    within=1.08,
    columns=slice(0, 3),
)
RATE = Quantity(
    "the gyro turns {:.3g} +- {:.1g} times as fast as the camera",
    lambda _, intervals: None if intervals is None else rotation_ratio(intervals),
    least=0.0,
    most=MOST_RATIO,
    units={"deg/s": 180.0 / np.pi},
    within=1.25,
    columns=slice(3, 6),
)
FORCE = Quantity(
    "the accelerometer reads {:.3g} times gravity (median)",
    lambda sequence, _: force_ratio(sequence),
    least=1.0 / MOST_FORCE_RATIO,
    most=MOST_FORCE_RATIO,
    units={"g": 1.0 / 9.80665, "mg": 1000.0 / 9.80665, "cm/s^2": 100.0, "mm/s^2": 1000.0},
    within=1.25,
    columns=slice(0, 3),
    by_camera=False,
)
