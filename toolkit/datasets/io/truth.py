"""Ground truth of a recording: read, checked to belong to it, and taken at the stamps of its frames.

A TUM file is given by the user; columns are never reordered silently: where the order looks wrong an error is raised.
Of EuRoC recordings a truth lies beside the sensors, and of several the gyro chooses: of V1_01_easy two are in use, the
original, whose orientation is off by degrees, and one computed again from the motion capture and the IMU (Geneva &
Huang, "vicon2gt", 2020), whose rates of rotation agree with the gyro.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from toolkit.datasets.io.euroc_calibration import extrinsic
from toolkit.datasets.io.fields import read_fields
from toolkit.datasets.io.tables import columns_of_file, headings_of
from toolkit.datasets.trajectories import tum
from toolkit.datasets.trajectories.belonging import Reference, Steps, check_clock, check_turns, stamps_among, values_at
from toolkit.datasets.trajectories.formats import (
    POSITIONS_ALONE,
    checked_poses,
    known_poses,
    read_finite_poses,
    read_rows,
)
from toolkit.errors import DataError
from toolkit.files.reading import is_regular
from toolkit.geometry import IntArray, interpolate_poses, se3_inverse
from toolkit.measurements import NS_PER_S
from toolkit.motion_samples import ImuSamples
from toolkit.sequence import Sequence, Truth

OF_POSITIONS = "the truth is of positions alone: its orientations are all one"
_KIND = "a truth file is TUM text, one pose a line"
# Between truths farther apart nothing is known of the motion at 1 m/s: two periods of the camera.
LONGEST_TRUTH_GAP_S = 0.1
# Rotations are compared over steps of such lengths: shorter ones are noise, and some truths have gaps of minutes.
_SHORTEST_STEP_NS, _LONGEST_STEP_S = NS_PER_S // 10, 0.5
# Rates of two unrelated motions differ by at least the gyro's rates; those of a noisy motion capture by half of that.
# Differences below the first number are the noise of a good motion capture at a standstill.
_MOST_OFF_RADPS, _MOST_OFF = 0.05, 0.7
_STRANGER = (
    ": its rotation differs from the gyro's, so it is of another recording, or its quaternions or the gyro are not in "
    "the order, axes or units they are read in; do not rely on figures against it"
)
_AXES = "xyz"
# Position, quaternion, velocity, gyro bias and accelerometer bias, as the data set names them and as vicon2gt does.
_HEADINGS = (
    (
        tuple(f"p_RS_R_{a}" for a in _AXES) + tuple(f"q_RS_{a}" for a in "xyzw"),
        tuple(f"{name}_{a}" for name in ("v_RS_R", "b_a_RS_S", "b_w_RS_S") for a in _AXES),
    ),
    (
        tuple(f"p{a}" for a in _AXES) + tuple(f"q{a}" for a in "xyzw"),
        tuple(f"{name}{a}" for name in ("v", "ba", "bw") for a in _AXES),
    ),
)


class TruthRead(NamedTuple):
    """A truth, and what to know of it: poses that are left out, orientations that it lacks."""

    truth: Truth
    facts: tuple[str, ...]


def load_truth(path: Path) -> TruthRead:
    """Read a TUM file, or one of positions or of columns by name, without the lines that hold no finite pose.

    Raises DataError, naming the line and the likely cause, where the file is missing, empty or not a table of
    eight numbers a line, time does not increase or is not in seconds, or quaternions are not unit length or look w
    first.
    """
    rows = read_rows(path, _KIND)
    alone = rows.width == len(POSITIONS_ALONE.split())
    read = read_finite_poses(path) if rows.heading or alone else tum.parse(rows)
    if read.t_ns is None:
        raise DataError(f"{path}: has no stamps; {_KIND}")
    truth = Truth(read.t_ns, read.T_world_imu)
    left_out = (f"left out of the truth: {read.not_finite}",) if read.not_finite else ()
    read.check_order()
    return TruthRead(truth, (*left_out, OF_POSITIONS) if is_of_positions(truth) else left_out)


def is_of_positions(truth: Truth) -> bool:
    """Say whether a truth is of positions alone: its orientations are all one, and it moves."""
    poses = truth.T_world_imu
    return len(poses) > 2 and np.ptp(poses[:, :3, :3], axis=0).max() == 0.0 < np.ptp(poses[:, :3, 3], axis=0).max()


def with_truth(sequence: Sequence, truth: Truth, facts: tuple[str, ...] = ()) -> Sequence:
    """Return the sequence with this truth, and with what to know of it.

    Raises DataError where the two do not overlap in time (both ranges and the likely cause are named), or
    where the measured rates of rotation fit the truth only with its quaternions read w first.
    """
    reference = Reference.of_recording(sequence)
    check_clock("the truth", reference, truth.t_ns)
    # Only the order: the recording is not audited yet, and mixed axes of its own would look like a camera's.
    check_turns("the truth", reference, truth.t_ns, truth.T_world_imu[:, :3, :3], (tum.other_order,))
    return replace(sequence, truth=truth).with_facts(*facts)


def stamps_within(stamps: IntArray, imu_t_ns: IntArray, truth_t_ns: IntArray) -> IntArray:
    """Return the stamps (K,) that lie within the IMU's time and between truths close enough to interpolate."""
    first, last = max(imu_t_ns.min(), truth_t_ns[0]), min(imu_t_ns.max(), truth_t_ns[-1])
    inside = stamps[(stamps >= first) & (stamps <= last)]
    after = np.clip(np.searchsorted(truth_t_ns, inside), 1, truth_t_ns.size - 1)
    return np.asarray(inside[truth_t_ns[after] - truth_t_ns[after - 1] <= LONGEST_TRUTH_GAP_S * NS_PER_S])


