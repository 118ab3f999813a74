"""Frames stamped by another clock than the motion samples, or with a constant delay of the camera.

The camera's rotation, from its tracks alone, is the mean of the gyro over each interval, shifted by the offset. A
coarse search over whole steps finds the neighbourhood, Gauss-Newton on the shift, with Cauchy weights and about the
median (a gyro has a bias), finds it to a fraction of a sample; for twists, whose noise would hide the change of
rotation, the change that the camera sees is the instrument. Source: Furgale, Rehder & Siegwart, "Unified temporal and
spatial calibration for multi-sensor systems" (2013), section III, reduced to rotation.

A twist that is stamped at the frames is judged by its lag; here only an offset that no pairing of it explains. Where it
is stamped elsewhere no pairing mends it, and the frames are shifted to where the samples, as they are paired, fit. An
offset that half of the recording has, or that grows, is none to be shifted by: that is a change of the clock.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.bundle import LATE
from toolkit.audit.parts.intervals import LEAST_INTERVALS, Integral, Intervals
from toolkit.audit.parts.robust import MAD_TO_SIGMA, Scalar, slope, spread
from toolkit.audit.parts.subsets import keep_frames
from toolkit.audit.twist_lag import LAG
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
# An offset is one beyond so many standard errors and beyond what is no fault: a sample of an IMU may stand for the
# interval before or after its stamp, 5 ms at 100 Hz. A twist may stand for the interval before its stamp or after it,
# which is half of one from the middle, and be one off: an indoor recording that is taken for sound is by 0.8.
SIGMAS, LEAST_S, LEAST_TWIST_INTERVALS = 5.0, 0.005, 1.5
# Beside an IMU no sound recording at hand is farther beyond than 3.1 standard errors; from so many on it is said.
DOUBTFUL_SIGMAS = 3.2
# Between frames nothing of that can be told from the clock, and what the shift mends is either.
LEAST_OFF_FRAMES = 0.25
# The standard error is that of a jackknife over stretches of the recording, for a corner is one event and not ten
# intervals, times what was missing: measured on 24 simulated drives of 30 and 60 s and 8 flights of 15 s.
SCATTER = 1.45
# The offset changes between the halves beyond so many standard errors of the difference, and what sound recordings at
# hand have beyond them (s): the halves of drives 14 ms at most, those of recordings beside an IMU 3 ms. Chosen with
# them in view.
CHANGE_SIGMAS, CHANGE_SYSTEMATIC_S = 5.0, {"twist": 0.015, "imu": 0.005}
# A self-calibration finds offsets (s) no larger than this.
NEAR_S = 0.025
# With a larger standard error (s) than these no offset is ruled out; one that is beyond chance is believed up to twice
# as much, but where a twist leaves open which interval it describes.
LARGEST_ERROR_S, LARGEST_TWIST_ERROR_S, LARGEST_BEYOND = 0.0064, 0.0125, 2.0
# Twists stand a constant time beside the frames where nine in ten do so to this share of their step. Clocks that drift,
# and rates that differ, have no such constant. What is within so many standard errors the tracks do not exclude.
CONSTANT_SHARE, CONSTANT_STEPS, NEAR_SIGMAS = 0.9, 0.02, 2.0
# The unexplained variance must fall to this share of what it is without any offset, lest slow turns fit by chance.
MOST_UNEXPLAINED = 0.9
# Rotations of which one is noise differ by the sum of their variances: a gyro's own noise, in a standstill, has some
# shift at which it differs least. They must differ by less than this share of the sum, without gross mismatches.
MOST_APART, GROSS_SPREADS = 0.8, 6.0


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Find the offset of the frames' stamps; shift the frames by it."""
    sequence, intervals = evidence.sequence, evidence.intervals
    if intervals is None:
        return evidence.blind
    w_imu = intervals.w_cam_radps @ sequence.rig.T_imu_cam[:3, :3].T
    found = _refined(camera_offset(sequence, intervals, w_imu), evidence)
    if found is None:
        return Undecided("too little change of rotation: the offset of camera and gyro is unknown")
    expected_s, least_s = _expected(sequence)
    offset_s = found.value - expected_s
    beyond_s = found.value if _stamped_at_frames(sequence) else offset_s
    surely_s = _largest_error_s(sequence) * (1.0 if _stamped_at_frames(sequence) else LARGEST_BEYOND)
    if abs(beyond_s) < max(least_s, SIGMAS * found.error) or found.error > surely_s:
        return _as_often(sequence, Scalar(offset_s, found.error)) or _unknown(sequence, found)
    late = "late" if offset_s < 0.0 else "early"
    detail = (
        f"the camera turns as the gyro does when its stamps are shifted by {1e3 * offset_s:.1f} +- "
        f"{1e3 * found.error:.1f} ms: frames are stamped {late}"
    )
    change = change_of_offset(sequence, intervals)
    if change is not None and abs(change.value) > max(least_change_s(sequence, change.error), 0.5 * abs(offset_s)):
        return _changing(detail, change)
    remedy = _shifted(sequence, offset_s)
    return Symptom(count=1, detail=detail, treatment="the frames are shifted by it", remedy=remedy)


