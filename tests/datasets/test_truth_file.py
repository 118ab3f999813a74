"""Truth files: what is read, and that every way of writing one wrongly is named and never silently repaired."""

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toolkit.datasets.io.truth import load_truth, with_truth
from toolkit.datasets.trajectories import PosesFile, euroc, tum
from toolkit.errors import DataError
from toolkit.estimate import Trajectory
from toolkit.geometry import (
    Array,
    about_z,
    quaternion_from_rotation,
    rotation_from_quaternion,
    se3,
    se3_exp,
    se3_inverse,
    so3_exp,
)
from toolkit.motion_samples import ImuSamples
from toolkit.sequence import Observations, Sequence, Truth
from toolkit.simulation import DRIVE, FLIGHT, simulate

COUNT, STEP_S, START_S = 200, 0.1, 1.4e9
FORWARD_MPS, LEFT_TURN_RADPS = 10.0, 0.3
NOBODY = np.empty(0, dtype=np.int64)


def drive(turn_radps: float = LEFT_TURN_RADPS) -> Array:
    """Return poses (COUNT, 4, 4) of a vehicle that drives forward and turns left, from the identity."""
    step = se3_exp(STEP_S * np.array([0.0, 0.0, turn_radps, FORWARD_MPS, 0.0, 0.0]))
    return np.stack([np.linalg.matrix_power(step, k) for k in range(COUNT)])


def table(poses: Array) -> Array:
    """Return the rows (N, 8) of a TUM file."""
    stamps_s = START_S + STEP_S * np.arange(len(poses))
    return np.column_stack([stamps_s, poses[:, :3, 3], quaternion_from_rotation(poses[:, :3, :3])])


def w_first(rows: Array) -> Array:
    return rows[:, [0, 1, 2, 3, 7, 4, 5, 6]]


def written(folder: Path, rows: Array, fmt: str = "%.9f") -> Path:
    path = folder / "truth.tum"
    np.savetxt(path, rows, fmt=fmt, header="time x y z qx qy qz qw")
    return path


def recording(gyro_radps: Array) -> Sequence:
    """Return a recording without sightings whose gyro reads (COUNT, 3) at the truth's stamps."""
    t_ns = np.rint(1e9 * (START_S + STEP_S * np.arange(COUNT))).astype(np.int64)
    unseen, motion = Observations(NOBODY, NOBODY, np.empty((0, 3))), ImuSamples(t_ns, np.zeros((COUNT, 3)), gyro_radps)
    made = simulate(replace(FLIGHT, duration_s=0.2), 0)
    return replace(made, frames_t_ns=t_ns, observations=unseen, motion=motion, truth=None, prior=None)


@pytest.mark.parametrize("name", ["ucsd/gt/0027.tum", "kitti00/gt_imu.tum"])
def test_real_truth_is_accepted_and_refused_w_first(real: Callable[[str], Path], tmp_path: Path, name: str) -> None:
    path = real(name)
    assert load_truth(path).truth.t_ns.size > 1000
    for first in (0, 500):
        with pytest.raises(DataError, match="look w first"):
            load_truth(written(tmp_path, w_first(np.loadtxt(path))[first:]))


@pytest.mark.parametrize("turn_radps", [0.0, LEFT_TURN_RADPS, -LEFT_TURN_RADPS])
def test_a_vehicle_w_first_is_refused_with_or_without_turns(tmp_path: Path, turn_radps: float) -> None:
    with pytest.raises(DataError, match=r"look w first; .* move the fifth column to the end"):
        load_truth(written(tmp_path, w_first(table(drive(turn_radps)))))


@pytest.mark.parametrize("T_world_start", [np.eye(4), se3(about_z(2.5), np.zeros(3))], ids=["ahead", "turned"])
@pytest.mark.parametrize("roll_rad", [0.0, np.pi])
def test_a_vehicle_is_accepted_whatever_its_heading_and_upside_down(
    tmp_path: Path, T_world_start: Array, roll_rad: float
) -> None:
    rolled = T_world_start @ drive() @ se3(so3_exp(np.array([roll_rad, 0.0, 0.0])), np.zeros(3))
    load_truth(written(tmp_path, table(rolled)))


