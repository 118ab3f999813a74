"""Single values no sensor gives: a flipped bit or a failed parse, of which one ruins a whole run.

Odometry has a vehicle behind it: one sample that leaves both its neighbours, and comes back, faster than any vehicle
can is none of its motion, however plausible the value is. Of an IMU one sample that stands alone, with quiet ones on
either side, is no motion either: what knocks a sensor shows in several samples, or knocks it again.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.edits import keep_samples
from toolkit.audit.parts.robust import MAD_TO_SIGMA
from toolkit.geometry import Array, BoolArray
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# Beyond any image (px), vehicle (m/s), accelerometer (m/s^2) and gyro (rad/s).
MOST_PX, MOST_MPS, MOST_MPS2, MOST_RADPS = 1e5, 1e3, 1e4, 1e3
# Beyond what any vehicle's velocity and rate of rotation change by, there and back (m/s^2, rad/s^2): one and a half
# times gravity, and as much.
MOST_CHANGE = 15.0
# A single sample of an accelerometer and a gyro that is off its neighbours by more is no knock (m/s^2, rad/s).
MOST_STEP = np.repeat([500.0, 10.0], 3)
# One that stands alone counts from these on: less moves a vehicle by no more than noise does.
LEAST_ALONE = np.repeat([2.0, 0.2], 3)
# Alone is a sample beside which the steps are less than this share of its own; more than so many in a thousand are the
# sensor's way, as of legs that strike the ground.
ALONE, MOST_ALONE, FEWEST_ALONE = 0.2, 1e-3, 3
# Noise may step further where samples come fast: single ones are beyond this many standard deviations of such steps.
# Sound recordings have 5 of them at most, a hand-held rig's twists (dataset3) 20 and 40, which no vehicle's change
# exceeds.
BEYOND_STEPS = 20.0
# A unit makes all samples too large; single ones are beyond this many times the median.
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
            f"{sightings.sum()} sighting(s) and {samples.sum()} motion sample(s) are beyond anything a sensor gives, "
            f"up to {_largest(sequence, sightings, samples):.3g}"
        ),
        treatment="dropped; the neighbouring motion samples bridge the interval",
        remedy=remedy,
    )


def _implausible_samples(sequence: Sequence) -> BoolArray:
    """Say which motion samples (S,) hold a value that is neither physical nor like the others."""
    most_linear = MOST_MPS if sequence.motion_kind == "twist" else MOST_MPS2
    size = np.abs(sequence.motion.values)
    beyond = np.zeros(len(size), dtype=bool)
    for columns, most in ((size[:, :3], most_linear), (size[:, 3:], MOST_RADPS)):
        largest = columns.max(axis=1, initial=0.0)
        if largest.size:
            beyond |= (largest > most) & (largest > BEYOND_MEDIAN * np.median(largest))
    return beyond | _leaps(sequence)


def _leaps(sequence: Sequence) -> BoolArray:
    """Say which samples (S,) leave their neighbours on both sides, the same way, as no motion does."""
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
    """Say of which samples but the ends (S - 2, d) both steps (S - 1, d) are beyond the least, and opposite."""
    far = np.abs(step) > least
    return np.asarray(far[1:] & far[:-1] & (np.sign(step[1:]) * np.sign(step[:-1]) < 0.0))


def _alone(step: Array, least: Array) -> BoolArray:
    """Say which samples (S,) leave their neighbours, by steps (S - 1, d), while those stay where they are.

    Of too many none is said to.
    """
    alone = np.zeros(len(step) + 1, dtype=bool)
    size = np.abs(step)
    beside = np.maximum(size[:-3], size[3:])  # of the sample's two neighbours to those next to them
    quiet = beside < ALONE * np.minimum(size[1:-2], size[2:-1])
    alone[2:-2] = (_there_and_back(step, least)[1:-1] & quiet).any(axis=1)
    return alone if alone.sum() <= max(FEWEST_ALONE, MOST_ALONE * alone.size) else np.zeros_like(alone)


def _largest(sequence: Sequence, sightings: BoolArray, samples: BoolArray) -> float:
    bad: tuple[Array, ...] = (sequence.observations.uv_px[sightings], sequence.motion.values[samples])
    return max(float(np.abs(values).max(initial=0.0)) for values in bad)


FAULT = Fault(
    "implausible",
    "single sightings or motion samples beyond anything a sensor gives",
    check,
    after=("not-finite", "time-order"),
)
