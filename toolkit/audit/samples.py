"""Faults of the motion samples alone, or beside the sizes of motion and gravity: values, columns, units, noise."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Symptom, Undecided
from toolkit.audit.intervals import (
    FORCE,
    RATE,
    SPEED,
    Quantity,
    force_ratio,
    is_from_scatter,
    ratio_of_speeds,
    rotation_ratio,
    speed_ratio,
    stated_densities,
    usual_step_s,
)
from toolkit.audit.one_step import median_one_step_px
from toolkit.audit.robust import Scalar
from toolkit.geometry import Array, BoolArray, se3
from toolkit.measurements import NS_PER_S, ImuNoise, MotionKind, TwistNoise, is_measured
from toolkit.models.gating import MAD_TO_SIGMA
from toolkit.models.noise import white_sigma
from toolkit.motion_samples import ImuSamples, TwistSamples
from toolkit.sequence import Sequence


class Sensor(NamedTuple):
    """One of the two sensors of a kind of motion: the names of a value and of all, its columns, and their unit."""

    name: str
    plural: str
    columns: slice
    unit: str


_LINEAR, _ANGULAR = slice(0, 3), slice(3, 6)
SENSORS: dict[MotionKind, tuple[Sensor, ...]] = {
    "none": (),
    "twist": (
        Sensor("velocity", "velocities", _LINEAR, "m/s"),
        Sensor("rate of rotation", "rates of rotation", _ANGULAR, "rad/s"),
    ),
    "imu": (
        Sensor("accelerometer", "accelerations", _LINEAR, "m/s^2"),
        Sensor("gyro", "rates of rotation", _ANGULAR, "rad/s"),
    ),
}


def not_finite(evidence: Evidence) -> Symptom | None:
    sequence = evidence.sequence
    sightings: BoolArray = is_measured(sequence.observations.uv_px)
    samples: BoolArray = np.asarray(np.isfinite(sequence.motion.values).all(axis=1))
    bad_sightings, bad_samples = int(np.sum(~sightings)), int(np.sum(~samples))
    if bad_sightings + bad_samples == 0:
        return None
    uv_px, values = sequence.observations.uv_px, sequence.motion.values
    empty = _empty(uv_px[:, [0, 2]], ("uL", "v"))
    if sequence.motion_kind != "none":
        names = (f"{sensor.name} {axis}" for sensor in SENSORS[sequence.motion_kind] for axis in "xyz")
        empty += _empty(values, tuple(names))
    detail = f"{bad_sightings} sighting(s) and {bad_samples} motion sample(s) are not finite"
    detail += f" ({', '.join(empty)} in all of them)" if empty else ""
    if bad_samples and not samples.any():
        why = "no motion sample is left: check the program that wrote them"
        return Symptom(bad_sightings + bad_samples, detail, why, remedy=None, spoils_vision=True)
    return Symptom(bad_sightings + bad_samples, detail, DROPPED, _with_rows(sequence, sightings, samples))


DROPPED = "dropped; the neighbouring motion samples bridge the interval"


def _with_rows(sequence: Sequence, sightings: BoolArray, samples: BoolArray) -> Sequence:
    kept = sequence if sightings.all() else replace(sequence, observations=sequence.observations.select(sightings))
    return kept if samples.all() else kept.with_samples(samples)


def _empty(values: Array, names: tuple[str, ...]) -> list[str]:
    """Name the columns of values (N, n) in which nothing is finite."""
    if not len(values):
        return []
    return [name for name, column in zip(names, values.T, strict=True) if not np.isfinite(column).any()]


# Values beyond any image (px), vehicle (m/s), accelerometer (m/s^2) and gyro (rad/s).
MOST_PX, MOST_MPS, MOST_MPS2, MOST_RADPS = 1e5, 1e3, 1e4, 1e3
# Rates of change (m/s^2, rad/s^2) that no vehicle reaches in both directions within two samples.
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


def implausible(evidence: Evidence) -> Symptom | None:
    """Drop single values that no sensor gives, by a flipped bit or a failed parse.

    Dropped are also a twist that differs from both neighbours by more than a vehicle can, and a sample of an IMU that
    differs from neighbours that do not differ from theirs: a knock shows in several samples, or happens again.
    """
    sequence = evidence.sequence
    sightings: BoolArray = np.asarray((np.abs(sequence.observations.uv_px) > MOST_PX).any(axis=1))
    samples = _implausible_samples(sequence)
    if not (sightings.any() or samples.any()):
        return None
    bad = np.concatenate([sequence.observations.uv_px[sightings].ravel(), sequence.motion.values[samples].ravel()])
    beyond = f"are beyond the range of any sensor, up to {np.abs(bad).max():.3g}"
    detail = f"{sightings.sum()} sighting(s) and {samples.sum()} motion sample(s) {beyond}"
    return Symptom(int(sightings.sum() + samples.sum()), detail, DROPPED, _with_rows(sequence, ~sightings, ~samples))


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
    """Say which samples (S,) differ from their neighbours while those do not differ from theirs, unless too many do."""
    alone = np.zeros(len(step) + 1, dtype=bool)
    size = np.abs(step)
    beside = np.maximum(size[:-3], size[3:])  # steps from its two neighbours to the next samples
    quiet = beside < ALONE * np.minimum(size[1:-2], size[2:-1])
    alone[2:-2] = (_there_and_back(step, least)[1:-1] & quiet).any(axis=1)
    return alone if alone.sum() <= max(FEWEST_ALONE, MOST_ALONE * alone.size) else np.zeros_like(alone)


# Least number and duration (s) of equal samples in a row: beyond chance and sensors that are read too often.
LEAST_RUN, LEAST_S = 10, 0.1
# Level of significance of a run of odometry's samples, for the whole recording, and the least length of a run.
CHANCE, LEAST_RUN_OF_ODOMETRY = 1e-3, 4
# If more than this share of all samples repeats, the rest is not interpolated: it would not represent the motion.
MOST_REPEATED = 0.2
# Least duration (s) for a single axis: one axis of a coarse sensor at rest may repeat a value for a while.
LEAST_OF_AXIS_S = 1.0
# Median speed and rate of the camera below which the vehicle may stand, or drive straight ahead.
CAMERA_STANDING_MPS, STRAIGHT_RADPS = 0.1, 0.01


def stuck_samples(evidence: Evidence) -> Symptom | None:
    """Count the samples that repeat the one before in a long run, and drop them: the driver hangs.

    Real samples have noise. Odometry repeats values without a fault (at standstill, whole counts); it hangs where it
    moves and turns at once, beyond chance, or where it is zero throughout while the camera moves.
    """
    sequence = evidence.sequence
    if sequence.motion_kind == "none" or not sequence.motion.t_ns.size:
        return None
    values, t_ns = sequence.motion.values, sequence.motion.t_ns
    step_s = usual_step_s(t_ns) if t_ns.size > 1 else LEAST_S
    least = max(LEAST_RUN, round(LEAST_S / max(step_s, 1e-6)))
    if sequence.motion_kind == "twist":
        if (never := _never_moves(evidence)) is not None:
            return never
        moves_and_turns = values[:, :3].any(axis=1) & values[:, 3:].any(axis=1)
        repeated = {"odometry": _in_long_runs(values, _least_of_odometry(values, least, step_s)) & moves_and_turns}
    else:
        repeated = {one.name: _in_long_runs(values[:, one.columns], least) for one in SENSORS["imu"]}
        if (stuck_axes := _stuck_axes(values, repeated, step_s)) is not None:
            return stuck_axes
    stuck = np.logical_or.reduce(list(repeated.values()))
    if not stuck.any():
        return None
    detail = _repeats(repeated, step_s)
    if stuck.mean() > MOST_REPEATED:
        why = "too long to be bridged: check the driver and the cables"
        return Symptom(int(stuck.sum()), detail, why, remedy=None, spoils_vision=True)
    why = "repeated samples are dropped; the others bridge the gap"
    return Symptom(int(stuck.sum()), detail, why, sequence.with_samples(~stuck))


def _repeats(rows: Mapping[str, BoolArray], step_s: float) -> str:
    seconds = {name: float(here.sum()) * step_s for name, here in rows.items()}
    return ", ".join(f"the {name} repeats one value for {time:.3g} s" for name, time in seconds.items() if time)


def _least_of_odometry(values: Array, least: int, step_s: float) -> int:
    """Return how many equal samples (S, 6) of odometry in a row are a fault: 0.1 s of them, and beyond chance."""
    same = (values[1:] == values[:-1]).all(axis=1)
    lengths = np.diff(np.flatnonzero(np.concatenate([[True], ~same, [True]])))
    longest = int(lengths.max(initial=1)) - 1
    often = (same.sum() - longest + 1) / max(same.size - longest + 1, 2)  # in the rest of the recording
    if often >= 1.0:
        return least
    by_chance = 1 + int(np.ceil(np.log(CHANCE / len(values)) / np.log(often)))
    return min(max(by_chance, LEAST_RUN_OF_ODOMETRY, 1 + round(LEAST_S / max(step_s, 1e-6))), least)


def _stuck_axes(values: Array, whole: dict[str, BoolArray], step_s: float) -> Symptom | None:
    """Report single axes of an IMU (S, 6) that repeat one value while the other axes of the sensor do not."""
    least, found = max(LEAST_RUN, round(LEAST_OF_AXIS_S / max(step_s, 1e-6))), dict[str, BoolArray]()
    for sensor in SENSORS["imu"]:
        for axis, column in zip("xyz", values[:, sensor.columns].T, strict=True):
            repeats = _in_long_runs(column[:, None], least) & ~whole[sensor.name] & ~_at_an_end(column)
            found |= {f"{sensor.name} {axis}": repeats} if repeats.any() else {}
    if not found:
        return None
    why = "the true values are unknown: check the driver and the cables (real samples have noise)"
    count = int(np.logical_or.reduce(list(found.values())).sum())
    return Symptom(count, _repeats(found, step_s), why, remedy=None)


def _at_an_end(column: Array) -> BoolArray:
    """Say which values (S,) are at an end of the sensor's range: the largest or smallest, reached more than once."""
    at_end = np.zeros(column.size, dtype=bool)
    for end in (column.min(initial=np.inf), column.max(initial=-np.inf)):
        here = column == end
        if np.sum(here[1:] & ~here[:-1]) + here[:1].sum() > 1:
            at_end |= here
    return at_end


