"""Offset and rate of two clocks by rotations that both stamp: the camera's and the gyro's, or the truth's.

``camera_offset`` is the delay of the camera's rotation after its stamps. A coarse search finds its neighbourhood;
Gauss-Newton on the shift, with Cauchy weights and about the median (a gyro has a bias), refines it to a fraction of a
sample. The rates of twists are noisy, so there the change of rotation by the camera is the instrument.

``truth_clock`` does the same with the truth's rates of rotation in place of a gyro's, and also estimates the relative
rate of the clocks. Gauss-Newton on offset and rate proceeds from the middle of the recording outwards, because far from
the middle a wrong rate shifts a turn by more than its duration. Source: Furgale, Rehder & Siegwart, "Unified temporal
and spatial calibration for multi-sensor systems" (2013), section III, reduced to rotation.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from toolkit.audit.intervals import LEAST_INTERVALS, Integral, Intervals, usual_step_s
from toolkit.audit.robust import Scalar, regression, slope, spread
from toolkit.geometry import Array, BoolArray, IntArray, so3_log
from toolkit.jackknife import jackknife_error
from toolkit.measurements import NS_PER_S
from toolkit.models.camera_motion import CameraMotion
from toolkit.models.gating import MAD_TO_SIGMA
from toolkit.motion_samples import Pairing, TwistSamples
from toolkit.sequence import Sequence, Truth

# Range of the search, and its step in intervals.
MOST_S, COARSE_STEP = 0.6, 0.25
# Means over an interval that are computed at a time: they take a megabyte, however long the recording.
MEANS_AT_A_TIME = 10_000
REFINEMENTS = 5
# The standard error is a jackknife's, times this factor, measured on 24 simulated drives and 8 flights.
SCATTER = 1.45
# The unexplained variance must fall below this share of that without an offset, because slow turns may fit by chance.
MOST_UNEXPLAINED = 0.9
# Share of the sum of both variances that the difference may have, without those beyond so many spreads: independent
# rates have 1, and at a standstill some shift always fits best.
MOST_APART, GROSS_SPREADS = 0.8, 6.0
# Limits of an offset (s) of the truth's clock, and of what a rate causes at both ends; sound recordings have 9 +- 2 ms.
OFFSET_SIGMAS, LEAST_OFFSET_S = 5.0, 0.02
# The fit uses these shares of the intervals about the middle, one after the other, with this many steps each.
SHARES, STEPS = (0.3, 0.6, 1.0), (2, 1, 3)
# Least number of intervals of a fit, of which the truth may not cover some.
FEWEST = LEAST_INTERVALS + 10
# The slope of the truth's rates is taken over this share of a step of the frames to either side.
SLOPE_STEP = 0.1
# Largest rate; beyond it, other parts of a motion fit as well.
MOST_RATE = 0.1
# Limits of the change between the halves: standard errors, and what sound recordings have (s): 14 ms, 3 ms with an IMU.
CHANGE_SIGMAS, CHANGE_SYSTEMATIC_S = 5.0, {"twist": 0.015, "imu": 0.005}
# The lag s of twists, in intervals, by their pairing: the motion from sample k to sample k + 1 is (1 - s) times sample
# k plus s times sample k + 1.
LAG: dict[Pairing, float] = {"start": 0.0, "mean": 0.5, "end": 1.0}


def camera_offset(sequence: Sequence, intervals: Intervals) -> Scalar | None:
    """Estimate how much later than its stamps (s) the camera's rotation is, or None where it is undetermined."""
    step_s = usual_step_s(sequence.frames_t_ns)
    gyro, w_imu = Integral.of(sequence.motion.t_ns, sequence.motion.values[:, 3:]), intervals.w_seen_radps
    candidates = np.append(np.arange(-MOST_S, MOST_S, COARSE_STEP * step_s), 0.0)
    some = np.array_split(candidates, 1 + candidates.size * len(w_imu) // MEANS_AT_A_TIME)
    costs = np.concatenate([_unexplained(w_imu, *_gyro_at(gyro, sequence, intervals, part_s)) for part_s in some])
    costs, at_zero = costs[:-1], costs[-1]
    if not np.isfinite(costs).any():
        return None
    best = int(np.nanargmin(costs))
    offset_s = float(candidates[best]) if costs[best] < MOST_UNEXPLAINED * at_zero else 0.0
    found = Scalar(offset_s, np.inf)
    seen, known = _change_seen(sequence, intervals)
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
    error = jackknife_error(lambda *rows: slope(*rows).value, instrument, change, residual)
    return Scalar(found.value, SCATTER * error)


def _change_seen(sequence: Sequence, intervals: Intervals) -> tuple[Array, BoolArray]:
    """Return the camera's angular acceleration (M, 3) rad/s^2 by the neighbouring intervals, and if known (M,)."""
    seen, known = np.zeros((sequence.frame_count + 1, 3)), np.zeros(sequence.frame_count + 1, dtype=bool)
    seen[intervals.interval + 1], known[intervals.interval + 1] = intervals.w_seen_radps, True
    step_s = usual_step_s(sequence.frames_t_ns)
    before, after = intervals.interval, intervals.interval + 2
    return (seen[after] - seen[before]) / (2.0 * step_s), np.asarray(known[before] & known[after])


def _gyro_at(
    gyro: Integral, sequence: Sequence, intervals: Intervals, offset_s: float | Array
) -> tuple[Array, BoolArray]:
    """Return the mean rates (..., M, 3) of the gyro over the intervals, and which of them its samples cover (..., M).

    The intervals are shifted by the offsets (...) s.
    """
    begin = intervals.interval - intervals.interval[0]
    shift_ns = np.rint(np.asarray(offset_s) * NS_PER_S).astype(np.int64)[..., None]
    t_ns = sequence.frames_t_ns[intervals.interval[0] : intervals.interval[-1] + 2] + shift_ns
    inside = (t_ns[..., begin] >= gyro.t_ns[0]) & (t_ns[..., begin + 1] <= gyro.t_ns[-1])
    return gyro.means(t_ns)[..., begin, :], np.asarray(inside)


def _unexplained(w_imu: Array, mean: Array, inside: BoolArray) -> Array:
    """Return the squared spread (C,) of the differences (C, M, 3) over the intervals that are covered (C, M).

    NaN where these are fewer than LEAST_INTERVALS.
    """
    reached = inside.sum(axis=-1)
    apart = np.where(inside[:, None], (w_imu - mean).swapaxes(-1, -2), np.nan)
    deviation = MAD_TO_SIGMA * _medians(np.abs(apart - _medians(apart, reached)), reached)
    return np.where(reached < LEAST_INTERVALS, np.nan, np.sum(deviation[..., 0] ** 2, axis=-1))


def _medians(values: Array, reached: IntArray) -> Array:
    """Return the medians (C, d, 1) of those values (C, d, M) that are not NaN, of which a row has ``reached`` (C,)."""
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


def change_of_offset(sequence: Sequence, intervals: Intervals) -> Scalar | None:
    """Return the change (s) of the camera's offset from the first half to the second; None if one is undetermined."""
    early = np.arange(intervals.interval.size) < intervals.interval.size // 2
    first, second = (camera_offset(sequence, intervals.select(rows)) for rows in (early, ~early))
    if first is None or second is None:
        return None
    return Scalar(second.value - first.value, float(np.hypot(first.error, second.error)))


def least_change_s(sequence: Sequence, error_s: float) -> float:
    return CHANGE_SIGMAS * error_s + CHANGE_SYSTEMATIC_S[sequence.motion_kind]


def is_stamped_at_frames(sequence: Sequence) -> bool:
    """Say whether most frames have a motion sample of the same stamp."""
    return bool(np.isin(sequence.frames_t_ns, sequence.motion.t_ns).mean() > 0.5)


class TruthClock(NamedTuple):
    """Delay (s) of the frames after their stamps by the truth's clock, and by what share faster that clock runs.

    Each is None where it is undetermined. ``half_s`` is half of the recording's duration.
    """

    offset: Scalar | None
    rate: Scalar | None
    half_s: float

    @property
    def runs_otherwise(self) -> bool:
        if self.rate is None:
            return False
        return abs(self.rate.value) * self.half_s > max(LEAST_OFFSET_S, OFFSET_SIGMAS * self.rate.error * self.half_s)

    @property
    def unseen_s(self) -> float:
        """The largest difference (s) of the clocks that may go undetected."""
        if self.offset is None or self.rate is None:
            return np.inf
        return max(LEAST_OFFSET_S, OFFSET_SIGMAS * max(self.offset.error, self.rate.error * self.half_s))


def truth_clock(sequence: Sequence, camera: CameraMotion, truth: Truth) -> TruthClock | None:
    """Compare the clocks; None where the truth is out of order or not finite, or no motion was measured."""
    step_s = np.diff(truth.t_ns)[:, None] / NS_PER_S
    in_order = truth.t_ns.size >= LEAST_INTERVALS and (step_s > 0.0).all() and np.isfinite(truth.T_world_imu).all()
    if sequence.motion_kind == "none" or not in_order:
        return None
    R_world_imu = truth.T_world_imu[:, :3, :3]
    w_radps = so3_log(R_world_imu[:-1].swapaxes(1, 2) @ R_world_imu[1:]) / step_s
    middle_ns = truth.t_ns[:-1] + np.diff(truth.t_ns) // 2
    turning = sequence.motion.of(middle_ns, np.concatenate([np.zeros_like(w_radps), w_radps], axis=1))
    as_gyro, rows = replace(sequence, motion=turning), np.flatnonzero(camera.known)
    w_cam_radps = camera.w_radps[rows]
    seen = Intervals(rows, w_cam_radps, None, w_cam_radps, camera.v_mps[rows], sequence.rig.T_imu_cam)
    offset = camera_offset(as_gyro, seen)
    rate = rate_of_clock(as_gyro, seen, 0.0 if offset is None else offset.value)
    return TruthClock(offset, rate, 0.5 * sequence.duration_s)


def rate_of_clock(as_gyro: Sequence, seen: Intervals, offset_s: float) -> Scalar | None:
    """Return by what share faster the truth's clock runs than the frames'; None where it is undetermined.

    ``as_gyro`` is the recording with the truth's rates of rotation in place of its motion samples, ``offset_s`` an
    approximation of the delay (s) of the middle frame by the truth's clock. The rate must lower the residuals of the
    offset alone where it shifts the ends by a step or more; with a smaller shift, other turns cannot fit by chance.
    """
    found, count, at = np.array([offset_s, 0.0]), seen.interval.size, None
    try:
        for share, steps in zip(SHARES, STEPS, strict=True):
            aside = min(round(0.5 * (1.0 - share) * count), max(count - FEWEST, 0) // 2)
            for _ in range(steps):
                at = _linearised(as_gyro, seen, found, np.arange(aside, count - aside))
                if at is None:
                    return None
                found = found + regression(*at)[0]
                found[1] = np.clip(found[1], -MOST_RATE, MOST_RATE)
        if at is None or abs(found[1]) >= MOST_RATE:
            return None
        step_s = usual_step_s(as_gyro.frames_t_ns)
        if abs(found[1]) * 0.5 * as_gyro.duration_s >= step_s:
            both = [_linearised(as_gyro, seen, one, np.arange(count)) for one in (found, np.array([offset_s, 0.0]))]
            left, without = (np.inf if one is None else float(np.sum(spread(one[0]) ** 2)) for one in both)
            if not left < MOST_UNEXPLAINED * without:
                return None
        return Scalar(float(found[1]), SCATTER * jackknife_error(lambda *rows: float(regression(*rows)[0][1]), *at))
    except np.linalg.LinAlgError:  # the truth rotates in at most one stretch
        return None


def _linearised(as_gyro: Sequence, seen: Intervals, found: Array, rows: IntArray) -> tuple[Array, Array] | None:
    """Return the camera's rates of rotation less the truth's (m, 3) rad/s, and its Jacobian by offset and rate.

    None where the truth covers too few of the rows. A fast clock lowers all rates, as a wrong focal length: that is not
    used.
    """
    t_ns, truth = as_gyro.frames_t_ns, Integral.of(as_gyro.motion.t_ns, as_gyro.motion.values[:, 3:])
    since_s = (t_ns - t_ns[0]) / NS_PER_S
    since_s = since_s - 0.5 * since_s[-1]
    shift_s, apart_s = found[0] + found[1] * since_s, SLOPE_STEP * float(np.median(np.diff(since_s)))
    at_ns = t_ns + shift_s * NS_PER_S
    inside = (at_ns[seen.interval] >= truth.t_ns[0]) & (at_ns[seen.interval + 1] <= truth.t_ns[-1])
    used = rows[inside[rows]]
    if used.size < LEAST_INTERVALS:
        return None
    before, now, after = (
        truth.means(t_ns + np.rint(at_s * NS_PER_S).astype(np.int64))[seen.interval[used]]
        for at_s in (shift_s - apart_s, shift_s, shift_s + apart_s)
    )
    slope = (after - before) / (2.0 * apart_s)
    middle_s = 0.5 * (since_s[:-1] + since_s[1:])[seen.interval[used]]
    unexplained = seen.w_seen_radps[used] - (1.0 + found[1]) * now
    return unexplained, np.stack([slope, middle_s[:, None] * slope], axis=2)
