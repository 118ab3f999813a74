"""Short gaps in the motion samples: interpolated, with the noise that interpolation has in the rest of the recording.

A gap shorter than `time_gap` reports is filled on straight lines between the samples at its ends. The recording itself
shows the error of that: stretches of the same length that were measured are interpolated in the same way, and the noise
in the gap is raised until it covers the integral of their error. The uncertainty of the state after a gap is then right
if the motion in it is like that of the rest.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.intervals import is_comparable
from toolkit.audit.parts.stamps import GAP_RATIO
from toolkit.geometry import Array, IntArray
from toolkit.measured_motion import ImuNoise, MotionNoise, MotionSamples, NoSamples, TwistNoise, TwistSamples
from toolkit.resampling import NS_PER_S, Bridges
from toolkit.sequence import Sequence

# Least number of measured stretches that are interpolated. With fewer, the variance of the samples is taken as the
# error of the interpolation.
LEAST_STRETCHES = 5


def check(evidence: Evidence) -> Symptom | None:
    """Count the gaps between the first frame and the last; fill them and raise the noise there."""
    sequence = evidence.sequence
    if not is_comparable(sequence):
        return None
    t_ns = sequence.motion.t_ns
    rows, usual_ns = _holes(sequence)
    if not rows.size:
        return None
    scale = np.stack([_noise_scale(sequence, round((t_ns[row + 1] - t_ns[row]) / usual_ns), usual_ns) for row in rows])
    longest_s = float((t_ns[rows + 1] - t_ns[rows]).max()) / NS_PER_S
    linear, angular = scale.max(axis=0)
    return Symptom(
        count=rows.size,
        detail=f"{rows.size} gap(s) in the motion samples, the longest of {longest_s:.3g} s",
        treatment=(
            f"bridged by linear interpolation, with up to {linear:.0f} (linear) and {angular:.0f} (angular) times "
            "the noise there, as measured stretches bridged likewise need"
        ),
        remedy=replace(
            sequence,
            motion=_filled(sequence.motion, rows, usual_ns),
            bridges=_with(sequence.bridges, Bridges(t_ns[rows], t_ns[rows + 1], scale)),
        ),
    )


def _holes(sequence: Sequence) -> tuple[IntArray, float]:
    """Return the samples after which there is a gap, between the first frame and the last, and the usual step (ns).

    A twist may be the mean over the whole interval to the next one, so a gap between twists needs a frame inside it.
    """
    t_ns, frames_t_ns = sequence.motion.t_ns, sequence.frames_t_ns
    step_ns = np.diff(t_ns)
    if not step_ns.size or isinstance(sequence.motion, NoSamples):
        return np.empty(0, dtype=np.int64), 0.0
    usual_ns = float(np.median(step_ns))
    inside = (t_ns[1:] > frames_t_ns[0]) & (t_ns[:-1] < frames_t_ns[-1])
    if isinstance(sequence.motion, TwistSamples):
        inside = np.searchsorted(frames_t_ns, t_ns[1:]) > np.searchsorted(frames_t_ns, t_ns[:-1], side="right")
    return np.flatnonzero((step_ns > GAP_RATIO * usual_ns) & inside), usual_ns


def _noise_scale(sequence: Sequence, steps: int, usual_ns: float) -> Array:
    """Return the factors (2,) on the noise, linear and angular, of an interpolation over so many steps."""
    values, step_s = sequence.motion.values, usual_ns / NS_PER_S
    stretches = _measured_stretches(sequence.motion.t_ns, steps, usual_ns)
    if stretches.size >= LEAST_STRETCHES:
        stretch = values[stretches[:, None] + np.arange(steps + 1)]  # (W, steps + 1, 6)
        share = np.linspace(0.0, 1.0, steps + 1)[:, None]
        line = stretch[:, :1] * (1.0 - share) + stretch[:, -1:] * share
        summed = step_s * np.cumsum(stretch - line, axis=1)[:, 1:]
        elapsed_s = step_s * np.arange(1, steps + 1)[:, None]
        density_squared = (np.mean(summed**2, axis=0) / elapsed_s).max(axis=0)
    else:
        density_squared = np.var(values, axis=0) * steps * step_s
    excess = density_squared.reshape(2, 3).max(axis=1) / _stated(sequence.noise) ** 2
    return np.asarray(np.sqrt(1.0 + excess))


def _measured_stretches(t_ns: IntArray, steps: int, usual_ns: float) -> IntArray:
    """Return the first samples of the stretches of so many steps without a gap."""
    if t_ns.size <= steps:
        return np.empty(0, dtype=np.int64)
    holes_before = np.concatenate([[0], np.cumsum(np.diff(t_ns) > GAP_RATIO * usual_ns)])
    return np.flatnonzero(holes_before[steps:] == holes_before[:-steps])


def _stated(noise: MotionNoise) -> Array:
    """Return the stated densities (2,) of linear and angular samples, the smallest over the axes."""
    if isinstance(noise, TwistNoise):
        return np.array([noise.velocity_noise_density.min(), noise.gyro_noise_density.min()])
    assert isinstance(noise, ImuNoise)
    return np.array([noise.accel_noise_density, noise.gyro_noise_density])


def _filled(motion: MotionSamples, rows: IntArray, usual_ns: float) -> MotionSamples:
    """Return the samples with interpolated ones in the gaps after ``rows``, at the usual steps."""
    ends = [(int(motion.t_ns[row]), int(motion.t_ns[row + 1])) for row in rows]
    inner = [np.linspace(begin, end, round((end - begin) / usual_ns) + 1)[1:-1] for begin, end in ends]
    t_ns = np.sort(np.concatenate([motion.t_ns, *(np.rint(stamps).astype(np.int64) for stamps in inner)]))
    at_s, sample_s = (t_ns - t_ns[0]) / NS_PER_S, (motion.t_ns - t_ns[0]) / NS_PER_S
    values = np.stack([np.interp(at_s, sample_s, column) for column in motion.values.T], axis=1)
    return motion.of(t_ns, values)


def _with(before: Bridges | None, new: Bridges) -> Bridges:
    if before is None:
        return new
    begin, end = np.append(before.begin_t_ns, new.begin_t_ns), np.append(before.end_t_ns, new.end_t_ns)
    return Bridges(begin, end, np.vstack([before.noise_scale, new.noise_scale]))


FAULT = Fault(
    "motion-gap",
    "short gaps in the motion samples",
    check,
    after=("time-gap", "units", "mixed-axes"),
)
