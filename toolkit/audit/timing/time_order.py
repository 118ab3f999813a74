"""Stamps of frames or motion samples that repeat, run backwards, jump back, or are no time."""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.edits import keep_frames, keep_samples
from toolkit.audit.parts.stamps import NOT_A_TIME
from toolkit.geometry import IntArray
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# A forward step of so many usual ones means that earlier stamps were out of order; after a jump, all steps are smaller.
# So many stamps must follow a jump, so that a single stamp out of order at the end is not taken for one.
LEAP, FEWEST_AFTER = 1.9, 3

# If more than this share of the stamps is late, the whole order is wrong, and sorting is no repair.
MOST_LATE = 0.5


def check(evidence: Evidence) -> Symptom | None:
    """Count the stamps that are not after all stamps before them; sort them and keep the first of equal ones.

    After a clock jumped back, sorting would interleave two times, so only the longest stretch between jumps is kept.
    """
    sequence = evidence.sequence
    frames, samples = _late(sequence.frames_t_ns), _late(sequence.motion.t_ns)
    if frames + samples == 0:
        return None
    detail = f"{frames} frame stamp(s) and {samples} motion-sample stamp(s) are not after the ones before them"
    if max(map(_share_equal, _streams(sequence))) > MOST_LATE:
        why = "most are equal to the one before them, as stamps are that were rounded: write them with all their digits"
        return Symptom(count=frames + samples, detail=detail, treatment=why, remedy=None)
    if max(map(_share_back, _streams(sequence))) > MOST_LATE:
        why = "time runs backwards or stands still; sorting would play the recording backwards: correct the stamps"
        return Symptom(count=frames + samples, detail=detail, treatment=why, remedy=None)
    jumps_s = [jump_s for t_ns in _streams(sequence) for jump_s in _jump_lengths_s(t_ns)]
    if jumps_s:
        detail += f": the clock jumps back by {max(jumps_s):.2f} s and goes on from there"
        remedy = _between_jumps(sequence)
        treatment = f"the longest stretch without a jump is kept: {remedy.frame_count} of {sequence.frame_count} frames"
        return Symptom(count=frames + samples, detail=detail, treatment=treatment, remedy=remedy)
    if max(frames / sequence.frame_count, samples / sequence.motion.t_ns.size) > MOST_LATE:
        why = "time runs backwards or stands still; sorting would play the recording backwards: correct the stamps"
        return Symptom(count=frames + samples, detail=detail, treatment=why, remedy=None)
    return Symptom(
        count=frames + samples,
        detail=detail,
        treatment="sorted by time; of equal stamps the first is kept; stamps that are no time are dropped",
        remedy=_sorted(sequence),
    )


def _streams(sequence: Sequence) -> tuple[IntArray, IntArray]:
    return sequence.frames_t_ns, sequence.motion.t_ns


def _share_back(t_ns: IntArray) -> float:
    """Return the share of the steps that are negative or zero."""
    return float(np.mean(np.diff(t_ns) <= 0)) if t_ns.size > 1 else 0.0


def _share_equal(t_ns: IntArray) -> float:
    """Return the share of the stamps that repeat the one before them."""
    return float(np.mean(np.diff(t_ns) == 0)) if t_ns.size > 1 else 0.0


def _sorted(sequence: Sequence) -> Sequence:
    """Return the sequence with stamps in order, without repeats and invalid ones."""
    if _late(sequence.frames_t_ns):
        sequence = keep_frames(sequence, _in_order(sequence.frames_t_ns))
    if _late(sequence.motion.t_ns):
        sequence = keep_samples(sequence, _in_order(sequence.motion.t_ns))
    return sequence


def _jumps(t_ns: IntArray) -> IntArray:
    """Return the rows after which the clock has jumped back and goes on at its usual step.

    After a stamp, or a block of stamps, that is merely out of order, time jumps forward to where it was.
    """
    step_ns = np.diff(t_ns)
    if t_ns.size < 3 or (t_ns == NOT_A_TIME).any():
        return np.empty(0, dtype=np.int64)
    usual_ns = float(np.median(np.abs(step_ns)))
    backwards = np.flatnonzero(step_ns < 0)
    return np.array([row for row in backwards.tolist() if _goes_on(t_ns, row, usual_ns)], dtype=np.int64)


def _jump_lengths_s(t_ns: IntArray) -> list[float]:
    """Return the length (s) of each jump, from the expected next stamp back to the actual one."""
    step_ns = np.diff(t_ns)
    due_ns = np.median(np.abs(step_ns)) if step_ns.size else 0.0
    return [float(due_ns - step_ns[row]) / NS_PER_S for row in _jumps(t_ns).tolist()]


def _goes_on(t_ns: IntArray, row: int, usual_ns: float) -> bool:
    latest = t_ns[: row + 1].max()
    later = np.flatnonzero(t_ns[row + 1 :] > latest)
    end = row + 1 + int(later[0]) if later.size else t_ns.size  # the first stamp that is new, or none
    if end - row <= FEWEST_AFTER and not later.size:
        return False  # too few stamps follow to decide
    return bool(np.diff(t_ns[row + 1 : end + 1]).max(initial=0) < LEAP * usual_ns)


def _between_jumps(sequence: Sequence) -> Sequence:
    """Return the longest stretch, in frames, between two jumps, with its samples; of equal ones the first."""
    frames_t_ns, samples_t_ns = _streams(sequence)
    frame_part = _parts(frames_t_ns)
    sample_part = _parts(samples_t_ns)
    part = int(np.argmax(np.bincount(frame_part)))
    kept = keep_frames(sequence, np.flatnonzero(frame_part == part))
    if sample_part.max(initial=0):
        of_part = part if sample_part.max() == frame_part.max() else int(np.argmax(np.bincount(sample_part)))
        kept = keep_samples(kept, sample_part == of_part)
    return _sorted(kept)


def _parts(t_ns: IntArray) -> IntArray:
    """Return for each stamp (N,) the number of jumps before it."""
    part = np.zeros(t_ns.size, dtype=np.int64)
    part[_jumps(t_ns) + 1] = 1
    return np.cumsum(part)


def _late(t_ns: IntArray) -> int:
    """Count the stamps that are no time, or not after every valid stamp before them."""
    latest_before = np.maximum.accumulate(np.concatenate([[NOT_A_TIME], t_ns[:-1]]))
    return int(np.sum(t_ns <= latest_before)) if t_ns.size else 0


def _in_order(t_ns: IntArray) -> IntArray:
    """Return the rows that sort the stamps, without invalid ones, and of repeated ones only the first."""
    _, first_row = np.unique(t_ns, return_index=True)
    rows: IntArray = first_row[t_ns[first_row] != NOT_A_TIME]
    return rows


FAULT = Fault(
    "time-order",
    "time stamps that repeat, run backwards, jump back or are no time at all",
    check,
    after=("clock-jump",),
)
