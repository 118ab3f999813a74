"""Frames before the first or after the last motion sample."""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.edits import keep_frames
from toolkit.resampling import NS_PER_S

# With fewer frames there is no interval.
LEAST_FRAMES = 2


def check(evidence: Evidence) -> Symptom | None:
    """Count the frames outside the time of the motion samples and cut them off."""
    sequence = evidence.sequence
    frames_t_ns, motion_t_ns = sequence.frames_t_ns, sequence.motion.t_ns
    if motion_t_ns.size == 0:
        return Symptom(sequence.frame_count, "there are no motion samples", "no frame can be used", remedy=None)
    covered = (frames_t_ns >= motion_t_ns.min()) & (frames_t_ns <= motion_t_ns.max())
    count = int(np.sum(~covered))
    if count == 0:
        return None
    if sequence.frame_count - count < LEAST_FRAMES:
        frames_s, motion_s = (
            f"{t.min() / NS_PER_S:.6g} to {t.max() / NS_PER_S:.6g} s" for t in (frames_t_ns, motion_t_ns)
        )
        return Symptom(
            count=count,
            detail=f"the frames are at {frames_s} and the motion samples at {motion_s}: {count} of "
            f"{sequence.frame_count} frames lie outside",
            treatment="no motion is left: stamp both by one clock, in one unit",
            remedy=None,
        )
    return Symptom(
        count=count,
        detail=f"{count} of {sequence.frame_count} frames lie outside the time of the motion samples",
        treatment="cut off",
        remedy=keep_frames(sequence, np.flatnonzero(covered)),
    )


FAULT = Fault(
    "outside-motion",
    "frames before the first or after the last motion sample",
    check,
    after=("time-order", "not-finite", "implausible", "stuck-samples"),  # a dropped end sample uncovers a frame
)
