"""A recording without any sighting that does not state that it was made without a camera."""

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.sequence import NO_FEATURES


def check(evidence: Evidence) -> Symptom | None:
    """Count the frames if none has a sighting, unless the recording states that it has none."""
    sequence = evidence.sequence
    if len(sequence.observations) or not sequence.frame_count or NO_FEATURES in sequence.provenance.facts:
        return None
    return Symptom(
        count=sequence.frame_count,
        detail=f"none of {sequence.frame_count} frames has a stereo sighting",
        treatment="only dead reckoning can be compared: check the tracker that made the recording",
        remedy=None,
    )


FAULT = Fault("no-sightings", "frames none of which has a sighting, in a recording with a camera", check)
