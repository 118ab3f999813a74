"""Stamps of frames or motion samples that repeat, run backwards, or are no time at all."""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.subsets import keep_frames, keep_samples
from toolkit.geometry import IntArray

# What a cast of NaN to int64 gives.
NOT_A_TIME = np.iinfo(np.int64).min

# With more of the stamps late than this the order itself is wrong, not some of the stamps.
MOST_LATE = 0.5


def check(evidence: Evidence) -> Symptom | None:
    """Count the stamps that are not after all the stamps before them; sort, first of equals kept."""
    sequence = evidence.sequence
    frames, samples = _late(sequence.frames_t_ns), _late(sequence.motion.t_ns)
    if frames + samples == 0:
        return None
    detail = f"{frames} frame stamp(s) and {samples} motion-sample stamp(s) are not after the ones before them"
    if max(frames / sequence.frame_count, samples / sequence.motion.t_ns.size) > MOST_LATE:
        why = "time runs backwards or stands still; sorting would play the recording backwards: mend the stamps"
        return Symptom(count=frames + samples, detail=detail, treatment=why, remedy=None)
    remedy = sequence
    if frames:
        remedy = keep_frames(remedy, _in_order(sequence.frames_t_ns))
    if samples:
        remedy = keep_samples(remedy, _in_order(sequence.motion.t_ns))
    return Symptom(
        count=frames + samples,
        detail=detail,
        treatment="sorted by time; of equal stamps the first is kept; stamps that are no time are dropped",
        remedy=remedy,
    )


def _late(t_ns: IntArray) -> int:
    """Count the stamps that are no time, or not after every valid stamp before them."""
    latest_before = np.maximum.accumulate(np.concatenate([[NOT_A_TIME], t_ns[:-1]]))
    return int(np.sum(t_ns <= latest_before)) if t_ns.size else 0


def _in_order(t_ns: IntArray) -> IntArray:
    """Return the rows that sort the stamps, without repeats (the first wins) and without invalid ones."""
    _, first_row = np.unique(t_ns, return_index=True)
    rows: IntArray = first_row[t_ns[first_row] != NOT_A_TIME]
    return rows


FAULT = Fault("time-order", "time stamps that repeat, run backwards or are no time at all", check)
