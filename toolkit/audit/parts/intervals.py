"""What the motion samples and the camera each say about the motion between two frames, side by side."""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.vision import CameraMotion
from toolkit.errors import DataError
from toolkit.geometry import Array, IntArray
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence, TwistSamples, check_runnable

# With fewer intervals than this the camera has no say.
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
    """Put both side by side; None where too few intervals are known for a verdict."""
    rows = np.flatnonzero(camera.known)
    if rows.size < LEAST_INTERVALS:
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