def _never_moves(evidence: Evidence) -> Symptom | None:
    camera, values = evidence.camera_motion, evidence.sequence.motion.values
    if not len(values) or camera.known.sum() < LEAST_RUN:
        return None
    findings = list[str]()
    limits = (camera.v_mps, CAMERA_STANDING_MPS, "moves"), (camera.w_radps, STRAIGHT_RADPS, "turns")
    for sensor, (seen, least, moves) in zip(SENSORS["twist"], limits, strict=True):
        usual = float(np.median(np.linalg.norm(seen[camera.known], axis=1)))
        if not values[:, sensor.columns].any() and usual > least:
            camera_moves = f"the camera {moves} at {usual:.2g} {sensor.unit}"
            findings.append(f"all {len(values)} {sensor.plural} are zero while {camera_moves} (median)")
    if not findings:
        return None
    why = "they were not recorded: check the driver and the cables"
    return Symptom(len(values), ", and ".join(findings), why, remedy=None, spoils_vision=True)


def _in_long_runs(values: Array, least: int) -> BoolArray:
    """Say which samples (S, d) repeat the one before, within a run of at least ``least`` equal ones."""
    if not len(values):
        return np.zeros(0, dtype=bool)
    same = np.concatenate([[False], (values[1:] == values[:-1]).all(axis=1)])
    begins = np.flatnonzero(~same)
    lengths = np.diff(np.append(begins, same.size))
    long = np.repeat(lengths >= least, lengths)
    # If more than half of the neighbours outside such runs are equal too, the sensor is coarse and not stuck.
    is_coarse = (~long).any() and same[~long].mean() > 0.5
    return np.asarray(same & long & ~is_coarse)