@pytest.mark.parametrize("origin_m", [0.0, 5e6], ids=["at its origin", "in UTM"])
@pytest.mark.parametrize("format_name", ["tum", "euroc"])
def test_a_correct_file_is_not_refused_however_short_it_is(format_name: str, origin_m: float) -> None:
    """Within 2 s a flight is nearly a vehicle's in some reading of its quaternions."""
    flown = simulate(replace(FLIGHT, duration_s=20.0), 0).truth
    assert flown is not None
    poses = flown.T_world_imu[:: flown.t_ns.size // 200] + origin_m * (np.arange(4) == 3) * [[0.1], [1.0], [0.0], [0.0]]
    other_order = {"tum": tum, "euroc": euroc}[format_name].other_order
    for first in range(0, 180, 2):
        PosesFile(Path("short"), format_name, None, poses[first : first + 21], other_order).check_order()


@pytest.mark.parametrize("seed", range(3))
def test_the_gyro_gives_w_first_away_where_the_path_cannot(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rates = np.cumsum(rng.normal(0.0, 0.2, (COUNT, 3)), axis=0)
    turns = so3_exp(STEP_S * 0.5 * (rates[1:] + rates[:-1]))
    rotations = list(itertools.accumulate(turns, np.matmul, initial=so3_exp(np.array([0.4, -0.2, 1.0]))))
    R_world_imu = np.stack(rotations)
    positions = np.cumsum(rng.normal(0.0, 0.1, (COUNT, 3)), axis=0)
    noisy = rates + np.array([0.01, -0.02, 0.03]) + rng.normal(0.0, 0.05, (COUNT, 3))
    sequence = recording(noisy)
    truth = Truth(sequence.frames_t_ns, se3(R_world_imu, positions))
    assert with_truth(sequence, truth).truth is truth
    misread = rotation_from_quaternion(np.roll(quaternion_from_rotation(R_world_imu), 1, axis=1))
    with pytest.raises(DataError, match="w first"):
        with_truth(sequence, replace(truth, T_world_imu=se3(misread, positions)))


@pytest.mark.parametrize("every", [1, 3])
def test_two_seconds_of_a_drive_give_w_first_away(every: int) -> None:
    """Its body turned as a whole would fit as well, of few steps about one axis, but the truth is the recording's."""
    drive = simulate(replace(DRIVE, duration_s=2.0), 0)
    assert drive.truth is not None
    t_ns, poses = drive.truth.t_ns[::every], drive.truth.T_world_imu[::every]
    misread = rotation_from_quaternion(np.roll(quaternion_from_rotation(poses[:, :3, :3]), 1, axis=1))
    with_truth(drive, Truth(t_ns, poses))
    with pytest.raises(DataError, match="w first"):
        with_truth(drive, Truth(t_ns, se3(misread, poses[:, :3, 3])))


def test_a_gyro_of_noise_alone_or_with_gaps_and_reversed_stamps_refuses_no_truth() -> None:
    noise = recording(np.random.default_rng(2).normal(0.0, 0.05, (COUNT, 3)))
    turning = recording(np.tile([0.0, 0.0, LEFT_TURN_RADPS], (COUNT, 1)))
    gyro, t_ns = turning.motion.values[:, 3:].copy(), turning.motion.t_ns.copy()
    gyro[5], t_ns[10] = np.nan, t_ns[8]
    faulty = replace(turning, motion=ImuSamples(t_ns, np.zeros((COUNT, 3)), gyro))
    for sequence in (noise, faulty):
        with_truth(sequence, Truth(sequence.frames_t_ns, drive()))


def test_truth_without_overlap_names_both_ranges_and_the_cause() -> None:
    """Clocks that count from a start or in another zone are set right in evaluation/test_public_cases."""
    sequence = recording(np.zeros((COUNT, 3)))
    with pytest.raises(DataError, match="of another drive or clock") as raised:
        with_truth(sequence, Truth(sequence.frames_t_ns - np.int64(5e12), drive()))
    assert "1400000000.000 .. 1400000019.900 s" in str(raised.value)


@pytest.mark.parametrize(("whole", "remedy"), [(False, "conjugate them"), (True, "invert each one")])
def test_an_inverted_trajectory_is_called_inverted_whatever_order_fits_by_chance(
    tmp_path: Path, whole: bool, remedy: str
) -> None:
    """A vehicle that turns about the vertical only, as on a plane."""
    yaw = 2.0 * np.sin(np.linspace(0.0, 6.0, 40))
    R_world_imu = so3_exp(yaw[:, None] * np.array([0.0, 0.0, 1.0]))
    steps = R_world_imu[:, :, 0]
    T_world_imu = se3(R_world_imu, np.cumsum(steps, axis=0))
    inverse = se3_inverse(T_world_imu)
    stated = inverse if whole else se3(inverse[:, :3, :3], T_world_imu[:, :3, 3])
    t_ns = np.arange(40, dtype=np.int64) * 100_000_000
    path = tmp_path / "inverted.tum"
    path.write_text(tum.text(Trajectory(t_ns, stated)))
    with pytest.raises(DataError, match=remedy):
        load_truth(path)
    path.write_text(tum.text(Trajectory(t_ns, T_world_imu)))
    load_truth(path)


def test_lines_without_a_pose_are_left_out_and_positions_alone_are_told(tmp_path: Path) -> None:
    rows = table(drive())
    rows[7, 1:] = np.nan
    read = load_truth(written(tmp_path, rows))
    assert read.truth.t_ns.size == COUNT - 1
    assert "line 9 holds a value that is not finite" in read.facts[0]
    for quaternion in ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)):
        rows = table(drive())
        rows[:, 4:] = quaternion
        alone = load_truth(written(tmp_path, rows))
        assert alone.facts == ("the truth is of positions alone: its orientations are all one",)
    positions = load_truth(written(tmp_path, table(drive())[:, :4]))
    np.testing.assert_array_equal(positions.truth.T_world_imu, alone.truth.T_world_imu)
    sequence = recording(np.tile([0.0, 0.0, LEFT_TURN_RADPS], (COUNT, 1)))
    assert with_truth(sequence, *positions).provenance.facts[-1:] == positions.facts
