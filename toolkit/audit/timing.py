"""Faults of time: stamps that repeat, jump or are uneven, gaps in the samples, clocks that differ."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from toolkit.audit.clocks import LAG, camera_offset, change_of_offset, is_stamped_at_frames, least_change_s
from toolkit.audit.fault import Evidence, Symptom, Undecided, beside_camera
from toolkit.audit.intervals import LEAST_INTERVALS, Intervals, is_comparable, stated_densities, usual_step_s
from toolkit.audit.robust import LEAST_SPREAD_V, Scalar, cauchy, mean_in_sigmas, slope
from toolkit.audit.self_calibration import CHANGE, LATE, SelfCalibration, self_calibration
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.jackknife import jackknife_error
from toolkit.measurements import NS_PER_S
from toolkit.models.camera_motion import camera_motion
from toolkit.models.gating import MAD_TO_SIGMA
from toolkit.motion_samples import Bridges, MotionSamples, NoSamples, TwistSamples
from toolkit.sequence import Sequence

# A step this many times the usual (median) one is a gap: one missing stamp makes a step of 2, two make 3.
GAP_RATIO = 3.5
# What a cast of NaN to int64 gives.
NOT_A_TIME = np.iinfo(np.int64).min


# A step of the frames is unusual if it is off by this share, this time (s), and this many times the scatter; a step of
# the samples near it must be off alike, to half of their usual step or a quarter of the difference.
LEAST_JUMP_SHARE, LEAST_JUMP_S, SCATTERS = 0.25, 0.01, 10.0
ALIKE_STEPS, ALIKE = 0.5, 0.25
# Intervals on either side that show how far the camera moves, their least number, and the error by acceleration.
AROUND, FEWEST_AROUND, SYSTEMATIC = 4, 5, 0.03
# Standard errors within which the camera moved one step, or as many as stamped; and how far apart the two must be.
WITHIN, APART = 3.0, 6.0
# A camera that moves less (m), or rotates less (rad), in a usual step is not used.
LEAST_M, LEAST_RAD = 0.01, 0.005
# With more unusual steps than this, none of them is taken as a jump: the stamps are uneven for another reason.
MOST = 10


class _Step(NamedTuple):
    """The frame and the sample after which both streams have an unusual step.

    ``by_s`` is its excess over the usual step, ``stamped`` the step of the frames in usual steps. ``gone`` is how many
    usual steps the camera moved; None where that does not show whether the clock was set.
    """

    frame: int
    sample: int
    by_s: float
    stamped: float
    gone: Scalar | None

    @property
    def is_jump(self) -> bool:
        """Whether the camera moved by one usual step, and not by as many as the stamps say."""
        if self.gone is None:
            return False
        near, far = abs(self.gone.value - 1.0), abs(self.gone.value - self.stamped)
        return near < WITHIN * self.gone.error < far


def clock_jump(evidence: Evidence) -> Symptom | Undecided | None:
    """Report the times at which the clock was set, and keep the longest stretch between them.

    If nothing was recorded for a while, the vehicle has moved as far as the stamps say; if the clock was set, by one
    usual step. A clock that goes back by more than a step shows in its stamps (`time_order`).
    """
    sequence = evidence.sequence
    steps, at_s = list(_steps_alike(sequence)), (sequence.frames_t_ns - sequence.frames_t_ns[:1]) / NS_PER_S
    jumps = [(step, step.gone) for step in steps if step.gone is not None and step.is_jump]
    if not jumps:
        open_s = [f"{step.by_s:+.3g} s at {at_s[step.frame]:.1f} s" for step in steps if step.gone is None]
        summary = f"the stamps of frames and samples jump together by {', '.join(open_s)}"
        why = f"{summary}: the tracks do not determine whether time passed or a clock was set"
        return Undecided(why) if open_s else None
    usual_s = usual_step_s(sequence.frames_t_ns)
    jumps_text = [
        f"by {step.by_s:+.3g} s at {at_s[step.frame]:.1f} s (by the tracks "
        f"{usual_s * gone.value:.3f} +- {usual_s * gone.error:.3f} s passed)"
        for step, gone in jumps
    ]
    frames, samples = (np.array(rows) for rows in zip(*((step.frame, step.sample) for step, _ in jumps), strict=True))
    remedy = _longest_part(sequence, _part_of(sequence.frames_t_ns, frames), _part_of(sequence.motion.t_ns, samples))
    detail = f"the clock of frames and samples is set {', '.join(jumps_text)}"
    return Symptom(len(jumps), detail, _kept(remedy, sequence), remedy)


def _steps_alike(sequence: Sequence) -> Iterator[_Step]:
    """Yield the unusual steps of the frames at which the samples have a step with the same excess."""
    frames_t_ns, samples_t_ns = sequence.frames_t_ns, sequence.motion.t_ns
    if min(frames_t_ns.size, samples_t_ns.size) < 2 * AROUND or NOT_A_TIME in (frames_t_ns.min(), samples_t_ns.min()):
        return
    step_s, sample_step_s = np.diff(frames_t_ns) / NS_PER_S, np.diff(samples_t_ns) / NS_PER_S
    usual_s, usual_sample_s = float(np.median(step_s)), float(np.median(sample_step_s))
    if usual_s <= 0.0 or usual_sample_s <= 0.0:
        return
    off_s, sample_off_s = step_s - usual_s, sample_step_s - usual_sample_s
    scatter_s = MAD_TO_SIGMA * float(np.median(np.abs(off_s)))
    far = (np.abs(off_s) > max(LEAST_JUMP_SHARE * usual_s, LEAST_JUMP_S, SCATTERS * scatter_s)) & (step_s >= 0.0)
    if far.sum() > MOST:
        return
    for frame in np.flatnonzero(far).tolist():
        by_s = float(off_s[frame])
        reach_ns = round((usual_sample_s + abs(by_s)) * NS_PER_S)
        begin, end = frames_t_ns[frame] - reach_ns, frames_t_ns[frame + 1] + reach_ns
        near = np.flatnonzero((samples_t_ns[:-1] >= begin) & (samples_t_ns[1:] <= end))
        apart_s = np.abs(sample_off_s[near] - by_s)
        if near.size and apart_s.min() <= max(ALIKE_STEPS * usual_sample_s, ALIKE * abs(by_s)):
            stamped = float(step_s[frame]) / usual_s
            yield _Step(frame, int(near[np.argmin(apart_s)]), by_s, stamped, _gone(sequence, frame, stamped))


def _gone(sequence: Sequence, frame: int, stamped: float) -> Scalar | None:
    """Return how many usual steps the camera moves, or else rotates, after a frame, by lines through those around it.

    None where the camera stands and hardly rotates, where its motion is not known, or where that decides nothing.
    """
    kept = np.arange(max(frame - AROUND, 0), min(frame + AROUND + 2, sequence.frame_count))
    camera = camera_motion(replace(sequence.with_frames(kept), frames_t_ns=NS_PER_S * np.arange(kept.size)))
    here = int(np.flatnonzero(kept == frame)[0])
    beside = np.flatnonzero(camera.known & (np.arange(camera.known.size) != here))
    if not camera.known[here] or beside.size < FEWEST_AROUND:
        return None
    line = np.stack([np.ones(beside.size), beside - here], axis=1)
    for moved, least in ((camera.v_mps, LEAST_M), (camera.w_radps, LEAST_RAD)):
        rows = np.column_stack([moved, np.linalg.norm(moved, axis=1)])
        found, *_ = np.linalg.lstsq(line, rows[beside])
        squares = np.sum((rows[beside] - line @ found) ** 2, axis=0) / (beside.size - 2)
        # At a standstill motions are noise, without a common direction.
        noise = np.sqrt(np.sum(squares[:3]) * np.linalg.inv(line.T @ line)[0, 0])
        if np.median(rows[beside, 3]) < least or np.linalg.norm(found[0, :3]) < APART * noise:
            continue
        usual = float(found[0, 3])
        error = float(np.hypot(np.sqrt(squares[3]) / usual * np.sqrt(1.0 + 1.0 / beside.size), SYSTEMATIC))
        steps = float(rows[here, 3]) / usual
        decided = abs(steps - 1.0) < WITHIN * error or abs(steps - stamped) < WITHIN * error
        if decided and abs(stamped - 1.0) > APART * error:
            return Scalar(steps, error)
    return None


# A forward step of this many usual ones means that earlier stamps were out of order; so many stamps must follow a jump,
# as a single one at the end is merely out of order.
LEAP, FEWEST_AFTER = 1.9, 3
# If more than this share of the stamps is late, the whole order is wrong, and sorting is no repair.
MOST_LATE = 0.5


def time_order(evidence: Evidence) -> Symptom | None:
    """Count the stamps that are not after all stamps before them; sort them and keep the first of equal ones.

    After a clock jumped back, sorting would interleave two times, so only the longest stretch between jumps is kept.
    """
    sequence = evidence.sequence
    streams = (sequence.frames_t_ns, sequence.motion.t_ns)
    frames, samples = map(_late, streams)
    count = frames + samples
    if count == 0:
        return None
    detail = f"{frames} frame stamp(s) and {samples} motion-sample stamp(s) are not after the ones before them"
    steps_ns = [np.diff(t_ns) for t_ns in streams if t_ns.size > 1]
    if any((step_ns == 0).mean() > MOST_LATE for step_ns in steps_ns):
        why = "most are equal to the one before them, as stamps are that were rounded: write them with all their digits"
        return Symptom(count, detail, why, remedy=None)
    runs_back = any((step_ns <= 0).mean() > MOST_LATE for step_ns in steps_ns)
    jumps = [_jumps(t_ns) for t_ns in streams]
    if any(rows.size for rows in jumps) and not runs_back:
        # From the expected next stamp back to the actual one.
        both = zip(map(np.diff, streams), jumps, strict=True)
        longest_s = max(float(np.median(np.abs(step)) - step[row]) for step, rows in both for row in rows) / NS_PER_S
        detail += f": the clock jumps back by {longest_s:.2f} s and goes on from there"
        remedy = _sorted(_longest_part(sequence, *map(_part_of, streams, jumps)))
        return Symptom(count, detail, _kept(remedy, sequence), remedy)
    if runs_back or max(frames / sequence.frame_count, samples / sequence.motion.t_ns.size) > MOST_LATE:
        why = "time runs backwards or stands still; sorting would play the recording backwards: correct the stamps"
        return Symptom(count, detail, why, remedy=None)
    why = "sorted by time; of equal stamps the first is kept; stamps that are no time are dropped"
    return Symptom(count, detail, why, _sorted(sequence))


def _sorted(sequence: Sequence) -> Sequence:
    if _late(sequence.frames_t_ns):
        sequence = sequence.with_frames(_in_order(sequence.frames_t_ns))
    if _late(sequence.motion.t_ns):
        sequence = sequence.with_samples(_in_order(sequence.motion.t_ns))
    return sequence


def _jumps(t_ns: IntArray) -> IntArray:
    """Return the rows after which the clock has jumped back and goes on at its usual step.

    After stamps that are merely out of order, time jumps forward to where it was.
    """
    step_ns = np.diff(t_ns)
    if t_ns.size < 3 or (t_ns == NOT_A_TIME).any():
        return np.empty(0, dtype=np.int64)
    usual_ns = float(np.median(np.abs(step_ns)))
    backwards = np.flatnonzero(step_ns < 0)
    return np.array([row for row in backwards.tolist() if _goes_on(t_ns, row, usual_ns)], dtype=np.int64)


def _goes_on(t_ns: IntArray, row: int, usual_ns: float) -> bool:
    latest = t_ns[: row + 1].max()
    later = np.flatnonzero(t_ns[row + 1 :] > latest)
    end = row + 1 + int(later[0]) if later.size else t_ns.size  # the first stamp that is new, or none
    if end - row <= FEWEST_AFTER and not later.size:
        return False  # too few stamps follow to decide
    return bool(np.diff(t_ns[row + 1 : end + 1]).max(initial=0) < LEAP * usual_ns)


def _part_of(t_ns: IntArray, jumps: IntArray) -> IntArray:
    return np.searchsorted(jumps, np.arange(t_ns.size), side="left")


def _longest_part(sequence: Sequence, frame_part: IntArray, sample_part: IntArray) -> Sequence:
    """Return the longest part, in frames, between two jumps; samples of their own longest if their jumps differ."""
    part = int(np.argmax(np.bincount(frame_part)))
    kept = sequence.with_frames(np.flatnonzero(frame_part == part))
    if not sample_part.max(initial=0):
        return kept
    of_part = part if sample_part.max() == frame_part.max() else int(np.argmax(np.bincount(sample_part)))
    return kept.with_samples(sample_part == of_part)


def _kept(part: Sequence, whole: Sequence) -> str:
    return f"the longest stretch without a jump is kept: {part.frame_count} of {whole.frame_count} frames"


def _late(t_ns: IntArray) -> int:
    latest_before = np.maximum.accumulate(np.concatenate([[NOT_A_TIME], t_ns[:-1]]))
    return int(np.sum(t_ns <= latest_before)) if t_ns.size else 0


def _in_order(t_ns: IntArray) -> IntArray:
    _, first_row = np.unique(t_ns, return_index=True)
    rows: IntArray = first_row[t_ns[first_row] != NOT_A_TIME]
    return rows


# With fewer frames there is no interval.
LEAST_FRAMES = 2


def outside_motion(evidence: Evidence) -> Symptom | None:
    sequence = evidence.sequence
    frames_t_ns, motion_t_ns = sequence.frames_t_ns, sequence.motion.t_ns
    if motion_t_ns.size == 0:
        return Symptom(sequence.frame_count, "there are no motion samples", "no frame can be used", remedy=None)
    covered = (frames_t_ns >= motion_t_ns.min()) & (frames_t_ns <= motion_t_ns.max())
    count = int(np.sum(~covered))
    if count == 0:
        return None
    outside = f"{count} of {sequence.frame_count} frames lie outside"
    if sequence.frame_count - count < LEAST_FRAMES:
        frames_s, motion_s = (
            f"{(t.min() - motion_t_ns.min()) / NS_PER_S:.3f} to {(t.max() - motion_t_ns.min()) / NS_PER_S:.3f} s"
            for t in (frames_t_ns, motion_t_ns)
        )
        detail = f"counted from the first motion sample, the samples are at {motion_s} and the frames at {frames_s}"
        why = "no motion is left: stamp both by one clock, in one unit"
        return Symptom(count, f"{detail}: {outside}", why, remedy=None)
    remedy = sequence.with_frames(np.flatnonzero(covered))
    return Symptom(count, f"{outside} the time of the motion samples", "cut off", remedy)


# Shorter gaps (s) in the motion samples, such as a dropped sample of a fast IMU, are interpolated (`motion_gap`).
MOTION_GAP_S = 1.5


def time_gap(evidence: Evidence) -> Symptom | None:
    """Find gaps in the motion samples, which no noise covers, and keep the longest stretch between them.

    A gap in the frames alone is information, because the motion samples cover it.
    """
    sequence = evidence.sequence
    t_ns, frames_t_ns = sequence.motion.t_ns, sequence.frames_t_ns
    holes = _holes(t_ns, MOTION_GAP_S)
    # Gaps outside the time of the frames do not matter.
    inside = (t_ns[holes + 1] > frames_t_ns[:1]) & (t_ns[holes] < frames_t_ns[-1:])
    if inside.any():
        return _motion_symptom(sequence, holes[inside])
    holes = _holes(frames_t_ns, 0.0)
    if not holes.size:
        return None
    detail = f"{holes.size} hole(s) in the frames, the longest of {_longest_s(frames_t_ns, holes):.2f} s"
    return Symptom.information(holes.size, detail, "the motion samples bridge them")


def _longest_s(t_ns: IntArray, holes: IntArray) -> float:
    return float(np.diff(t_ns)[holes].max()) / NS_PER_S


def _holes(t_ns: IntArray, least_s: float) -> IntArray:
    if t_ns.size < 2:
        return np.empty(0, dtype=np.int64)
    return np.flatnonzero(np.diff(t_ns) / NS_PER_S > max(least_s, GAP_RATIO * usual_step_s(t_ns)))


def _motion_symptom(sequence: Sequence, holes: IntArray) -> Symptom:
    t_ns = sequence.motion.t_ns
    detail = f"{holes.size} hole(s) in the motion samples, the longest of {_longest_s(t_ns, holes):.2f} s"
    # A frame at the edge of a gap belongs to the adjacent stretch.
    stretch = np.searchsorted(t_ns[holes + 1], sequence.frames_t_ns, side="right")
    in_hole = np.searchsorted(t_ns[holes], sequence.frames_t_ns, side="left") > stretch
    sizes = np.bincount(stretch[~in_hole], minlength=1)
    kept = np.flatnonzero(~in_hole & (stretch == np.argmax(sizes)))
    treatment = f"the longest stretch without one is kept: {kept.size} of {sequence.frame_count} frames"
    return Symptom(holes.size, detail, treatment, sequence.with_frames(kept))


# Samples with a longer step (s), and with this many frames in one step, do not represent a vehicle's motion.
MOST_STEP_S, MOST_RATIO = 2.0, 20.0


def sparse_motion(evidence: Evidence) -> Symptom | None:
    sequence = evidence.sequence
    if sequence.motion.t_ns.size < 2 or sequence.frame_count < 2 or not is_comparable(sequence):
        return None
    step_s, frame_s = usual_step_s(sequence.motion.t_ns), usual_step_s(sequence.frames_t_ns)
    if step_s <= GAP_RATIO * frame_s:
        return None
    count = sequence.motion.t_ns.size
    detail = f"motion samples come every {step_s:.3g} s and frames every {frame_s:.3g} s"
    if step_s > max(MOST_STEP_S, MOST_RATIO * frame_s):
        why = "too few to be used, as where their stamps are in another unit than the frames': check both"
        return Symptom(count, detail, why, remedy=None, spoils_vision=True)
    why = "between two samples the motion is interpolated linearly, with an error that no stated noise includes"
    return Symptom.warning(detail, why, count)


# Of fewer measured stretches, the variance of the samples is taken as the error of the interpolation.
LEAST_STRETCHES = 5


def motion_gap(evidence: Evidence) -> Symptom | None:
    """Fill gaps in the motion samples that are too short for `time_gap` on straight lines, and raise the noise there.

    It covers the error that the same interpolation has over measured stretches of the same length.
    """
    sequence = evidence.sequence
    if not is_comparable(sequence):
        return None
    t_ns = sequence.motion.t_ns
    rows, usual_ns = _short_holes(sequence)
    if not rows.size:
        return None
    scale = np.stack([_noise_scale(sequence, round((t_ns[row + 1] - t_ns[row]) / usual_ns), usual_ns) for row in rows])
    linear, angular = scale.max(axis=0)
    return Symptom(
        rows.size,
        f"{rows.size} gap(s) in the motion samples, the longest of {_longest_s(t_ns, rows):.3g} s",
        f"bridged by linear interpolation, with up to {linear:.0f} (linear) and {angular:.0f} (angular) times "
        "the noise there, to cover the error that the same interpolation has over measured stretches",
        replace(
            sequence,
            motion=_filled(sequence.motion, rows, usual_ns),
            bridges=_with(sequence.bridges, Bridges(t_ns[rows], t_ns[rows + 1], scale)),
        ),
    )


def _short_holes(sequence: Sequence) -> tuple[IntArray, float]:
    """Return the samples after which there is a gap between the first frame and the last, and the usual step (ns).

    A twist may be the mean up to the next one, so a gap between twists needs a frame inside it.
    """
    t_ns, frames_t_ns = sequence.motion.t_ns, sequence.frames_t_ns
    if t_ns.size < 2 or isinstance(sequence.motion, NoSamples):
        return np.empty(0, dtype=np.int64), 0.0
    rows = _holes(t_ns, 0.0)
    inside = (t_ns[rows + 1] > frames_t_ns[0]) & (t_ns[rows] < frames_t_ns[-1])
    if isinstance(sequence.motion, TwistSamples):
        inside = np.searchsorted(frames_t_ns, t_ns[rows + 1]) > np.searchsorted(frames_t_ns, t_ns[rows], side="right")
    return rows[inside], float(np.median(np.diff(t_ns)))


def _noise_scale(sequence: Sequence, steps: int, usual_ns: float) -> Array:
    """Return the factors (2,) on the noise, linear and angular, of an interpolation over ``steps`` steps."""
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
    excess = density_squared.reshape(2, 3).max(axis=1) / stated_densities(sequence.noise).reshape(2, 3).min(axis=1) ** 2
    return np.asarray(np.sqrt(1.0 + excess))


def _measured_stretches(t_ns: IntArray, steps: int, usual_ns: float) -> IntArray:
    if t_ns.size <= steps:
        return np.empty(0, dtype=np.int64)
    holes_before = np.concatenate([[0], np.cumsum(np.diff(t_ns) > GAP_RATIO * usual_ns)])
    return np.flatnonzero(holes_before[steps:] == holes_before[:-steps])


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


# Least root mean square of the steps' deviation, as a share of the usual step; real drives have 1.3 % at most.
LEAST_UNEVEN_SHARE = 0.03
# The motion follows a share of 1 if the stamps are right; it must be below the second number by this many errors.
UNEVEN_SIGMAS, MOST_FOLLOWED = 5.0, 0.5
# The usual step is half of this quantile of two steps together, which are even where every other frame is late.
UNHURT = 0.25
# Offsets of the intervals around one that show how the camera moves there.
BESIDE = (-2, -1, 1, 2)


def uneven_stamps(evidence: Evidence) -> Symptom | None:
    """Report frames with uneven stamps of evenly taken images: transfer times, a busy computer.

    An interval that is longer by its stamps must show more motion than those around it, by the tracks alone.
    """
    sequence, camera = evidence.sequence, evidence.camera_motion
    if evidence.spoilt_by or not is_comparable(sequence) or camera.known.sum() < LEAST_INTERVALS:
        return None
    step_s = np.diff(sequence.frames_t_ns) / NS_PER_S
    even_s = _even_steps_s(step_s)
    off_s = step_s - even_s
    if float(np.sqrt(np.mean(off_s[camera.known] ** 2))) < LEAST_UNEVEN_SHARE * float(np.median(even_s)):
        return None
    found = _followed(np.hstack([camera.v_mps, camera.w_radps]), step_s, even_s, camera.known)
    if found is None or found.value + UNEVEN_SIGMAS * found.error > MOST_FOLLOWED:
        return None
    typical_ms = 1e3 * float(np.median(np.abs(off_s)))
    return Symptom.warning(
        f"the intervals of the frames differ from the usual one by {typical_ms:.2g} ms (median), and the camera's "
        f"motion shows {found.value:.2f} +- {found.error:.2f} of these differences, where it should show all",
        "images are taken at more even intervals than stamped: stamp them when they are exposed",
    )


def _even_steps_s(step_s: Array) -> Array:
    """Return the steps (K - 1,) of evenly taken images: multiples of the usual step, for frames may be lost."""
    usual_s = 0.5 * float(np.quantile(step_s[1:] + step_s[:-1], UNHURT))
    for _ in range(2):
        steps = np.maximum(np.round(step_s / usual_s), 1.0)
        usual_s = float(step_s.sum() / steps.sum())
    return np.asarray(usual_s * steps)


def _followed(rates: Array, step_s: Array, even_s: Array, known: BoolArray) -> Scalar | None:
    """Return the share of the steps' variation about even ones that the camera's rates (K - 1, 6) follow, if known."""
    rows = np.arange(-BESIDE[0], step_s.size - BESIDE[-1])
    beside = rows[:, None] + np.array(BESIDE)
    usable = known[rows] & known[beside].all(axis=1)
    rows, beside = rows[usable], beside[usable]
    if rows.size < LEAST_INTERVALS:
        return None
    moved = rates * step_s[:, None]
    around = moved[beside].sum(axis=1) / step_s[beside].sum(axis=1)[:, None]
    regressor, response = around * (step_s - even_s)[rows, None], moved[rows] - around * even_s[rows, None]
    return Scalar(_share_followed(regressor, response), jackknife_error(_share_followed, regressor, response))


def _share_followed(regressor: Array, response: Array) -> float:
    return slope(regressor, regressor, response).value


# Largest standard error of the lag, in intervals, and how many of them it must differ by from the present pairing's.
LARGEST_LAG_ERROR = 0.1
LAG_SIGMAS = 5.0


def twist_lag(evidence: Evidence) -> Symptom | Undecided | None:
    """Estimate which interval a twist describes, and pair the samples by the nearest of start, mean and end.

    With w_k the sample and c_k the camera's rotation over k -> k + 1, c_k = (1 - s) w_k + s w_(k+1) has a lag s of 0
    where the sample at the start describes the interval, 1 at the end, 1/2 without an offset of the clocks (`clocks`).
    """
    sequence, intervals = evidence.sequence, evidence.intervals
    if not isinstance(sequence.motion, TwistSamples):
        return None
    if intervals is None:
        return evidence.blind
    found = camera_offset(sequence, intervals) if is_stamped_at_frames(sequence) else None
    if found is None:
        return Undecided("too little change of rotation, or too few frames with a twist of the same stamp")
    step_s = usual_step_s(sequence.motion.t_ns)
    lag = Scalar(0.5 + found.value / step_s, found.error / step_s)
    if lag.error > LARGEST_LAG_ERROR:
        return Undecided(f"too little change of rotation: the lag is {lag.value:.1f} +- {lag.error:.1f} of an interval")
    present = sequence.motion.pairing
    nearest = min(LAG, key=lambda pairing: abs(LAG[pairing] - lag.value))
    if nearest == present or abs(lag.value - LAG[present]) < LAG_SIGMAS * lag.error:
        return None
    seen = f"the twist samples describe the motion {lag.value:.2f} +- {lag.error:.2f} of an interval after its start"
    return Symptom(
        1,
        f'{seen}: they belong to its "{nearest}", and are stated to belong to its "{present}"',
        f'an interval is paired with the sample of its "{nearest}"',
        replace(sequence, motion=replace(sequence.motion, pairing=nearest)),
    )


# An offset is reported beyond this many standard errors and what is no fault: a sample of an IMU may describe the
# interval before or after its stamp; so may a twist, and be one interval late.
OFFSET_SIGMAS, LEAST_OFFSET_S, LEAST_TWIST_INTERVALS = 5.0, 0.005, 1.5
# From this many standard errors on an offset with an IMU is undecided; sound recordings have 3.1 at most.
DOUBTFUL_SIGMAS = 3.2
# The same limit, in intervals, for twists stamped between the frames, whose pairing looks like an offset.
LEAST_OFF_FRAMES = 0.25
# A shift is rejected if the velocities fit worse by this many standard errors: 3.4 where the gyro alone is late, and at
# most -0.1 on five drives with planted offsets.
AGAINST_SHIFT = 2.5
# By an offset (s) of the rotations larger than this, frames are shifted before the self-calibration; and by its own at
# most so often.
NEAR_S, SHIFTS = 0.025, 3
# With a larger standard error (s) an offset is undecided; one beyond chance is accepted up to twice that, except for
# twists stamped at the frames, whose interval is open.
LARGEST_ERROR_S, LARGEST_TWIST_ERROR_S, LARGEST_BEYOND = 0.0064, 0.0125, 2.0
# The time from a sample to the next frame is constant if this share of the frames has it to this share of a step; the
# tracks do not exclude an offset within this many standard errors.
CONSTANT_SHARE, CONSTANT_STEPS, NEAR_SIGMAS = 0.9, 0.02, 2.0
ONE_CLOCK = "a clock drifts or was set: stamp both by one clock, or cut the recording there"


@beside_camera
def time_offset(evidence: Evidence, intervals: Intervals) -> Symptom | Undecided | None:
    """Find the offset of the frames' stamps by rotations (`clocks`), and shift the frames by it.

    Twists stamped at the frames have a pairing (`twist_lag`); what that explains is no offset. Frames are not shifted
    where the halves differ, nor where velocities then fit worse: the rates of rotation alone are late.
    """
    sequence = evidence.sequence
    at_frames, is_twist = is_stamped_at_frames(sequence), isinstance(sequence.motion, TwistSamples)
    found = _refined(camera_offset(sequence, intervals), evidence)
    if found is None:
        return Undecided("too little change of rotation: the offset of camera and gyro is unknown")
    expected_s, least_s = _expected(sequence)
    offset_s, largest_s = found.value - expected_s, LARGEST_TWIST_ERROR_S if is_twist else LARGEST_ERROR_S
    beyond_s = found.value if at_frames else offset_s
    surely_s = largest_s * (1.0 if at_frames else LARGEST_BEYOND)
    if abs(beyond_s) < max(least_s, OFFSET_SIGMAS * found.error) or found.error > surely_s:
        return _as_often(sequence, Scalar(offset_s, found.error)) or _unseen_offset(found, largest_s, is_twist)
    by = f"{1e3 * offset_s:.1f} +- {1e3 * found.error:.1f} ms"
    seen = f"the camera turns as the gyro does when the frames' stamps are shifted by {by}"
    detail = f"{seen}: frames are stamped {'late' if offset_s < 0.0 else 'early'}"
    change = change_of_offset(sequence, intervals)
    if change is not None and abs(change.value) > max(least_change_s(sequence, change.error), 0.5 * abs(offset_s)):
        parted = f"{1e3 * change.value:.0f} +- {1e3 * change.error:.0f} ms more in the second half than in the first"
        return Symptom.warning(f"{detail}, but by {parted}", ONE_CLOCK)
    remedy = _shifted(sequence, offset_s)
    if (worse := _velocities_against(evidence, remedy, offset_s)) > AGAINST_SHIFT:
        fit_worse = f"the velocities fit worse, by {worse:.1f} standard errors: the gyro alone is shifted"
        why = "stamp rates of rotation and velocities by one clock, the camera's"
        return Symptom.warning(f"{seen}, but then {fit_worse}", why)
    return Symptom(count=1, detail=detail, treatment="the frames are shifted by it", remedy=remedy)


def _unseen_offset(found: Scalar, largest_s: float, is_twist: bool) -> Undecided | None:
    """Return an offset that is known badly or, with an IMU, beyond chance and below the limit of a finding."""
    if found.error > largest_s:
        known = f"the offset of camera and gyro is known to {1e3 * found.error:.0f} ms"
        return Undecided(f"too little change of rotation: {known}")
    if is_twist or abs(found.value) < max(LEAST_OFFSET_S, DOUBTFUL_SIGMAS * found.error):
        return None
    late = "late" if found.value < 0.0 else "early"
    seen = f"{1e3 * abs(found.value):.0f} +- {1e3 * found.error:.0f} ms"
    why = "there is too little change of rotation to distinguish that from chance"
    return Undecided(f"frames look as if stamped {late} by {seen}, and {why}")


def _velocities_against(evidence: Evidence, shifted: Sequence, offset_s: float) -> float:
    """Return by how many standard errors the twists' velocities fit the camera's worse after the frames are shifted."""
    before, after = evidence.intervals, evidence.after(shifted).intervals
    if before is None or after is None or before.v_mps is None or after.v_mps is None:
        return 0.0
    stamps_ns = shifted.frames_t_ns - round(offset_s * NS_PER_S)
    _, here, there = np.intersect1d(
        evidence.sequence.frames_t_ns[before.interval], stamps_ns[after.interval], return_indices=True
    )
    seen = before.v_seen_mps - np.cross(before.w_seen_radps, before.T_imu_cam[:3, 3])
    costs = cauchy(np.stack([before.v_mps[here] - seen[here], after.v_mps[there] - seen[here]]), LEAST_SPREAD_V)
    return mean_in_sigmas(costs[1] - costs[0])


def _refined(found: Scalar | None, evidence: Evidence) -> Scalar | None:
    """Return the self-calibration's offset, of frames that are shifted by a large one until little is left.

    Its model is linear in the delay: 20 ms of a shaken camera are off by a quarter. Where that does not converge, the
    offset of the rotations is returned.
    """
    if found is None or (fitted := evidence.self_calibration) is None:
        return found
    shift_s = 0.0
    if abs(found.value) > NEAR_S and (shifted := _fitted_after(evidence, found.value)) is not None:
        shift_s, fitted = found.value, shifted
    for _ in range(SHIFTS):
        shift_s += float(fitted.value[LATE])
        if abs(fitted.value[LATE]) < LEAST_OFFSET_S:
            return Scalar(shift_s, float(fitted.error[LATE]))
        if (shifted := _fitted_after(evidence, shift_s)) is None:
            break
        fitted = shifted
    return found


def _fitted_after(evidence: Evidence, shift_s: float) -> SelfCalibration | None:
    return evidence.after(_shifted(evidence.sequence, shift_s)).self_calibration


def _as_often(sequence: Sequence, offset: Scalar) -> Symptom | None:
    """Report twists at the rate and a constant time from the frames, if the tracks allow an offset of that time."""
    if not isinstance(sequence.motion, TwistSamples) or (late_s := _constant_phase_s(sequence)) is None:
        return None
    step_s = usual_step_s(sequence.motion.t_ns)
    near = [shift for shift in (-late_s, step_s - late_s) if abs(offset.value - shift) <= NEAR_SIGMAS * offset.error]
    if not near:
        return None
    shifts, sigmas = " or ".join(f"{1e3 * shift:+.0f}" for shift in near), abs(offset.value) / offset.error
    from_zero = "which is consistent with zero as well"
    if sigmas > NEAR_SIGMAS:
        from_zero = f"{sigmas:.1f} standard errors from zero"
    return Symptom.warning(
        f"twists have the rate of the frames, and each frame is {1e3 * late_s:.0f} ms after one, as if the camera's "
        f"clock were to be shifted by {shifts} ms; by the tracks the offset is {1e3 * offset.value:+.0f} +- "
        f"{1e3 * offset.error:.0f} ms, {from_zero}",
        "if frames and twists were taken together, give them the same stamps",
    )


def _constant_phase_s(sequence: Sequence) -> float | None:
    """Return the time (s) from a sample to the next frame, where rates are equal and it is constant and not zero."""
    t_ns, frames_t_ns = sequence.motion.t_ns, sequence.frames_t_ns
    step_ns, tolerance = float(np.median(np.diff(t_ns))), CONSTANT_STEPS * float(np.median(np.diff(t_ns)))
    since_ns = frames_t_ns - t_ns[np.clip(np.searchsorted(t_ns, frames_t_ns, side="right") - 1, 0, t_ns.size - 1)]
    phase_ns = float(np.median(since_ns))
    varies = np.quantile(np.abs(since_ns - phase_ns), CONSTANT_SHARE) > tolerance
    if varies or abs(float(np.median(np.diff(frames_t_ns))) - step_ns) > tolerance:
        return None
    return phase_ns / NS_PER_S if tolerance < phase_ns < step_ns - tolerance else None


def _expected(sequence: Sequence) -> tuple[float, float]:
    """Return the offset (s) that the pairing of twists implies, and the largest difference that is no fault."""
    if not isinstance(sequence.motion, TwistSamples):
        return 0.0, LEAST_OFFSET_S
    step_s = usual_step_s(sequence.motion.t_ns)
    least_s = max(LEAST_OFFSET_S, LEAST_OFF_FRAMES * step_s)
    if is_stamped_at_frames(sequence):
        least_s = LEAST_TWIST_INTERVALS * step_s
    return (LAG[sequence.motion.pairing] - 0.5) * step_s, least_s


def _shifted(sequence: Sequence, offset_s: float) -> Sequence:
    shifted = replace(sequence, frames_t_ns=sequence.frames_t_ns + round(offset_s * NS_PER_S))
    motion_t_ns = sequence.motion.t_ns
    inside = (shifted.frames_t_ns >= motion_t_ns[0]) & (shifted.frames_t_ns <= motion_t_ns[-1])
    return shifted if inside.all() else shifted.with_frames(np.flatnonzero(inside))


# Where only a change larger than this (s) would be found, the finding is undecided and says so.
LARGEST_CHANGE_S = 0.1


@beside_camera
def clock_change(evidence: Evidence, intervals: Intervals) -> Symptom | Undecided | None:
    """Compare the offsets of camera and samples in both halves of the recording, equal with clocks of one rate.

    With an IMU the change is an unknown of the self-calibration, else the difference of the offsets by rotations.
    """
    found = _fitted_change(evidence, intervals) or change_of_offset(evidence.sequence, intervals)
    if found is None:
        return Undecided("too little change of rotation in half of the recording: whether the clocks drift is unknown")
    change_s, error_s = found.value, found.error
    least_s = least_change_s(evidence.sequence, error_s)
    if least_s > LARGEST_CHANGE_S:
        known = f"a change of the offset by less than {least_s:.2g} s between the halves would not show"
        return Undecided(f"too little change of rotation: {known}")
    if abs(change_s) < least_s:
        return None
    by = f"{1e3 * change_s:.0f} +- {1e3 * error_s:.0f} ms from the first half of the recording to the second"
    return Symptom.warning(f"the offset of frames and motion samples changes by {by}", ONE_CLOCK)


def _fitted_change(evidence: Evidence, intervals: Intervals) -> Scalar | None:
    """Return the change (s) by the self-calibration; rotations of half a short recording may agree at a wrong shift."""
    found = evidence.self_calibration
    if found is not None and found.windows == 1:
        found = self_calibration(evidence.sequence, evidence.camera_motion, intervals, fewest_windows=2)
    if found is None or found.windows == 1:
        return None
    return Scalar(float(found.value[CHANGE]), float(found.error[CHANGE]))