def seconds_apart(truth: Truth) -> float:
    """Return the median step between the poses of a truth."""
    return float(np.median(np.diff(truth.t_ns))) / NS_PER_S if truth.t_ns.size > 1 else 0.0


def truth_near(truth: Truth, t_ns: IntArray) -> tuple[Truth, tuple[str, ...]]:
    """Return the truth at those of the stamps (K,) that it reaches, and what to know of it.

    Where its poses are too far apart to be interpolated it keeps its own stamps, and runs are scored there.
    """
    reached = stamps_within(t_ns, truth.t_ns, truth.t_ns)
    if reached.size > 1:
        return truth_at(truth, reached), ()
    return truth, (f"the truth has a pose every {seconds_apart(truth):.3g} s: runs are scored at its stamps",)


def truth_at(truth: Truth, t_ns: IntArray) -> Truth:
    """Return the truth at stamps (K,) within it: poses on the geodesic, velocities and biases on straight lines."""
    poses = interpolate_poses(truth.t_ns, truth.T_world_imu, t_ns)
    v_world, bias = (None if one is None else values_at(truth.t_ns, one, t_ns) for one in (truth.v_world, truth.bias))
    return Truth(t_ns, poses, v_world, bias)


# Of EuRoC recordings -----------------------------------------------------------------------------------------------


def find_truth(root: Path, mav0: Path | None, imu: ImuSamples) -> TruthRead | None:
    """Return the truth of a recording and why, None where there is none; of several, that which fits the gyro's rates.

    Raises DataError where one is damaged, or too few poses of the best are close to one another in the IMU's time.
    """
    read = {path: _read(path, mav0) for path in _tables(root, mav0)}
    if not read:
        return None
    found = {path: one.truth for path, one in read.items()}
    apart = {path: _rates_apart_radps(truth, imu) for path, truth in found.items()}
    ranked = sorted(apart.items(), key=lambda item: item[1][0])
    best, (least, turning) = ranked[0]
    if not np.isfinite(least):
        few = f"in the IMU's time it has less than 0.2 s of poses that are within {_LONGEST_STEP_S:g} s of one another"
        remedy = "check that both are of one recording and clock, and give a truth of 10 Hz or more"
        raise DataError(f"{best}: {few}; {remedy}")
    scatters = "; ".join(f"{path.relative_to(root)} by {off:.4f} rad/s" for path, (off, _) in ranked)
    among = "" if len(ranked) == 1 else ", the better of those in the folder"
    stranger = _STRANGER if least > max(_MOST_OFF_RADPS, _MOST_OFF * turning) else ""
    reason = f"the truth is {best.relative_to(root)}{among} (rates RMS off the gyro's: {scatters}){stranger}"
    # Orientations that are all one are what a body has that never turns.
    told = (fact for fact in read[best].facts if turning > _MOST_OFF_RADPS or fact != OF_POSITIONS)
    reason = "; ".join((reason, *told))
    return TruthRead(found[best], (reason,))


