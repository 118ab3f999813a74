"""Single values that no sensor gives, by a flipped bit or a failed parse; one of them can ruin a whole run.

A twist that differs from both neighbours by more than a vehicle's velocity can change is not a motion of the vehicle,
even if its value is possible. With an IMU, a single sample that differs from its neighbours, while those do not differ
from theirs, is not a motion either: a knock shows in several samples, or happens again.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.edits import keep_samples
from toolkit.geometry import Array, BoolArray
from toolkit.models.gating import MAD_TO_SIGMA
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# Values beyond any image (px), vehicle (m/s), accelerometer (m/s^2) and gyro (rad/s).
MOST_PX, MOST_MPS, MOST_MPS2, MOST_RADPS = 1e5, 1e3, 1e4, 1e3
# Rates of change (m/s^2, rad/s^2) of a vehicle's velocity and rate of rotation that no vehicle reaches in both
# directions within two samples: one and a half times gravity, and the same number.
MOST_CHANGE = 15.0
# A single sample of an accelerometer or gyro that differs from its neighbours by more is not a knock (m/s^2, rad/s).
MOST_STEP = np.repeat([500.0, 10.0], 3)
# Least difference of a sample that stands alone (m/s^2, rad/s): a smaller one matters no more than noise.
LEAST_ALONE = np.repeat([2.0, 0.2], 3)
# A sample stands alone if the steps next to its own are less than this share of its own. If more than this share of the
# samples, and more than three, stand alone, they are usual for the sensor, as on a walking robot.
ALONE, MOST_ALONE, FEWEST_ALONE = 0.2, 1e-3, 3
# Noise alone may exceed these limits at a high rate, so a step must also exceed this many standard deviations of the
# steps. Sound recordings have 5 at most, twists of a hand-held rig (dataset3) 20 and 40, which are below MOST_CHANGE.
BEYOND_STEPS = 20.0
# A wrong unit makes all samples too large; a single one exceeds this many times the median.
BEYOND_MEDIAN = 1e3


def check(evidence: Evidence) -> Symptom | None:
    """Count sightings and motion samples beyond anything physical; drop them."""
    sequence = evidence.sequence
    sightings: BoolArray = np.asarray((np.abs(sequence.observations.uv_px) > MOST_PX).any(axis=1))
    samples = _implausible_samples(sequence)
    if not (sightings.any() or samples.any()):
        return None
    remedy = sequence
    if sightings.any():
        remedy = replace(remedy, observations=sequence.observations.select(~sightings))
    if samples.any():
        remedy = keep_samples(remedy, ~samples)
    return Symptom(
        count=int(sightings.sum() + samples.sum()),
        detail=(
            f"{sightings.sum()} sighting(s) and {samples.sum()} motion sample(s) are beyond the range of any sensor, "
            f"up to {_largest(sequence, sightings, samples):.3g}"
        ),
        treatment="dropped; the neighbouring motion samples bridge the interval",
        remedy=remedy,
    )


def _implausible_samples(sequence: Sequence) -> BoolArray:
    """Say which motion samples (S,) are beyond the limits and far from the others, or differ as no motion does."""
    most_linear = MOST_MPS if sequence.motion_kind == "twist" else MOST_MPS2
    size = np.abs(sequence.motion.values)
    beyond = np.zeros(len(size), dtype=bool)
    for columns, most in ((size[:, :3], most_linear), (size[:, 3:], MOST_RADPS)):
        largest = columns.max(axis=1, initial=0.0)
        if largest.size:
            beyond |= (largest > most) & (largest > BEYOND_MEDIAN * np.median(largest))
    return beyond | _leaps(sequence)


def _leaps(sequence: Sequence) -> BoolArray:
    """Say which samples (S,) differ from both neighbours in the same direction by more than a motion can."""
    values, t_s = sequence.motion.values, sequence.motion.t_ns / NS_PER_S
    leaps = np.zeros(len(values), dtype=bool)
    if sequence.motion_kind == "none" or len(values) < 3:
        return leaps
    step, step_s = np.diff(values, axis=0), np.diff(t_s)[:, None]
    least = BEYOND_STEPS * MAD_TO_SIGMA * np.median(np.abs(step), axis=0)
    if sequence.motion_kind == "twist":
        leaps[1:-1] = _there_and_back(step, np.maximum(MOST_CHANGE * step_s, least)).any(axis=1)
        return leaps
    leaps[1:-1] = _there_and_back(step, np.maximum(MOST_STEP, least)).any(axis=1)
    return leaps | _alone(step, np.maximum(LEAST_ALONE, least))


def _there_and_back(step: Array, least: Array) -> BoolArray:
    """Say for which inner samples (S - 2, d) both steps (S - 1, d) exceed the least and have opposite signs."""
    far = np.abs(step) > least
    return np.asarray(far[1:] & far[:-1] & (np.sign(step[1:]) * np.sign(step[:-1]) < 0.0))


def _alone(step: Array, least: Array) -> BoolArray:
    """Say which samples (S,) differ from their neighbours, by steps (S - 1, d), while those do not differ from theirs.

    None where there are too many.
    """
    alone = np.zeros(len(step) + 1, dtype=bool)
    size = np.abs(step)
    beside = np.maximum(size[:-3], size[3:])  # steps from its two neighbours to the next samples
    quiet = beside < ALONE * np.minimum(size[1:-2], size[2:-1])
    alone[2:-2] = (_there_and_back(step, least)[1:-1] & quiet).any(axis=1)
    return alone if alone.sum() <= max(FEWEST_ALONE, MOST_ALONE * alone.size) else np.zeros_like(alone)


def _largest(sequence: Sequence, sightings: BoolArray, samples: BoolArray) -> float:
    bad: tuple[Array, ...] = (sequence.observations.uv_px[sightings], sequence.motion.values[samples])
    return max(float(np.abs(values).max(initial=0.0)) for values in bad)


FAULT = Fault(
    "implausible",
    "single sightings or motion samples beyond the range of any sensor",
    check,
    after=("not-finite", "time-order"),
)