# Least number of samples at the largest value of an axis, and its ratio to that at the next: coarse sensors have more.
LEAST_COUNT, LEAST_RATIO = 10, 3.0


def saturated_samples(evidence: Evidence) -> Symptom | None:
    if evidence.sequence.motion_kind != "imu":
        return None
    values = evidence.sequence.motion.values
    findings, rows = list[str](), np.zeros(len(values), dtype=bool)
    axes = [(sensor, axis) for sensor in SENSORS["imu"] for axis in "xyz"]
    for (sensor, axis), column in zip(axes, values.T, strict=True):
        for sign in (1.0, -1.0):
            at_end = _at_range_end(sign * column)
            if at_end.any():
                rows |= at_end
                at = f"{column[at_end][0]:z.3g} {sensor.unit}"
                findings.append(f"{sensor.name} {axis} at {at} ({at_end.sum()} samples)")
    if not findings:
        return None
    detail = f"samples accumulate at the end of a range: {', '.join(findings)}"
    return Symptom.warning(detail, "values beyond it are lost: use a sensor of a larger range", int(rows.sum()))


def _at_range_end(column: Array) -> BoolArray:
    """Say which samples (S,) are at the largest value, if they are too many for a sensor within its range."""
    distinct, counts = np.unique(column, return_counts=True)
    if distinct.size < 2 or counts[-1] < max(LEAST_COUNT, LEAST_RATIO * counts[-2]):
        return np.zeros(column.size, dtype=bool)
    return np.asarray(column == distinct[-1])


