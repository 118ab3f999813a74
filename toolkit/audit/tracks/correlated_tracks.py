"""Tracks whose sightings do not err each by itself: a corner that drifts, or a stereo match that is off for good.

Between three sightings of a track lie two one-step residuals about the camera's own motion. Where sightings err by
themselves, the second's error is in both with opposite signs, and their correlation is -1/2. Where errors are a random
walk, what is new in each is its own, and it is 0; a wrong disparity makes wrong depths, whose residuals are alike. It
is white noise that estimators are told unless a setting or the recording says otherwise.
"""

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.intervals import LEAST_INTERVALS
from toolkit.audit.parts.one_step import CORRELATION_SIGMAS, MOST_CORRELATION


def check(evidence: Evidence) -> Symptom | None:
    """Tell the correlation of neighbouring one-step residuals where it is not that of independent errors."""
    sequence = evidence.sequence
    if evidence.spoilt_by or sequence.rig.track_noise is not None:
        return None
    if evidence.camera_motion.known.sum() < LEAST_INTERVALS:
        return None
    found = evidence.step_correlation
    if found is None:
        return None
    value, error = found
    if value < MOST_CORRELATION + CORRELATION_SIGMAS * error:
        return None
    return Symptom.information(
        count=1,
        detail=(
            f"the errors of a track's sightings go together: from one step to the next their correlation is "
            f"{value:+.2f} +- {error:.2f}, where it is -0.5 if each errs by itself; to count them as white is too sure"
        ),
        treatment="'vislam card' shows how, noise.tracks=fitted tells them",
    )


FAULT = Fault(
    "correlated-tracks",
    "tracks whose sightings do not err each by itself, as estimators are told unless a setting says otherwise",
    check,
    after=("track-scatter",),
)
