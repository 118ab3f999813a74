"""Tracks with correlated errors: the tracked corner drifts, or a stereo match is wrong along the whole track.

Three sightings of a track give two one-step residuals about the camera's own motion. If the errors of sightings are
independent, the error of the second sighting is in both residuals with opposite signs, and their correlation is -1/2.
If the errors are a random walk, the residuals are independent and the correlation is 0. A wrong disparity gives a wrong
depth and residuals of the same sign.
"""

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.intervals import LEAST_INTERVALS
from toolkit.audit.parts.one_step import CORRELATION_SIGMAS, MOST_CORRELATION


def check(evidence: Evidence) -> Symptom | None:
    """Report the correlation of neighbouring one-step residuals where it is not that of independent errors."""
    if evidence.spoilt_by:
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
            f"the errors of a track's sightings are correlated: from one step to the next by {value:+.2f} "
            f"+- {error:.2f}, where independent errors have -0.5"
        ),
        treatment="measured, so that tracks count for less (noise.track_weight); 'vislam card' shows the correlation",
    )


FAULT = Fault(
    "correlated-tracks",
    "tracks whose sightings have correlated errors",
    check,
    after=("track-scatter",),
)
