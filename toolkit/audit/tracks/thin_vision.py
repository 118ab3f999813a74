"""Times at which the tracks are too few to determine the camera's motion: darkness, a bare wall, a lost tracker."""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.intervals import is_comparable
from toolkit.geometry import BoolArray
from toolkit.resampling import NS_PER_S

# Least length (s) of a span: every estimator bridges shorter ones by the motion samples.
LEAST_S = 0.5


def check(evidence: Evidence) -> Symptom | None:
    """Report the spans in which the camera's own motion is not determined."""
    sequence = evidence.sequence
    if evidence.spoilt_by or not len(sequence.observations) or not is_comparable(sequence):
        return None
    known = evidence.camera_motion.known
    frame_s = (sequence.frames_t_ns - sequence.frames_t_ns[0]) / NS_PER_S
    # A single interval of that length is a gap in the frames, which time-gap reports.
    spans = [run for run in _runs(~known) if run[1] - run[0] > 1 and frame_s[run[1]] - frame_s[run[0]] >= LEAST_S]
    if not spans:
        return None
    longest = max(spans, key=lambda span: frame_s[span[1]] - frame_s[span[0]])
    share = sum(end - begin for begin, end in spans) / known.size
    seen = len(sequence.observations) / sequence.frame_count
    return Symptom.warning(
        count=len(spans),
        detail=(
            f"the tracks do not determine the camera's motion for {share:.0%} of the time, the longest at "
            f"{frame_s[longest[0]]:.1f}-{frame_s[longest[1]]:.1f} s ({seen:.1f} sightings a frame over all)"
        ),
        treatment="there every estimate rests on the motion samples, or on a few tracks that may be wrong",
        spans_ns=tuple((int(sequence.frames_t_ns[begin]), int(sequence.frames_t_ns[end])) for begin, end in spans),
    )


def _runs(marked: BoolArray) -> list[tuple[int, int]]:
    """Return begin and end of every run of marked entries (n,), the end being the index after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


FAULT = Fault(
    "thin-vision",
    "too few tracks to determine the camera's motion, for half a second or more",
    check,
    after=("no-sightings", "stale-frames", "no-disparity", "time-gap", "intrinsics", "units"),
)
