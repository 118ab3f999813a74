"""Observations and motion samples that hold NaN or infinity."""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.subsets import keep_samples
from toolkit.geometry import BoolArray
from toolkit.sequence import is_measured


def check(evidence: Evidence) -> Symptom | None:
    """Count the rows with a value that is not finite; drop them. That a sighting lacks the right image is no fault."""
    sequence = evidence.sequence
    sightings: BoolArray = is_measured(sequence.observations.uv_px)
    samples: BoolArray = np.asarray(np.isfinite(sequence.motion.values).all(axis=1))
    bad_sightings, bad_samples = int(np.sum(~sightings)), int(np.sum(~samples))
    if bad_sightings + bad_samples == 0:
        return None
    remedy = sequence
    if bad_sightings:
        remedy = replace(remedy, observations=sequence.observations.select(sightings))
    if bad_samples:
        remedy = keep_samples(remedy, samples)
    return Symptom(
        count=bad_sightings + bad_samples,
        detail=f"{bad_sightings} sighting(s) and {bad_samples} motion sample(s) are not finite",
        treatment="dropped; the neighbouring motion samples bridge the interval",
        remedy=remedy,
    )


FAULT = Fault(
    "not-finite",
    "sightings or motion samples that hold NaN or infinity",
    check,
    after=("stale-frames", "returning-tracks"),  # a dropped sighting would look like a track that went and came back
)
