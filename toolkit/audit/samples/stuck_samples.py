"""An accelerometer, a gyro or odometry that repeats one value: the driver hangs or the sensor is not connected.

Real samples have noise: three axes are not equal many times in a row, nor is one axis for a second. Odometry can repeat
a value without a fault, zeros while the vehicle stands or whole counts of an encoder on a straight line. Its
repetitions are a fault where it moves and turns at once, or where its velocities or rates are zero throughout while the
camera moves. The number of equal samples in a row that is beyond chance follows from how often two neighbours are equal
in the rest of the recording.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.edits import keep_samples
from toolkit.geometry import Array, BoolArray
from toolkit.resampling import NS_PER_S

# Least number and duration (s) of equal samples in a row: beyond chance, and beyond a sensor that is read more often
# than it measures.
LEAST_RUN, LEAST_S = 10, 0.1
# Level of significance of a run of odometry's samples, for the whole recording, and the least length of a run.
CHANCE, LEAST_RUN_OF_ODOMETRY = 1e-3, 4
# If more than this share of all samples repeats, the rest is not interpolated: it would not represent the motion.
MOST_REPEATED = 0.2
# Least duration (s) for a single axis: one axis of a coarse sensor at rest may repeat a value for a while.
LEAST_OF_AXIS_S = 1.0
# Median speed and rate of the camera below which the vehicle may stand, or drive straight ahead.
STANDING_MPS, STRAIGHT_RADPS = 0.1, 0.01
IMU_SENSORS = {"accelerometer": slice(0, 3), "gyro": slice(3, 6)}


def check(evidence: Evidence) -> Symptom | None:
    """Count the samples that repeat the one before in a long run; drop them."""
    sequence = evidence.sequence
    if sequence.motion_kind == "none" or not sequence.motion.t_ns.size:
        return None
    values, t_ns = sequence.motion.values, sequence.motion.t_ns
    step_s = float(np.median(np.diff(t_ns))) / NS_PER_S if t_ns.size > 1 else LEAST_S
    least = max(LEAST_RUN, round(LEAST_S / max(step_s, 1e-6)))
    if sequence.motion_kind == "twist" and (never := _never_moves(evidence)) is not None:
        return never
    if sequence.motion_kind == "twist":
        moves_and_turns = values[:, :3].any(axis=1) & values[:, 3:].any(axis=1)
        repeated = {"odometry": _in_long_runs(values, _least_of_odometry(values, least, step_s)) & moves_and_turns}
    else:
        repeated = {name: _in_long_runs(values[:, columns], least) for name, columns in IMU_SENSORS.items()}
    stuck_axes = _stuck_axes(values, repeated, step_s) if sequence.motion_kind == "imu" else None
    if stuck_axes is not None:
        return stuck_axes
    stuck = np.logical_or.reduce(list(repeated.values()))
    if not stuck.any():
        return None
    seconds = {name: float(rows.sum()) * step_s for name, rows in repeated.items()}
    too_many = stuck.mean() > MOST_REPEATED
    return Symptom(
        count=int(stuck.sum()),
        detail=", ".join(f"the {name} repeats one value for {time:.3g} s" for name, time in seconds.items() if time),
        treatment=(
            "too long to be bridged: check the driver and the cables"
            if too_many
            else "repeated samples are dropped; the others bridge the gap"
        ),
        remedy=None if too_many else keep_samples(sequence, ~stuck),
        spoils_vision=bool(too_many),
    )


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
    least, found = max(LEAST_RUN, round(LEAST_OF_AXIS_S / max(step_s, 1e-6))), list[tuple[str, BoolArray]]()
    for name, columns in IMU_SENSORS.items():
        for axis, column in zip("xyz", values[:, columns].T, strict=True):
            repeats = _in_long_runs(column[:, None], least) & ~whole[name] & ~_at_an_end(column)
            found += [(f"{name} {axis}", repeats)] if repeats.any() else []
    if not found:
        return None
    return Symptom(
        count=int(np.logical_or.reduce([rows for _, rows in found]).sum()),
        detail=", ".join(f"the {name} repeats one value for {rows.sum() * step_s:.3g} s" for name, rows in found),
        treatment="the true values are unknown: check the driver and the cables (real samples have noise)",
        remedy=None,
    )


def _at_an_end(column: Array) -> BoolArray:
    """Say which values (S,) are at an end of the sensor's range: the largest or smallest, reached more than once."""
    at_end = np.zeros(column.size, dtype=bool)
    for end in (column.min(initial=np.inf), column.max(initial=-np.inf)):
        here = column == end
        if np.sum(here[1:] & ~here[:-1]) + here[:1].sum() > 1:
            at_end |= here
    return at_end


def _never_moves(evidence: Evidence) -> Symptom | None:
    """Report odometry whose velocities or rates of rotation are all zero while the camera's are not."""
    camera, values = evidence.camera_motion, evidence.sequence.motion.values
    if not len(values) or camera.known.sum() < LEAST_RUN:
        return None
    speed_mps = float(np.median(np.linalg.norm(camera.v_mps[camera.known], axis=1)))
    rate_radps = float(np.median(np.linalg.norm(camera.w_radps[camera.known], axis=1)))
    findings = []
    if not values[:, :3].any() and speed_mps > STANDING_MPS:
        findings.append(f"all {len(values)} velocities are zero while the camera moves at {speed_mps:.2g} m/s (median)")
    if not values[:, 3:].any() and rate_radps > STRAIGHT_RADPS:
        findings.append(
            f"all {len(values)} rates of rotation are zero while the camera turns at {rate_radps:.2g} rad/s"
        )
    if not findings:
        return None
    return Symptom(
        count=len(values),
        detail=", and ".join(findings),
        treatment="they were not recorded: check the driver and the cables",
        remedy=None,
        spoils_vision=True,
    )


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


FAULT = Fault(
    "stuck-samples",
    "an accelerometer, a gyro or odometry that repeats one value",
    check,
    after=("not-finite", "time-order"),
)
