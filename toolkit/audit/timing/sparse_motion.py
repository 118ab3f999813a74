"""Motion samples that come more rarely than frames: the motion between two of them was not measured."""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.intervals import is_comparable
from toolkit.audit.parts.stamps import GAP_RATIO
from toolkit.resampling import NS_PER_S

# A vehicle turns and stops within this time (s). Samples with a longer step, and with so many frames in one step, do
# not represent its motion.
MOST_STEP_S, MOST_RATIO = 2.0, 20.0


def check(evidence: Evidence) -> Symptom | None:
    """Compare the usual step of the samples with that of the frames; the limit is the ratio that makes a gap."""
    sequence = evidence.sequence
    if sequence.motion.t_ns.size < 2 or sequence.frame_count < 2 or not is_comparable(sequence):
        return None
    step_s, frame_s = (
        float(np.median(np.diff(t_ns))) / NS_PER_S for t_ns in (sequence.motion.t_ns, sequence.frames_t_ns)
    )
    if step_s <= GAP_RATIO * frame_s:
        return None
    detail = f"motion samples come every {step_s:.2g} s and frames every {frame_s:.2g} s"
    if step_s > max(MOST_STEP_S, MOST_RATIO * frame_s):
        return Symptom(
            count=int(sequence.motion.t_ns.size),
            detail=detail,
            treatment="too few to be used, as where their stamps are in another unit than the frames': check both",
            remedy=None,
            spoils_vision=True,
        )
    return Symptom.warning(
        count=int(sequence.motion.t_ns.size),
        detail=detail,
        treatment=(
            "between two samples the motion is interpolated linearly, with an error that no stated noise includes"
        ),
    )


FAULT = Fault(
    "sparse-motion",
    "motion samples that come more rarely than frames",
    check,
    after=("time-gap", "outside-motion"),
)
