"""Sightings and motion samples that hold NaN or infinity; a column without a finite value is named."""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.edits import keep_samples
from toolkit.geometry import Array, BoolArray
from toolkit.sequence import is_measured

COORDINATES = ("uL", "uR", "v")
CHANNELS = {"twist": ("velocity", "rate of rotation"), "imu": ("accelerometer", "gyro")}


def check(evidence: Evidence) -> Symptom | None:
    """Count the rows with a value that is not finite, and drop them; a missing right image is not a fault."""
    sequence = evidence.sequence
    sightings: BoolArray = is_measured(sequence.observations.uv_px)
    samples: BoolArray = np.asarray(np.isfinite(sequence.motion.values).all(axis=1))
    bad_sightings, bad_samples = int(np.sum(~sightings)), int(np.sum(~samples))
    if bad_sightings + bad_samples == 0:
        return None
    uv_px, values = sequence.observations.uv_px, sequence.motion.values
    empty = _empty(uv_px[:, [0, 2]], (COORDINATES[0], COORDINATES[2]))
    if sequence.motion_kind != "none":
        names = (f"{sensor} {axis}" for sensor in CHANNELS[sequence.motion_kind] for axis in "xyz")
        empty += _empty(values, tuple(names))
    detail = f"{bad_sightings} sighting(s) and {bad_samples} motion sample(s) are not finite"
    detail += f" ({', '.join(empty)} in all of them)" if empty else ""
    if bad_samples and not samples.any():
        why = "no motion sample is left: check the program that wrote them"
        return Symptom(bad_sightings + bad_samples, detail, why, remedy=None, spoils_vision=True)
    remedy = sequence
    if bad_sightings:
        remedy = replace(remedy, observations=sequence.observations.select(sightings))
    if bad_samples:
        remedy = keep_samples(remedy, samples)
    return Symptom(
        count=bad_sightings + bad_samples,
        detail=detail,
        treatment="dropped; the neighbouring motion samples bridge the interval",
        remedy=remedy,
    )


def _empty(values: Array, names: tuple[str, ...]) -> list[str]:
    """Name the columns of values (N, n) in which nothing is finite."""
    if not len(values):
        return []
    return [name for name, column in zip(names, values.T, strict=True) if not np.isfinite(column).any()]


FAULT = Fault(
    "not-finite",
    "sightings or motion samples that hold NaN or infinity",
    check,
    after=("stale-frames", "returning-tracks"),  # a dropped sighting would look like a track that returned
)
