"""Trajectory files: what is written is read back, evo reads it alike, and every wrong file gets one line."""

import re
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface as evo

from tests.datasets.conftest import assert_refused
from toolkit.datasets.io.truth import load_truth
from toolkit.datasets.trajectories import FORMATS, read_poses
from toolkit.estimate import Trajectory
from toolkit.geometry import se3, so3_exp

COUNT = 50
# The bound asked for; 15 printed digits of positions of some km keep 1e-11 m.
TOLERANCE = 1e-9


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    """Poses some km from the origin, turned any way, at today's stamps that no double holds."""
    rng = np.random.default_rng(5)
    t_ns = 1_600_000_000_123_456_789 + np.cumsum(rng.integers(10**7, 10**8, COUNT))
    poses = se3(so3_exp(2.0 * rng.normal(size=(COUNT, 3))), 1e3 * rng.normal(size=(COUNT, 3)))
    return Trajectory(t_ns, poses, rng.normal(size=(COUNT, 3)), rng.normal(size=(COUNT, 6)))


def written(folder: Path, name: str, trajectory: Trajectory) -> Path:
    path = folder / "poses.txt"
    path.write_text(FORMATS[name].text(trajectory), encoding="utf-8")
    return path


def lines_of(name: str, trajectory: Trajectory) -> list[list[str]]:
    """Return the words of the rows of a file."""
    text = FORMATS[name].text(trajectory)
    rows = [line for line in text.splitlines() if not line.startswith("#")]
    return [row.split("," if name == "euroc" else " ") for row in rows]


def spoiled(folder: Path, name: str, rows: list[list[str]]) -> Path:
    path = folder / "spoiled"
    path.write_text("\n".join(("," if name == "euroc" else " ").join(row) for row in rows) + "\n")
    return path


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_recognised_and_read_back_and_evo_reads_the_same(
    tmp_path: Path, trajectory: Trajectory, name: str
) -> None:
    path = written(tmp_path, name, trajectory)
    read = read_poses(path)
    assert read.format.lower() == name
    np.testing.assert_allclose(read.T_world_imu, trajectory.T_world_imu, atol=TOLERANCE, rtol=0.0)
    np.testing.assert_array_equal(read.t_ns, None if name == "kitti" else trajectory.t_ns)
    readers = {
        "tum": evo.read_tum_trajectory_file,
        "kitti": evo.read_kitti_poses_file,
        "euroc": evo.read_euroc_csv_trajectory,
    }
    if name in readers:
        theirs = readers[name](path)
        np.testing.assert_allclose(theirs.poses_se3, trajectory.T_world_imu, atol=TOLERANCE, rtol=0.0)
    if name in ("tum", "euroc"):  # evo holds seconds as doubles, which are 2.4e-7 s apart today
        np.testing.assert_allclose(theirs.timestamps, trajectory.t_ns / 1e9, atol=2.4e-7, rtol=0.0)


def test_openvins_states_keep_velocity_and_biases_in_its_order(trajectory: Trajectory) -> None:
    values = np.array(lines_of("openvins", trajectory), dtype=float)
    assert trajectory.v_world is not None
    assert trajectory.bias is not None
    np.testing.assert_allclose(values[:, 8:11], trajectory.v_world, rtol=1e-14)
    np.testing.assert_allclose(values[:, 11:], np.roll(trajectory.bias, 3, axis=1), rtol=1e-14)
    unknown = np.array(lines_of("openvins", Trajectory(trajectory.t_ns, trajectory.T_world_imu)), dtype=float)
    assert np.isnan(unknown[:, 8:]).all()


def test_the_states_quaternion_is_jpls_of_the_world_to_the_imu(trajectory: Trajectory) -> None:
    """Trawny & Roumeliotis (2005), eq. (78): C(q) = (2 q4^2 - 1) I - 2 q4 [q]x + 2 q q^T."""
    x, y, z, w = np.array(lines_of("openvins", trajectory)[0][1:5], dtype=float)
    vector, cross = np.array([x, y, z]), np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    R_imu_world = (2 * w**2 - 1) * np.eye(3) - 2 * w * cross + 2 * np.outer(vector, vector)
    np.testing.assert_allclose(R_imu_world, trajectory.T_world_imu[0, :3, :3].T, atol=1e-14)


@pytest.mark.parametrize(
    ("name", "heading", "more"),
    [
        ("openvins", "", ["0.01", "1", *["0.5"] * 15]),  # with what it calibrates
        ("tum", "", ["1e-4"] * 12),  # recorded by OpenVINS, with two covariances
        ("euroc", "timestamp,p_RS_R_x [m],and so on", ["0.1", "0.2", "0.3", ""]),  # a last comma
    ],
)
def test_more_columns_and_a_heading_do_no_harm(
    tmp_path: Path, trajectory: Trajectory, name: str, heading: str, more: list[str]
) -> None:
    rows = [[*row, *more] for row in lines_of(name, trajectory)]
    read = read_poses(spoiled(tmp_path, name, [[heading], *rows] if heading else rows))
    assert read.format == ("EuRoC" if name == "euroc" else "OpenVINS")
    np.testing.assert_allclose(read.T_world_imu, trajectory.T_world_imu, atol=TOLERANCE, rtol=0.0)


