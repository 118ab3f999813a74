"""Gaps in time: in the motion samples, where the motion is not measured, and in the frames.

A gap in the frames alone is reported as information, because the motion samples cover it. A long gap in the motion
samples is a fault: no measurement says how the vehicle moved, and no noise model covers interpolation over it. The
longest stretch without such a gap is kept. The relative pose of the other stretches was not measured.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.edits import keep_frames
from toolkit.audit.parts.stamps import GAP_RATIO
from toolkit.geometry import IntArray
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# Shorter gaps (s) in the motion samples, such as a dropped sample of a fast IMU, are interpolated (`motion_gap`).
MOTION_GAP_S = 1.5


def check(evidence: Evidence) -> Symptom | None:
    """Find gaps in the motion samples and keep the longest stretch between them; else find gaps in the frames."""
    sequence = evidence.sequence
    holes = _holes(sequence.motion.t_ns, MOTION_GAP_S)
    # Gaps outside the time of the frames do not matter.
    inside = (sequence.motion.t_ns[holes + 1] > sequence.frames_t_ns[:1]) & (
        sequence.motion.t_ns[holes] < sequence.frames_t_ns[-1:]
    )
    return _motion_symptom(sequence, holes[inside]) if inside.any() else _frames_symptom(sequence)


def _holes(t_ns: IntArray, least_s: float) -> IntArray:
    """Return the rows after which the next stamp is too far away."""
    step_s = np.diff(t_ns) / NS_PER_S
    if step_s.size == 0:
        return np.empty(0, dtype=np.int64)
    return np.flatnonzero(step_s > max(least_s, GAP_RATIO * float(np.median(step_s))))


def _motion_symptom(sequence: Sequence, holes: IntArray) -> Symptom:
    t_ns = sequence.motion.t_ns
    longest_s = float((t_ns[holes + 1] - t_ns[holes]).max()) / NS_PER_S
    # A frame at the edge of a gap belongs to the adjacent stretch.
    stretch = np.searchsorted(t_ns[holes + 1], sequence.frames_t_ns, side="right")
    in_hole = np.searchsorted(t_ns[holes], sequence.frames_t_ns, side="left") > stretch
    sizes = np.bincount(stretch[~in_hole], minlength=1)
    kept = np.flatnonzero(~in_hole & (stretch == np.argmax(sizes)))
    return Symptom(
        count=holes.size,
        detail=f"{holes.size} hole(s) in the motion samples, the longest of {longest_s:.2f} s",
        treatment=f"the longest stretch without one is kept: {kept.size} of {sequence.frame_count} frames",
        remedy=keep_frames(sequence, kept),
    )


def _frames_symptom(sequence: Sequence) -> Symptom | None:
    holes = _holes(sequence.frames_t_ns, 0.0)
    if holes.size == 0:
        return None
    longest_s = float(np.diff(sequence.frames_t_ns)[holes].max()) / NS_PER_S
    return Symptom.information(
        count=holes.size,
        detail=f"{holes.size} hole(s) in the frames, the longest of {longest_s:.2f} s",
        treatment="the motion samples bridge them",
    )


FAULT = Fault(
    "time-gap",
    "holes in the motion samples or in the frames",
    check,
    after=("time-order", "not-finite", "outside-motion"),
)
