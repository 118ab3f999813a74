"""The motion over each interval between frames, by the motion samples and by the camera."""

from typing import NamedTuple

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array, BoolArray, IntArray, se3_exp, se3_inverse
from toolkit.measured_motion import NoSamples, TwistSamples
from toolkit.models.camera_motion import CameraMotion
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence, check_runnable

# With fewer intervals than this the camera's motion is not compared.
LEAST_INTERVALS = 30
# Longest step (s) in the integration of an IMU's samples, with the orientation in its middle.
STEP_S = 0.02
# Largest bias (rad/s) of a gyro with odometry, 11 degrees per second; a larger difference is another fault, such as
# wrong axes.
MOST_BIAS_RADPS = 0.2


class Intervals(NamedTuple):
    """The M intervals whose camera motion is known.

    ``interval`` (M,) is the index of the earlier frame. ``w_radps`` (M, 3) and, for twists, ``v_mps`` (M, 3)
    are the means of the motion samples over the interval, in the IMU frame; ``w_cam_radps`` and ``v_cam_mps``
    (M, 3) are the camera's own motion in the camera's axes.
    """

    interval: IntArray
    w_radps: Array
    v_mps: Array | None
    w_cam_radps: Array
    v_cam_mps: Array

    def select(self, rows: BoolArray) -> "Intervals":
        """Return those of a mask (M,)."""
        v_mps = None if self.v_mps is None else self.v_mps[rows]
        return Intervals(self.interval[rows], self.w_radps[rows], v_mps, self.w_cam_radps[rows], self.v_cam_mps[rows])


def compare(sequence: Sequence, camera: CameraMotion) -> Intervals | None:
    """Return both motions over the known intervals; None if these are too few or no motion was measured."""
    rows = np.flatnonzero(camera.known)
    if isinstance(sequence.motion, NoSamples) or rows.size < LEAST_INTERVALS:
        return None
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values, sequence.frames_t_ns)[rows]
    v_mps = mean[:, :3] if isinstance(sequence.motion, TwistSamples) else None
    return Intervals(rows, mean[:, 3:], v_mps, camera.w_radps[rows], camera.v_mps[rows])


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
        """Return the integral of samples in the order of time."""
        pieces = 0.5 * (values[1:] + values[:-1]) * (np.diff(t_ns) / NS_PER_S)[:, None]
        return cls(t_ns, values, np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(pieces, axis=0)]))

    def means(self, frames_t_ns: IntArray) -> Array:
        """Return the mean (..., K - 1, d) over each interval between stamps (..., K)."""
        return np.asarray(np.diff(self._at(frames_t_ns), axis=-2) / (np.diff(frames_t_ns) / NS_PER_S)[..., None])

    def _at(self, t_ns: IntArray) -> Array:
        """Return the integral (..., K, d) from the first sample to stamps (..., K)."""
        row = np.clip(np.searchsorted(self.t_ns, t_ns, side="right") - 1, 0, len(self.t_ns) - 1)
        following = np.minimum(row + 1, len(self.t_ns) - 1)
        since_s = ((t_ns - self.t_ns[row]) / NS_PER_S)[..., None]
        step_s = np.maximum(self.t_ns[following] - self.t_ns[row], 1)[..., None] / NS_PER_S
        slope = np.where(since_s > 0.0, (self.values[following] - self.values[row]) / step_s, 0.0)
        return np.asarray(self.up_to[row] + since_s * (self.values[row] + 0.5 * since_s * slope))


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