# Fewer samples, or fewer different values, are not judged.
LEAST_COARSE_SAMPLES, LEAST_VALUES = 100, 5
# Rounding is reported from this share of the stated standard deviation of a sample on, as for pixels.
MOST_ROUNDING = 0.5


def coarse_samples(evidence: Evidence) -> Symptom | None:
    """Report samples that come in steps, because a converter has few bits or a log few digits.

    Rounding to steps of s adds errors of s / sqrt(12) (Bennett, "Spectra of quantized signals", 1948), which last in
    uniform motion.
    """
    sequence = evidence.sequence
    if sequence.motion_kind == "none" or sequence.motion.t_ns.size < LEAST_COARSE_SAMPLES:
        return None
    step_s = usual_step_s(sequence.motion.t_ns)
    if not step_s > 0.0:
        return None
    sigma, found = stated_densities(sequence.noise) / np.sqrt(step_s), list[str]()
    step = np.array([_step_of(column) for column in sequence.motion.values.T])
    rounding = step / np.sqrt(12.0)
    for sensor in SENSORS[sequence.motion_kind]:
        k = sensor.columns.start + int(np.argmax((rounding / sigma)[sensor.columns]))
        if rounding[k] > MOST_ROUNDING * sigma[k]:
            found.append(
                f"{sensor.plural} come in steps of {step[k]:.3g} {sensor.unit}, which adds errors of {rounding[k]:.2g} "
                f"to the {sigma[k]:.2g} {sensor.unit} stated for a sample"
            )
    if not found:
        return None
    why = "write all the digits that the sensor has, or state noise that includes the rounding"
    return Symptom.warning("; ".join(found), why, count=len(found))


def _step_of(column: Array) -> float:
    """Return the least distance of two different values (S,); 0 where few or most of the values are different."""
    distinct = np.unique(column[np.isfinite(column)])
    if not LEAST_VALUES <= distinct.size < column.size // 2:
        return 0.0
    return float(np.diff(distinct).min())


# Limit of the stated white noise over the samples', often stated too large on purpose (8 times in sound recordings).
MOST_WHITE = 40.0
# Limit of the stated random walk over the change of the samples; a true walk exceeds it less than once in ten thousand.
MOST_WALK = 3.0
LEAST_SAMPLES = 100


def overstated_noise(evidence: Evidence) -> Symptom | None:
    """Report an IMU whose stated noise is far more than its samples can have.

    White noise of density s gives samples, dt apart, a standard deviation of s / sqrt(dt), and a random walk of
    density w changes them by w sqrt(T) within a time T. Motion adds to both. Source: Woodman, "An introduction to
    inertial navigation" (2007), section 4.
    """
    motion, noise = evidence.sequence.motion, evidence.sequence.noise
    if not (isinstance(motion, ImuSamples) and isinstance(noise, ImuNoise)):
        return None
    finite = np.isfinite(motion.values).all(axis=1)
    t_s, values = (motion.t_ns[finite] - motion.t_ns[finite][:1]) / NS_PER_S, motion.values[finite]
    if t_s.size < LEAST_SAMPLES or (np.diff(t_s) <= 0).any():
        return None
    step_s, lag_s, found = float(np.median(np.diff(t_s))), 0.25 * float(t_s[-1]), list[str]()
    begin = np.flatnonzero(t_s <= t_s[-1] - lag_s)
    end = np.minimum(np.searchsorted(t_s, t_s[begin] + lag_s), t_s.size - 1)
    for name, (_, _, columns, unit) in zip(("accel", "gyro"), SENSORS["imu"], strict=True):
        stated = getattr(noise, f"{name}_noise_density") / np.sqrt(step_s)
        white = float(white_sigma(values[:, columns]).max())
        if stated > MOST_WHITE * white > 0.0:
            measured = f"measured are {white:.2g} +- {white / np.sqrt(len(values)):.1g}"
            found.append(f"by {name}_noise_density samples scatter by {stated:.3g} {unit}, and {measured}")
        stated = getattr(noise, f"{name}_random_walk") * np.sqrt(lag_s)
        moved = float(np.sqrt(np.mean((values[end, columns] - values[begin, columns]) ** 2)))  # motion included
        if stated > MOST_WALK * moved > 0.0:
            drift = f"they drift by {stated:.3g} {unit} in {lag_s:.3g} s, and measured are {moved:.3g}"
            found.append(f"by {name}_random_walk {drift}")
    treatment = (
        "estimators given this noise hardly use the IMU: check it (imu0/sensor.yaml, imu.yaml); it is a density, the "
        "standard deviation at one sample a second"
    )
    return Symptom.warning("; ".join(found), treatment, len(found)) if found else None


