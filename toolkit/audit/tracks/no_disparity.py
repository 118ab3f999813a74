"""Stereo sightings whose disparity is zero or negative: a point at infinity, or behind the camera."""

from dataclasses import replace

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.models.stereo import disparity_px


def check(evidence: Evidence) -> Symptom | None:
    """Count the sightings with uL - uR <= 0 and drop them; their tracks continue."""
    observations = evidence.sequence.observations
    bad = disparity_px(observations.uv_px) <= 0.0
    count = int(bad.sum())
    if count == 0:
        return None
    return Symptom(
        count=count,
        detail=f"{count} of {len(observations)} sightings have a disparity <= 0 ({count / len(observations):.2%})",
        treatment="dropped",
        remedy=replace(evidence.sequence, observations=observations.select(~bad)),
    )


FAULT = Fault(
    "no-disparity",
    "stereo sightings with a disparity uL - uR <= 0",
    check,
    # A dropped sighting would look like a track that was absent and returned.
    after=("stale-frames", "returning-tracks", "swapped-coordinates"),
)