@pytest.mark.parametrize(
    ("name", "per_second", "unit"),
    [
        ("tum", 10**9, "nanoseconds: divide by 1e9"),
        ("tum", 10**6, "microseconds: divide by 1e6"),
        ("tum", 10**3, "milliseconds: divide by 1e3"),
        ("openvins", 10**9, "nanoseconds: divide by 1e9"),
        ("euroc", 10**6, "microseconds: multiply by 1e3"),
        ("euroc", 10**3, "milliseconds: multiply by 1e6"),
        ("euroc", 1, "seconds: multiply by 1e9"),
    ],
)
@pytest.mark.parametrize("start", ["epoch", "zero"])
def test_a_wrong_unit_of_time_is_named(
    tmp_path: Path, trajectory: Trajectory, name: str, per_second: int, unit: str, start: str
) -> None:
    t_ns = trajectory.t_ns - (0 if start == "epoch" else trajectory.t_ns[0])
    stamps = [f"{t * per_second / 1e9:.6f}" if per_second < 10**9 else str(t) for t in t_ns.tolist()]
    rows = [[stamp, *row[1:]] for stamp, row in zip(stamps, lines_of(name, trajectory), strict=True)]
    path = spoiled(tmp_path, name, rows)
    assert_refused(lambda: read_poses(path), path, f"the stamps look like {unit}")


# Wrong in one thing each ----------------------------------------------------------------------------------------------

X = {"tum": 1, "kitti": 3, "euroc": 1, "openvins": 5}
# Row and column of a word, what stands there, and what the answer says; TIME and QUATERNION are of files with stamps.
CELLS = [
    (3, X, "nan", "line 4 holds a value that is not finite"),
    (3, X, "x1", "line 4 is not numeric"),
    (3, X, "1_0", "line 4 .*could not convert string to float: '1_0'"),
    (3, X, "1e10", r"line 4 has a position beyond 1e\+09 m; check its unit"),
    (3, X, "9" * 400, "line 4.*(not finite|beyond)"),
]
TIME = dict.fromkeys(("tum", "euroc", "openvins"), 0)
QUATERNION = {"tum": 4, "euroc": 4, "openvins": 1}
OF_STAMPS = [
    (2, TIME, "the same", "line 3 has the stamp of the one before it, and another pose; keep one of the two"),
    (2, QUATERNION, "3.0", "line 3 has a quaternion that is not of unit length"),
]


@pytest.mark.parametrize(
    ("name", "row", "column", "word", "says"),
    [(name, row, where[name], word, says) for row, where, word, says in CELLS + OF_STAMPS for name in where],
)
def test_a_cell_of_a_trajectory_that_is_wrong_is_named(
    tmp_path: Path, trajectory: Trajectory, name: str, row: int, column: int, word: str, says: str
) -> None:
    rows = lines_of(name, trajectory)[:6]
    width = len(rows[0])
    rows[row][column] = rows[row - 1][column] if word == "the same" else word
    path = spoiled(tmp_path, name, rows)
    assert_refused(lambda: read_poses(path), path, says)
    del rows[row][4:]
    columns = re.escape(f"has 4 columns, expected {width} ({FORMATS[name].columns})")
    assert_refused(lambda: read_poses(spoiled(tmp_path, name, rows)), path, f"line {row + 1} {columns}")


TEXTS = [
    (b"", r"the file holds no poses; there are tum \(t x y z qx qy qz qw\), kitti"),
    (b"timestamp,x,y,z,qw,qx,qy,qz\n", "the file holds no poses"),
    (b"\xff\xfe\x00\x80", "not a text file"),
    (b"1 2 3 4 5\n", "5 columns separated by blanks are no format that is known; there are tum"),
    (b"1,2,3,4,5\n", "5 columns separated by commas are no format that is known"),
    (b"1e400 0 0 0 0 0 0 1\n", r"time\[0\] is inf"),
    (b"1e12 0 0 0 0 0 0 1\n", "must be in seconds"),
    (b"nan,0,0,0,1,0,0,0\n", r"line 1 has no finite time \(nan\); remove the line"),
    (b"1e30,0,0,0,1,0,0,0\n", "line 1 has the time 1e30, beyond any clock"),
    (b"1 0 0 5 0 1 0 6 0 0 1 7\n-1 0 0 5 0 1 0 6 0 0 1 7", "line 2 holds a reflection, not a rotation"),
    (b"1 0 0 5 0 1 0 6 0 0 1 7\n1.1 0 0 5 0 1 0 6 0 0 1 7", "line 2 does not hold a rotation; expected r11 r12"),
]


@pytest.mark.parametrize(("content", "says"), TEXTS)
def test_a_file_that_is_no_trajectory(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "poses"
    path.write_bytes(content)
    assert_refused(lambda: read_poses(path), path, says)
    path.write_bytes(b"1.0,0,0,0,0,0,0,1\n")
    assert_refused(lambda: load_truth(path), path, "separated by blanks, not commas")
    for absent in (tmp_path / "absent", tmp_path):
        assert_refused(lambda: read_poses(absent), absent, "cannot be read")  # noqa: B023 - called at once
