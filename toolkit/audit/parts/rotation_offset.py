"""By how much a camera's rotation is later than its stamps, beside rates of rotation by another clock.

A coarse search over whole steps finds the neighbourhood, Gauss-Newton on the shift, with Cauchy weights and about the
median (a gyro has a bias), finds it to a fraction of a sample; for twists, whose noise would hide the change of
rotation, the change that the camera sees is the instrument. Source: Furgale, Rehder & Siegwart, "Unified temporal and
spatial calibration for multi-sensor systems" (2013), section III, reduced to rotation.
"""

import numpy as np

from toolkit.audit.parts.intervals import LEAST_INTERVALS, Integral, Intervals
from toolkit.audit.parts.robust import MAD_TO_SIGMA, Scalar, slope, spread
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.jackknife import jackknife_error
from toolkit.measured_motion import TwistSamples
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# How far it is searched for, and the step of the search in intervals.
MOST_S, COARSE_STEP = 0.6, 0.25
# So many means over an interval at a time: what is computed of them takes a megabyte, however long the recording.
MEANS_AT_A_TIME = 10_000
REFINEMENTS = 5
# The standard error is that of a jackknife over stretches of the recording, for a corner is one event and not ten
# intervals, times what was missing: measured on 24 simulated drives of 30 and 60 s and 8 flights of 15 s.
SCATTER = 1.45
# The unexplained variance must fall to this share of what it is without any offset, lest slow turns fit by chance.
MOST_UNEXPLAINED = 0.9
# Rotations of which one is noise differ by the sum of their variances: a gyro's own noise, in a standstill, has some
# shift at which it differs least. They must differ by less than this share of the sum, without gross mismatches.
MOST_APART, GROSS_SPREADS = 0.8, 6.0


def camera_offset(sequence: Sequence, intervals: Intervals, w_imu: Array) -> Scalar | None:
    """Estimate how much later than its stamps (s) the camera's rotation is, or None where nothing tells."""
    step_s = float(np.median(np.diff(sequence.frames_t_ns))) / NS_PER_S
    gyro = Integral.of(sequence.motion.t_ns, sequence.motion.values[:, 3:])
    candidates = np.append(np.arange(-MOST_S, MOST_S, COARSE_STEP * step_s), 0.0)
    some = np.array_split(candidates, 1 + candidates.size * len(w_imu) // MEANS_AT_A_TIME)
    costs = np.concatenate([_unexplained(w_imu, *_gyro_at(gyro, sequence, intervals, part_s)) for part_s in some])
    costs, at_zero = costs[:-1], costs[-1]
    if not np.isfinite(costs).any():
        return None
    best = int(np.nanargmin(costs))
    offset_s = float(candidates[best]) if costs[best] < MOST_UNEXPLAINED * at_zero else 0.0
    found = Scalar(offset_s, np.inf)
    seen, known = _change_seen(sequence, intervals, w_imu)
    for _ in range(REFINEMENTS):
        mean, inside = _gyro_at(gyro, sequence, intervals, found.value)
        after, after_inside = _gyro_at(gyro, sequence, intervals, found.value + 0.1 * step_s)
        before, before_inside = _gyro_at(gyro, sequence, intervals, found.value - 0.1 * step_s)
        rows = known & inside & after_inside & before_inside
        if rows.sum() < LEAST_INTERVALS:
            return None
        change = (after - before)[rows] / (0.2 * step_s)
        residual = w_imu[rows] - mean[rows]
        instrument = seen[rows] if isinstance(sequence.motion, TwistSamples) else change
        residual = residual - np.median(residual, axis=0)
        step = slope(instrument, change, residual)
        found = Scalar(found.value + float(np.clip(step.value, -step_s, step_s)), step.error)
    if abs(found.value) >= 2.0 * MOST_S or _share_apart(w_imu[rows], mean[rows]) > MOST_APART:
        return None
    if isinstance(sequence.motion, TwistSamples) and is_stamped_at_frames(sequence):
        return found
    return Scalar(found.value, SCATTER * jackknife_error(_slope, instrument, change, residual))


def _slope(instrument: Array, change: Array, residual: Array) -> float:
    return slope(instrument, change, residual).value


def _change_seen(sequence: Sequence, intervals: Intervals, w_imu: Array) -> tuple[Array, BoolArray]:
    """Return how the camera's rotation changes about each interval (M, 3) rad/s^2, and where that is known (M,).

    From the neighbouring intervals: it follows the gyro's change and not its noise, nor the interval's own.
    """
    seen, known = np.zeros((sequence.frame_count + 1, 3)), np.zeros(sequence.frame_count + 1, dtype=bool)
    seen[intervals.interval + 1], known[intervals.interval + 1] = w_imu, True
    step_s = float(np.median(np.diff(sequence.frames_t_ns))) / NS_PER_S
    before, after = intervals.interval, intervals.interval + 2
    return (seen[after] - seen[before]) / (2.0 * step_s), np.asarray(known[before] & known[after])


def _gyro_at(
    gyro: Integral, sequence: Sequence, intervals: Intervals, offset_s: float | Array
) -> tuple[Array, BoolArray]:
    """Return the mean rates (..., M, 3) of the gyro over the intervals, and which of them it reaches (..., M).

    The intervals are shifted by the offsets (...) s.
    """
    begin = intervals.interval - intervals.interval[0]
    shift_ns = np.rint(np.asarray(offset_s) * NS_PER_S).astype(np.int64)[..., None]
    t_ns = sequence.frames_t_ns[intervals.interval[0] : intervals.interval[-1] + 2] + shift_ns
    inside = (t_ns[..., begin] >= gyro.t_ns[0]) & (t_ns[..., begin + 1] <= gyro.t_ns[-1])
    return gyro.means(t_ns)[..., begin, :], np.asarray(inside)


def _unexplained(w_imu: Array, mean: Array, inside: BoolArray) -> Array:
    """Return the spread of the differences (C, M, 3) over the intervals that are reached (C, M), squared (C,).

    NaN where those are few.
    """
    reached = inside.sum(axis=-1)
    apart = np.where(inside[:, None], (w_imu - mean).swapaxes(-1, -2), np.nan)
    deviation = MAD_TO_SIGMA * _medians(np.abs(apart - _medians(apart, reached)), reached)
    return np.where(reached < LEAST_INTERVALS, np.nan, np.sum(deviation[..., 0] ** 2, axis=-1))


def _medians(values: Array, reached: IntArray) -> Array:
    """Return the medians (C, d, 1) of values (C, d, M), of which so many (C,) are no NaN: those come last in order."""
    ordered, last = np.sort(values, axis=-1), np.maximum(reached - 1, 0)
    middle = [np.take_along_axis(ordered, row[:, None, None], axis=-1) for row in (last // 2, (last + 1) // 2)]
    return np.asarray(0.5 * (middle[0] + middle[1]))


def _share_apart(w_imu: Array, mean: Array) -> float:
    """Return the variance of the difference (M, 3) over the sum of both variances: 1 where they are independent."""
    seen, measured = (rates - np.median(rates, axis=0) for rates in (w_imu, mean))
    apart = seen - measured
    apart = apart - np.median(apart, axis=0)
    sound = (np.abs(apart) <= GROSS_SPREADS * spread(apart)).all(axis=1)
    return float(np.sum(apart[sound] ** 2) / max(np.sum(seen[sound] ** 2 + measured[sound] ** 2), 1e-300))


def is_stamped_at_frames(sequence: Sequence) -> bool:
    """Say whether most frames have a motion sample of the same stamp."""
    return bool(np.isin(sequence.frames_t_ns, sequence.motion.t_ns).mean() > 0.5)
