"""Tracks with correlated errors: the tracked corner drifts, or a stereo match is wrong along the whole track.

Three sightings of a track give two one-step residuals about the camera's own motion. If the errors of sightings are
independent, the error of the second sighting is in both residuals with opposite signs, and their correlation is -1/2.
If the errors are a random walk, the residuals are independent and the correlation is 0. A wrong disparity gives a wrong
depth and residuals of the same sign. Estimators assume white noise unless a setting or the recording says otherwise.
"""

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.intervals import LEAST_INTERVALS
from toolkit.audit.parts.one_step import CORRELATION_SIGMAS, MOST_CORRELATION


def check(evidence: Evidence) -> Symptom | None:
    """Report the correlation of neighbouring one-step residuals where it is not that of independent errors."""
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