# Limit of the samples' own scatter over the stated one; rotors shake an accelerometer 15 times as much (V1_01_easy).
MOST_BEYOND_STATED = 20.0
QUIET_S, QUIETEST = 0.5, 0.1


def understated_noise(evidence: Evidence) -> Symptom | None:
    motion, noise = evidence.sequence.motion, evidence.sequence.noise
    if not (isinstance(motion, ImuSamples) and isinstance(noise, ImuNoise)) or motion.t_ns.size < LEAST_SAMPLES:
        return None
    # Noise in another unit is that unit's.
    force, sensors = force_ratio(evidence.sequence), {"accel": SENSORS["imu"][0], "gyro": SENSORS["imu"][1]}
    if force is not None and not 1.0 / LEAST_FACTOR < force.value < LEAST_FACTOR:
        del sensors["accel"]
    step_s, found = usual_step_s(motion.t_ns), list[str]()
    count = max(round(QUIET_S / max(step_s, 1e-6)), LEAST_SAMPLES // 5)
    for name, (_, _, columns, unit) in sensors.items():
        parts = np.array_split(motion.values[:, columns], max(len(motion.values) // count, 1))
        measured = float(np.quantile([white_sigma(part).min() for part in parts], QUIETEST))
        stated = getattr(noise, f"{name}_noise_density") / np.sqrt(step_s) if step_s > 0.0 else np.inf
        if measured > MOST_BEYOND_STATED * stated:
            quietest = f"where they are quietest they do by {measured:.2g}, {measured / stated:.0f} times as much"
            found.append(f"by {name}_noise_density samples scatter by {stated:.2g} {unit}, and {quietest}")
    treatment = "estimators given this noise trust the IMU too much: state the densities of the sensor in motion, in SI"
    return Symptom.warning("; ".join(found), f"{treatment} and not in g and degrees", len(found)) if found else None


# As given a size is wrong by more than the first factor; exchanged, both are right within the second.
LEAST_FACTOR, MOST_FACTOR = 3.0, 1.25
_OTHER_WAY = [3, 4, 5, 0, 1, 2]


def exchanged_samples(evidence: Evidence) -> Symptom | None:
    sequence, intervals = evidence.sequence, evidence.intervals
    size = _linear_ratio(evidence)
    if intervals is None or size is None or 1.0 / LEAST_FACTOR < size.value < LEAST_FACTOR:
        return None
    exchanged = evidence.after(_with_columns(sequence, lambda columns: columns[..., _OTHER_WAY]))
    size = _linear_ratio(exchanged)
    if exchanged.intervals is None or not (size is None or 1.0 / MOST_FACTOR < size.value < MOST_FACTOR):
        return None
    if not rotation_ratio(exchanged.intervals).value < MOST_FACTOR:  # the camera's noise lowers this one
        return None
    linear, angular = SENSORS[sequence.motion_kind]
    first, second = (float(np.median(np.linalg.norm(half, axis=1))) for half in np.split(sequence.motion.values, 2, 1))
    sizes = f"{first:.2g} {linear.unit} and {second:.2g} {angular.unit} (medians)"
    detail = f"{linear.plural} and {angular.plural} are exchanged: {sizes}, which are plausible the other way round"
    return Symptom(len(sequence.motion.values), detail, "exchanged back", exchanged.sequence)


def _linear_ratio(evidence: Evidence) -> Scalar | None:
    force = force_ratio(evidence.sequence)
    return speed_ratio(evidence.intervals) if force is None else force


# A specific force below this share of gravity lacks it, unless its size, averaged over this time (s), has a range of
# less than this share of it (0.2 at hand): then it is in g. Below the last share it is a bias alone.
LEAST_GRAVITY, AVERAGED_S, STEADY_RANGE, MOST_BIAS = 0.5, 0.25, 0.5, 0.06


def gravity_removed(evidence: Evidence) -> Symptom | None:
    sequence, ratio = evidence.sequence, force_ratio(evidence.sequence)
    if ratio is None or not _lacks_gravity(sequence):
        return None
    size = f"{ratio.value:.2g} times gravity (median), which changes by {_range_of_force(sequence):.0%} of that"
    why = "record the specific force, which is gravity at rest: the raw topic of the sensor, not a linear acceleration"
    detail = f"the accelerometer reads {size}: gravity was taken out of it"
    return Symptom(1, detail, why, remedy=None, spoils_vision=True)


def _lacks_gravity(sequence: Sequence) -> bool:
    """Say whether a specific force is far below gravity, and neither steady, in another unit, nor a bias at rest."""
    ratio = force_ratio(sequence)
    if ratio is None or not 0.0 < ratio.value < LEAST_GRAVITY:
        return False
    return ratio.value < MOST_BIAS or _range_of_force(sequence) > STEADY_RANGE


def _range_of_force(sequence: Sequence) -> float:
    """Return the range (5 to 95 %) of the size of the specific force, averaged over a time, over its median."""
    motion = sequence.motion
    count = max(round(AVERAGED_S / max(usual_step_s(motion.t_ns), 1e-6)), 1)
    parts = np.array_split(motion.values[:, _LINEAR], max(len(motion.values) // count, 1))
    low, median, high = np.quantile([np.linalg.norm(part.mean(axis=0)) for part in parts], [0.05, 0.5, 0.95])
    return float((high - low) / median) if median > 0.0 else np.inf


LENGTHS = {"millimetres": 1000.0, "centimetres": 100.0}
# A unit is named where the ratio is within this factor of the unit's, and this many standard errors from one.
WITHIN_FACTOR, UNIT_SIGMAS = 1.25, 5.0
# The stamps are wrong if the ratios of speeds and rates are beyond the first factor, and alike within the second.
LEAST_OF_STAMPS, STAMPS_ALIKE = 1.3, 1.15
# Limits of the time (s) between two frames of a vehicle's camera.
LEAST_FRAME_S, MOST_FRAME_S = 1e-3, 5.0
# Residuals of tracks under another unit of the arm over those as given, from which on the arm is as long as given.
MOST_WORSE = 1.05
IN_A_PART = " in a part of the recording and not in another"
# Limits of the baselines of rigs (m), and the largest distance (m) of a camera from its IMU.
LEAST_BASELINE_M, MOST_BASELINE_M, MOST_LEVER_M = 0.005, 5.0, 10.0


# A unit that is wrong: what was measured, and the sequence in SI, or None where two units are as likely.
_WrongUnit = tuple[str, Sequence | None]


def units(evidence: Evidence) -> Symptom | Undecided | None:
    """Convert times, lengths, speeds, rates and accelerations that are not in SI, where the unit is certain.

    A ratio of two sources of one motion does not depend on axes: that of a unit's factor names the unit, and one that
    speeds and rates have in common that of the stamps. Baseline and extrinsic are judged by lengths that no rig has.
    """
    now, stamps = evidence, _stamps(evidence) or _frame_rate(evidence)
    found = [] if stamps is None else [stamps]
    of_samples = (partial(_of_samples, quantity=quantity) for quantity in (SPEED, RATE, FORCE))
    measures: tuple[Callable[[Evidence], _WrongUnit | None], ...] = (_baseline, _lever_arm, *of_samples, _truth)
    for measure in measures if stamps is None else ():
        wrong = measure(now)
        if wrong is not None:
            found.append(wrong)
            now = now if wrong[1] is None else now.after(wrong[1])
    if not found:
        return evidence.blind if evidence.intervals is None else None
    certain = all(remedy is not None for _, remedy in found)
    treatment = "converted to SI" if certain else "no single unit fits all of it: correct the recording"
    detail = "; ".join(summary for summary, _ in found)
    return Symptom(len(found), detail, treatment, now.sequence if certain else None, spoils_vision=True)


def _stamps(evidence: Evidence) -> _WrongUnit | None:
    speed = speed_ratio(evidence.intervals)
    if evidence.intervals is None or speed is None or not speed.value > 0.0:
        return None
    rotation = rotation_ratio(evidence.intervals)
    known = all(ratio.error * UNIT_SIGMAS < (LEAST_OF_STAMPS - 1.0) * ratio.value for ratio in (speed, rotation))
    if not known or abs(np.log(speed.value / rotation.value)) > np.log(STAMPS_ALIKE):
        return None
    if min(abs(np.log(ratio.value)) for ratio in (speed, rotation)) < np.log(LEAST_OF_STAMPS):
        return None
    rates = f"their rate of rotation {rotation.value:.3g} +- {rotation.error:.1g} times the camera's"
    fast = f"the stamps run {speed.value:.3g} times as fast as time, so they are not in seconds"
    return (f"the samples' speed is {speed.value:.3g} +- {speed.error:.1g} and {rates}: {fast}", None)


def _frame_rate(evidence: Evidence) -> _WrongUnit | None:
    if evidence.intervals is None:
        return None
    step_s = usual_step_s(evidence.sequence.frames_t_ns)
    if LEAST_FRAME_S <= step_s <= MOST_FRAME_S:
        return None
    summary = f"by the stamps frames come every {step_s:.2g} s, which no camera does: they are not in seconds"
    return (summary, None)


def _baseline(evidence: Evidence) -> _WrongUnit | None:
    """Judge the baseline by its size; a measured speed decides between units."""
    rig = evidence.sequence.rig
    if LEAST_BASELINE_M <= rig.baseline_m <= MOST_BASELINE_M:
        return None
    fitting = [u for u, factor in LENGTHS.items() if LEAST_BASELINE_M <= rig.baseline_m / factor <= MOST_BASELINE_M]
    ratio = speed_ratio(evidence.intervals)
    summary = f"baseline_m is {rig.baseline_m:g}, which no rig has"
    if ratio is not None:
        measured = {unit: 1.0 / LENGTHS[unit] for unit in fitting}
        unit = _in_other_unit(ratio, measured, WITHIN_FACTOR, UNIT_SIGMAS)
        fitting = [unit] if unit is not None else []
        summary += f", and the samples' speed is {ratio.value:.3g} +- {ratio.error:.1g} times the camera's"
    if len(fitting) != 1:
        return (f"{summary}: it is not in metres", None)
    baseline_m = rig.baseline_m / LENGTHS[fitting[0]]
    remedy = replace(evidence.sequence, rig=replace(rig, baseline_m=baseline_m))
    return (f"{summary}: it is in {fitting[0]}, {baseline_m:g} m", remedy)


def _lever_arm(evidence: Evidence) -> _WrongUnit | None:
    """Judge the distance of camera and IMU by its size, in the largest unit that makes it one."""
    rig = evidence.sequence.rig
    position = rig.T_imu_cam[:3, 3]
    distance_m = float(np.linalg.norm(position))
    if not distance_m > MOST_LEVER_M:
        return None
    summary = f"T_imu_cam puts the camera {distance_m:.3g} m from the IMU"
    unit = "millimetres"
    if distance_m / LENGTHS[unit] > MOST_LEVER_M:
        return (f"{summary}: it is not in metres", None)
    T_imu_cam = se3(rig.T_imu_cam[:3, :3], position / LENGTHS[unit])
    if evidence.intervals is not None:
        camera = evidence.camera_motion
        given_px, now_px = (median_one_step_px(evidence.sequence, camera, T) for T in (rig.T_imu_cam, T_imu_cam))
        if now_px > MOST_WORSE * given_px:
            return None  # a long vehicle: the tracks follow the motion as the arm is given
        summary += f" (median one-step reprojection {given_px:.2f} px as given, {now_px:.2f} px in {unit})"
    remedy = replace(evidence.sequence, rig=replace(rig, T_imu_cam=T_imu_cam))
    return (f"{summary}: its translation is in {unit}", remedy)


def _of_samples(evidence: Evidence, quantity: Quantity) -> _WrongUnit | None:
    """Judge a quantity of the samples; both halves of the recording must have the unit."""
    sequence, intervals = evidence.sequence, evidence.intervals
    if quantity is FORCE and _lacks_gravity(sequence):
        return None
    ratio = quantity.ratio_of(sequence, intervals)
    unit = None if ratio is None else _in_other_unit(ratio, quantity.units, quantity.within, UNIT_SIGMAS)
    if ratio is None or unit is None:
        return None
    factor, summary = quantity.units[unit], f"{quantity.summary.format(*ratio)}: it is in {unit}"
    if quantity.by_camera and intervals is not None:
        first = np.arange(intervals.interval.size) < intervals.interval.size // 2
        halves = (quantity.ratio_of(sequence, intervals.select(rows)) for rows in (first, ~first))
        if any(half is not None and (half.value > np.sqrt(factor)) != (factor > 1.0) for half in halves):
            return (f"{summary}{IN_A_PART}", None)
    scale = np.ones(6)
    scale[quantity.columns] /= factor
    return (summary, _with_columns(sequence, lambda columns: columns * scale))


def _truth(evidence: Evidence) -> _WrongUnit | None:
    sequence, intervals = evidence.sequence, evidence.intervals
    truth = sequence.truth
    if truth is None or intervals is None or truth.t_ns.size < 2:
        return None
    frames_t_ns = sequence.frames_t_ns
    inside = (frames_t_ns >= truth.t_ns[0]) & (frames_t_ns <= truth.t_ns[-1])
    t_s, at_s = ((stamps - truth.t_ns[0]) / NS_PER_S for stamps in (truth.t_ns, frames_t_ns))
    positions = np.stack([np.interp(at_s, t_s, axis) for axis in truth.T_world_imu[:, :3, 3].T], axis=1)
    v_true = np.diff(positions, axis=0) / np.diff(at_s)[:, None]
    rows = inside[intervals.interval] & inside[intervals.interval + 1]
    measured = intervals.v_cam_mps if intervals.v_mps is None else intervals.v_mps
    ratio = ratio_of_speeds(v_true[intervals.interval[rows]], measured[rows])
    unit = None if ratio is None else _in_other_unit(ratio, LENGTHS, WITHIN_FACTOR, UNIT_SIGMAS)
    if ratio is None or unit is None:
        return None
    scale = 1.0 / LENGTHS[unit]
    T_world_imu = se3(truth.T_world_imu[:, :3, :3], scale * truth.T_world_imu[:, :3, 3])
    v_world = None if truth.v_world is None else scale * truth.v_world
    remedy = replace(sequence, truth=replace(truth, T_world_imu=T_world_imu, v_world=v_world))
    summary = f"the truth moves {ratio.value:.4g} +- {ratio.error:.1g} times as fast as measured: it is in {unit}"
    return (summary, remedy)


def _in_other_unit(ratio: Scalar, factors: Mapping[str, float], within_factor: float, sigmas: float) -> str | None:
    """Return the only unit whose factor a ratio matches; None where none does, several do, or the ratio may be 1."""
    if not ratio.value > 0.0 or abs(ratio.value - 1.0) < sigmas * ratio.error:
        return None
    apart = {unit: abs(np.log(ratio.value / factor)) for unit, factor in factors.items()}
    near = [unit for unit in apart if apart[unit] < np.log(within_factor)]
    return near[0] if len(near) == 1 else None


def _with_columns(sequence: Sequence, changed: Callable[[Array], Array]) -> Sequence:
    """Return the sequence with other columns of its samples (S, 6), and of noise that was estimated from these."""
    motion, noise = sequence.motion, sequence.noise
    now = replace(sequence, motion=motion.of(motion.t_ns, changed(motion.values)))
    if not (isinstance(motion, TwistSamples) and isinstance(noise, TwistNoise)):
        return now
    density = stated_densities(noise)
    density_now, halves = changed(density), (_LINEAR, _ANGULAR)
    affected = [half for half in halves if not np.array_equal(density_now[half], density[half])]
    if not all(is_from_scatter(density[half], motion.values[:, half], motion.t_ns) for half in affected):
        return now
    velocity, gyro = (density_now[half] for half in halves)
    return replace(now, noise=replace(noise, velocity_noise_density=velocity, gyro_noise_density=gyro))
