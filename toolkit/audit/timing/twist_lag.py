"""Twist samples that describe another interval than their pairing says.

With w_k the sample and c_k the camera's rotation over k -> k + 1, the lag s in c_k = (1 - s) w_k + s w_(k+1) is 0 where
the sample at the start describes the interval, 1 where that at the end does, and 1/2 for their mean. Least squares are
biased towards 1/2 on noisy samples, because a mean of two has half the variance. The change of the neighbouring camera
rotations is therefore used as an instrument: it follows the change of the samples and is independent of their noise.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.clocks import LAG
from toolkit.audit.parts.intervals import LEAST_INTERVALS, Intervals
from toolkit.audit.parts.robust import Scalar, slope
from toolkit.geometry import BoolArray, IntArray
from toolkit.measured_motion import TwistSamples
from toolkit.sequence import Sequence

# Largest standard error of the lag, in intervals, and how many of them it must differ by from the present pairing's.
LARGEST_ERROR = 0.1
SIGMAS = 5.0


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Estimate the lag of the angular velocities; pair the samples by the nearest of start, mean and end."""
    sequence, intervals = evidence.sequence, evidence.intervals
    if not isinstance(sequence.motion, TwistSamples):
        return None
    if intervals is None:
        return evidence.blind
    lag = _lag(sequence, intervals)
    if lag is None:
        return Undecided("too few successive intervals have a sample at both ends and a known camera motion")
    if lag.error > LARGEST_ERROR:
        return Undecided(f"too little change of rotation: the lag is {lag.value:.1f} +- {lag.error:.1f} of an interval")
    present = sequence.motion.pairing
    nearest = min(LAG, key=lambda pairing: abs(LAG[pairing] - lag.value))
    if nearest == present or abs(lag.value - LAG[present]) < SIGMAS * lag.error:
        return None
    return Symptom(
        count=1,
        detail=(
            f"the twist samples describe the motion {lag.value:.2f} +- {lag.error:.2f} of an interval away from its "
            f'start, which is "{nearest}", not "{present}"'
        ),
        treatment=f'an interval is paired with the sample of its "{nearest}"',
        remedy=replace(sequence, motion=replace(sequence.motion, pairing=nearest)),
    )


def _lag(sequence: Sequence, intervals: Intervals) -> Scalar | None:
    """Estimate the lag where both frames have a sample and the camera's motion is known on either side."""
    w_camera = np.zeros((sequence.frame_count - 1, 3))
    w_camera[intervals.interval] = intervals.w_cam_radps @ sequence.rig.T_imu_cam[:3, :3].T
    known = np.zeros(sequence.frame_count - 1, dtype=bool)
    known[intervals.interval] = True
    sample, follows = _samples_at_frames(sequence)
    middle = 1 + np.flatnonzero(known[:-2] & known[1:-1] & known[2:] & follows[1:-1])
    if middle.size < LEAST_INTERVALS:
        return None
    w_samples = sequence.motion.values[:, 3:]
    at_start, at_end = w_samples[sample[middle]], w_samples[sample[middle] + 1]
    unexplained = w_camera[middle] - at_start
    instrument = 0.5 * (w_camera[middle + 1] - w_camera[middle - 1])
    return slope(instrument, at_end - at_start, unexplained - np.median(unexplained, axis=0))


def _samples_at_frames(sequence: Sequence) -> tuple[IntArray, BoolArray]:
    """Return the sample at or after each frame (K,), and which intervals (K - 1,) have samples at both ends only."""
    t_ns, frames_t_ns = sequence.motion.t_ns, sequence.frames_t_ns
    sample = np.searchsorted(t_ns, frames_t_ns)
    at_frame = t_ns[sample] == frames_t_ns
    return sample, at_frame[:-1] & at_frame[1:] & (np.diff(sample) == 1)


FAULT = Fault(
    "twist-lag",
    "twist samples that describe another interval than the one they are paired with",
    check,
    after=("mixed-axes", "extrinsic-translation"),
)
