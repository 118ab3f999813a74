"""Track ids that are absent for some frames and then return.

If the tracker recognised the point, an estimator that uses the id closes a loop without knowing it. If the tracker used
the id again for another point, an estimator takes two points for one.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.edits import by_track, split
from toolkit.sequence import Observations


def check(evidence: Evidence) -> Symptom | None:
    """Count the returns; each starts a new track."""
    observations = evidence.sequence.observations
    order = by_track(observations)
    same_track = np.diff(observations.track_id[order]) == 0
    absent = np.diff(observations.frame[order]) - 1
    returns = np.zeros(len(observations), dtype=bool)
    returns[order[1:]] = same_track & (absent > 0)
    count = int(returns.sum())
    if count == 0:
        return None
    gaps = absent[same_track & (absent > 0)]
    return Symptom(
        count=count,
        detail=f"{count} return(s) of a track after an absence of {gaps.min()} to {gaps.max()} frames",
        treatment="the track ends before its absence and a new one starts after it",
        remedy=replace(
            evidence.sequence,
            observations=Observations.sorted(observations.frame, split(observations, returns), observations.uv_px),
        ),
    )


FAULT = Fault(
    "returning-tracks",
    "track ids that are absent for some frames and then come back",
    check,
    after=("time-order",),  # frames in the wrong order look like absences
)
