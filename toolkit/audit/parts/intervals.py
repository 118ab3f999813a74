"""The motion between two frames as the motion samples and as the camera measure it, side by side."""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.vision import CameraMotion, usable_pairs
from toolkit.errors import DataError
from toolkit.geometry import Array, IntArray, se3_exp, se3_inverse, transform
from toolkit.models.stereo import project, triangulate
from toolkit.resampling import NS_PER_S
from toolkit.sequence import NoSamples, Sequence, TwistSamples, check_runnable

# With fewer intervals than this the camera's motion is not compared.
LEAST_INTERVALS = 30


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


def compare(sequence: Sequence, camera: CameraMotion) -> Intervals | None:
    """Put both side by side; None where too few intervals are known, or no motion was measured."""
    rows = np.flatnonzero(camera.known)
    if isinstance(sequence.motion, NoSamples) or rows.size < LEAST_INTERVALS:
        return None
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values, sequence.frames_t_ns)[rows]
    v_mps = mean[:, :3] if isinstance(sequence.motion, TwistSamples) else None
    return Intervals(rows, mean[:, 3:], v_mps, camera.w_radps[rows], camera.v_mps[rows])


def is_comparable(sequence: Sequence) -> bool:
    """Say whether time increases, values are finite and the samples span the frames, as every comparison needs."""
    try:
        check_runnable(sequence)
    except DataError:
        return False
    return True


def interval_means(t_ns: IntArray, values: Array, frames_t_ns: IntArray) -> Array:
    """Return the mean (K - 1, d) over each interval between frames of samples (S, d) joined by straight lines."""
    sample_s, frame_s = (t_ns - frames_t_ns[0]) / NS_PER_S, (frames_t_ns - frames_t_ns[0]) / NS_PER_S
    knots_s = np.union1d(sample_s, frame_s)
    at_knots = np.stack([np.interp(knots_s, sample_s, column) for column in values.T], axis=1)
    pieces = 0.5 * (at_knots[1:] + at_knots[:-1]) * np.diff(knots_s)[:, None]
    integral = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(pieces, axis=0)])
    at_frames = integral[np.searchsorted(knots_s, frame_s)]
    means: Array = np.diff(at_frames, axis=0) / np.diff(frame_s)[:, None]
    return means


def median_one_step_px(sequence: Sequence, T_imu_cam: Array) -> float:
    """Return the median over the sightings of the root mean square of (uL, uR, v) residuals, in pixels.

    Points triangulated in one frame are moved by the twist samples (``sequence`` has twists) through the
    extrinsic ``T_imu_cam`` and projected into the next.
    """
    pairs, uv_px = usable_pairs(sequence), sequence.observations.uv_px
    dt_s = np.diff(sequence.frames_t_ns)[:, None] / NS_PER_S
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values, sequence.frames_t_ns)
    T_before_after_imu = se3_exp(dt_s * np.concatenate([mean[:, 3:], mean[:, :3]], axis=1))
    T_after_before = se3_inverse(se3_inverse(T_imu_cam) @ T_before_after_imu @ T_imu_cam)
    points = transform(T_after_before[pairs.interval], triangulate(uv_px[pairs.before], sequence.rig))
    points[:, 2] = np.maximum(points[:, 2], 0.1)
    residual_px = uv_px[pairs.after] - project(points, sequence.rig)
    return float(np.median(np.sqrt(np.mean(residual_px**2, axis=1))))