def _changing(detail: str, change: Scalar) -> Symptom:
    """Tell of an offset that no constant shift mends, for half of the recording has another one."""
    parted = f"{1e3 * change.value:.0f} +- {1e3 * change.error:.0f} ms"
    return Symptom.warning(
        count=1,
        detail=f"{detail}, but by {parted} more in the second half than in the first",
        treatment="a clock drifts or was set: stamp both by one clock, or cut the recording there",
    )


def _refined(found: Scalar | None, evidence: Evidence) -> Scalar | None:
    """Return the offset by which tracks and IMU fit together, where that of the rotations is near or fits nothing.

    Rotations err more, and of a camera that is turned they make an offset of up to a tenth of a second.
    """
    fitted = evidence.self_calibration
    if found is None or fitted is None:
        return found
    if abs(found.value) > NEAR_S:
        shifted = evidence.after(_shifted(evidence.sequence, found.value))
        if shifted.self_calibration is not None:
            return found
    return Scalar(float(fitted.value[LATE]), float(fitted.error[LATE]))


def _unknown(sequence: Sequence, found: Scalar) -> Undecided | None:
    """Say how well an offset is known that is no more than chance, where that is badly."""
    if found.error <= _largest_error_s(sequence):
        return _doubtful(sequence, found)
    known = f"the offset of camera and gyro is known to {1e3 * found.error:.0f} ms"
    return Undecided(f"too little change of rotation: {known}")


def _doubtful(sequence: Sequence, found: Scalar) -> Undecided | None:
    """Say of an IMU's recording that its offset is between what chance makes and what is told."""
    if isinstance(sequence.motion, TwistSamples) or abs(found.value) < max(LEAST_S, DOUBTFUL_SIGMAS * found.error):
        return None
    late = "late" if found.value < 0.0 else "early"
    seen = f"{1e3 * abs(found.value):.0f} +- {1e3 * found.error:.0f} ms"
    return Undecided(
        f"frames look as if stamped {late} by {seen}, too little change of rotation to tell that from chance"
    )


def _largest_error_s(sequence: Sequence) -> float:
    return LARGEST_TWIST_ERROR_S if isinstance(sequence.motion, TwistSamples) else LARGEST_ERROR_S


def _as_often(sequence: Sequence, offset: Scalar) -> Symptom | None:
    """Tell of twists that come as often as frames and a constant time beside them, if the tracks allow a late clock."""
    if not isinstance(sequence.motion, TwistSamples) or (late_s := _constant_phase_s(sequence)) is None:
        return None
    step_s = float(np.median(np.diff(sequence.motion.t_ns))) / NS_PER_S
    near = [shift for shift in (-late_s, step_s - late_s) if abs(offset.value - shift) <= NEAR_SIGMAS * offset.error]
    if not near:
        return None
    shifts = " or ".join(f"{1e3 * shift:+.0f}" for shift in near)
    return Symptom.warning(
        count=1,
        detail=(
            f"twists come as often as frames, and each frame {1e3 * late_s:.0f} ms after one: a camera's clock that is "
            f"to be shifted by {shifts} ms looks so; by the tracks it is {1e3 * offset.value:+.0f} +- "
            f"{1e3 * offset.error:.0f} ms, which does not tell that from none"
        ),
        treatment="if frames and twists were taken together, give them the same stamps",
    )