def _tables(root: Path, mav0: Path | None) -> list[Path]:
    # TUM-VI's motion capture, already moved to the IMU and its clock.
    folders = ("state_groundtruth_estimate0", "mocap0")
    inside = [] if mav0 is None else [mav0 / folder / "data.csv" for folder in folders]
    beside = [
        path for path in sorted(root.glob("*.csv")) if any(headings_of(path) >= set(pose) for pose, _ in _HEADINGS)
    ]
    return [*(path for path in inside if path.is_file()), *beside, *sorted(root.glob("*.tum"))]


def _read(path: Path, mav0: Path | None) -> TruthRead:
    read = load_truth(path) if path.suffix == ".tum" else _read_csv(path)
    truth, sensor_yaml = read.truth, path.parent / "sensor.yaml"
    if mav0 is None or path.parent.parent != mav0 or not sensor_yaml.is_file() or is_of_positions(truth):
        return read
    imu_yaml = mav0 / "imu0/sensor.yaml"
    # Beside a camchain there need be none: the body is the IMU then.
    T_body_imu = extrinsic(read_fields(imu_yaml)) if is_regular(imu_yaml) else np.eye(4)
    T_sensor_imu = se3_inverse(extrinsic(read_fields(sensor_yaml))) @ T_body_imu
    if np.array_equal(T_sensor_imu, np.eye(4)):
        return read
    # Velocity and biases are the tracked sensor's own, not the IMU's.
    return TruthRead(Truth(truth.t_ns, truth.T_world_imu @ T_sensor_imu), read.facts)


def _read_csv(path: Path) -> TruthRead:
    """Read finite poses and, where all are there, velocities and biases; stamps stay whole numbers."""
    table = columns_of_file(path)
    names = set(table.names)
    pose, rest = next((heading for heading in _HEADINGS if names >= set(heading[0])), _HEADINGS[0])
    complete = names >= set(rest)
    values, t_ns = table.numbers(*pose, *(rest if complete else ())), table.whole(table.names[0])
    kept = known_poses(values[:, :7])
    t_ns, values = t_ns[kept], values[kept]
    T_world_imu = checked_poses(path, np.array(table.numbers_of_rows)[kept].tolist(), t_ns, values[:, :7])
    lost = int((~kept).sum())
    facts = (f"{lost} of its {kept.size} poses are not finite and left out",) if lost else ()
    truth = Truth(t_ns, T_world_imu, values[:, 7:10], values[:, 10:16]) if complete else Truth(t_ns, T_world_imu)
    return TruthRead(truth, (*facts, OF_POSITIONS) if is_of_positions(truth) else facts)


def _rates_apart_radps(truth: Truth, imu: ImuSamples) -> tuple[float, float]:
    """Return how far a truth's rates of rotation are from the gyro's, and how far these vary: RMS about the median.

    The first is infinite where the two share no two steps.
    """
    # Without what the audit will repair: rows that are not finite, out of order, or there twice.
    finite = np.flatnonzero(np.isfinite(imu.gyro_radps).all(axis=1))
    sample_t_ns, first = np.unique(imu.t_ns[finite], return_index=True)
    gyro_radps = imu.gyro_radps[finite[first]]
    within = stamps_among(truth.t_ns, sample_t_ns)
    steps = Steps.of(truth.t_ns[within], _SHORTEST_STEP_NS)
    known = steps.duration_s < _LONGEST_STEP_S
    if known.sum() < 2:
        return float("inf"), 0.0
    measured = steps.mean_rates(sample_t_ns, gyro_radps)[known]
    off = steps.rates(truth.T_world_imu[within, :3, :3])[known] - measured
    of_gyro, apart = (float(np.sqrt(((x - np.median(x, axis=0)) ** 2).mean())) for x in (measured, off))
    return apart, of_gyro
