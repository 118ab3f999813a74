"""Motion samples that come more rarely than frames: what happens between two of them nothing has measured."""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.intervals import is_comparable
from toolkit.audit.time_gap import GAP_RATIO
from toolkit.resampling import NS_PER_S


def check(evidence: Evidence) -> Symptom | None:
    """Compare the usual step of the samples with that of the frames; more of those in one is what a hole would be."""
    sequence = evidence.sequence
    if sequence.motion.t_ns.size < 2 or sequence.frame_count < 2 or not is_comparable(sequence):
        return None
    step_s, frame_s = (
        float(np.median(np.diff(t_ns))) / NS_PER_S for t_ns in (sequence.motion.t_ns, sequence.frames_t_ns)
    )
    if step_s <= GAP_RATIO * frame_s:
        return None
    return Symptom(
        count=int(sequence.motion.t_ns.size),
        detail=f"motion samples come every {step_s:.2g} s and frames every {frame_s:.2g} s",
        treatment="between two samples the motion is a straight line, whose error no stated noise holds",
        remedy=None,
        harmful=False,
        warns=True,
    )


FAULT = Fault(
    "sparse-motion",
    "motion samples that come more rarely than frames",
    check,
    after=("time-gap", "outside-motion"),
)