def _constant_phase_s(sequence: Sequence) -> float | None:
    """Return how long (s) after a sample frames are stamped, where that is constant, not nothing, at equal rates."""
    t_ns, frames_t_ns = sequence.motion.t_ns, sequence.frames_t_ns
    step_ns, tolerance = float(np.median(np.diff(t_ns))), CONSTANT_STEPS * float(np.median(np.diff(t_ns)))
    since_ns = frames_t_ns - t_ns[np.clip(np.searchsorted(t_ns, frames_t_ns, side="right") - 1, 0, t_ns.size - 1)]
    phase_ns = float(np.median(since_ns))
    varies = np.quantile(np.abs(since_ns - phase_ns), CONSTANT_SHARE) > tolerance
    if varies or abs(float(np.median(np.diff(frames_t_ns))) - step_ns) > tolerance:
        return None
    return phase_ns / NS_PER_S if tolerance < phase_ns < step_ns - tolerance else None


def _expected(sequence: Sequence) -> tuple[float, float]:
    """Return the offset (s) that a right pairing of twists shows, and the largest that is no fault."""
    if not isinstance(sequence.motion, TwistSamples):
        return 0.0, LEAST_S
    step_s = float(np.median(np.diff(sequence.motion.t_ns))) / NS_PER_S
    least_s = (
        LEAST_TWIST_INTERVALS * step_s if _stamped_at_frames(sequence) else max(LEAST_S, LEAST_OFF_FRAMES * step_s)
    )
    return (LAG[sequence.motion.pairing] - 0.5) * step_s, least_s


def _stamped_at_frames(sequence: Sequence) -> bool:
    """Say whether most frames have a motion sample of the same stamp."""
    return bool(np.isin(sequence.frames_t_ns, sequence.motion.t_ns).mean() > 0.5)


def change_of_offset(sequence: Sequence, intervals: Intervals) -> Scalar | None:
    """Return by how much (s) the camera's offset changes between the halves; None where a half shows none."""
    w_imu = intervals.w_cam_radps @ sequence.rig.T_imu_cam[:3, :3].T
    early = np.arange(len(w_imu)) < len(w_imu) // 2
    first, second = (camera_offset(sequence, intervals.select(rows), w_imu[rows]) for rows in (early, ~early))
    if first is None or second is None:
        return None
    return Scalar(second.value - first.value, float(np.hypot(first.error, second.error)))


def least_change_s(sequence: Sequence, error_s: float) -> float:
    """Return the least difference (s) of the halves' offsets, known to a standard error, that is none of chance."""
    return CHANGE_SIGMAS * error_s + CHANGE_SYSTEMATIC_S[sequence.motion_kind]


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
    if isinstance(sequence.motion, TwistSamples) and _stamped_at_frames(sequence):
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


def _shifted(sequence: Sequence, offset_s: float) -> Sequence:
    """Return the sequence with its frames on the motion's clock, without those that its samples do not reach."""
    shifted = replace(sequence, frames_t_ns=sequence.frames_t_ns + round(offset_s * NS_PER_S))
    motion_t_ns = sequence.motion.t_ns
    inside = (shifted.frames_t_ns >= motion_t_ns[0]) & (shifted.frames_t_ns <= motion_t_ns[-1])
    return shifted if inside.all() else keep_frames(shifted, np.flatnonzero(inside))


FAULT = Fault(
    "time-offset",
    "frames and motion samples stamped by different clocks",
    check,
    after=("mixed-axes", "twist-lag"),
)
