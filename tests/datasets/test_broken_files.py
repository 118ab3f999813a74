"""One table of files that are wrong in one thing each: every one is refused in one line that names the file and words.

Folders of images, EuRoC's and the project's own have tables of their own beside the recordings that they spoil.
"""

import gzip
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from tests.datasets.conftest import assert_refused
from tests.datasets.conftest import edit as replace
from tests.datasets.test_own_tables import recorded, written
from toolkit.datasets import load_sequence
from toolkit.datasets.io.truth import load_truth
from toolkit.datasets.trajectories import FORMATS, read_poses
from toolkit.estimate import Trajectory
from toolkit.geometry import se3, so3_exp

Arrays = dict[str, Any]
# What an array is exchanged for, the arrays to leave out, and what the answer says.
Broken = tuple[Arrays, tuple[str, ...], str]


def many(*corners_px: float, struck: float = 1.0) -> np.ndarray:
    """Return features of eight tracks in all five frames, a share of them scattered about one place, the rest sound."""
    tracks = np.arange(8) < round(8 * struck)
    places = np.where(tracks, np.array(corners_px)[:, None], np.array([400.0, 200.0, 380.0, 200.0])[:, None])
    return places[..., None] + np.random.default_rng(0).normal(0.0, 0.5, (4, 8, 5))


def K(**entries: float) -> np.ndarray:
    """Return a camera matrix with entries such as ``m01`` exchanged."""
    matrix = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
    for name, value in entries.items():
        matrix[int(name[1]), int(name[2])] = value
    return matrix


FEW_S = 0.1 * np.arange(5)[None]
OBJECTS = np.array([{}, []], dtype=object)
COURSE: list[Broken] = [
    ({}, ("K", "angular_velocity"), "missing angular_velocity or rotational_.*, K"),
    ({"time_stamps": OBJECTS}, (), "time_stamps .* unpickled"),
    ({"features": np.zeros((4, 3, 6))}, (), r"features has shape \(4, 3, 6\), .*\(4, any, 5\)"),
    ({"linear_velocity": np.zeros((5, 3))}, (), "linear_velocity has shape"),
    ({"time_stamps": np.zeros((2, 5))}, (), "time_stamps has shape"),
    ({"time_stamps": np.zeros((1, 1))}, (), "1 frame"),
    ({"time_stamps": np.zeros((1, 0))}, (), "0 frame"),
    ({"time_stamps": 1e9 * FEW_S}, (), "look like nanoseconds: divide by 1e9"),
    ({"b": np.array(0.0)}, (), "b is 0, expected a positive"),
    ({"b": np.array(np.nan)}, (), "b is nan, expected a finite number"),
    ({"b": np.array([0.5, 0.5])}, (), "b has 2 values, expected one finite number"),
    ({"imu_T_cam": 2.0 * np.eye(4)}, (), "imu_T_cam is not a rotation"),
    ({"K": np.full((3, 3), "x")}, (), "K holds text, expected real numbers"),
    ({"K": np.full((3, 3), np.nan)}, (), "K is not finite"),
    ({"K": K(m00=0.0, m11=0.0)}, (), "fx in K is 0"),
    ({"features": many(400.0, 200.0, 380.0, 197.0)}, (), "vL - vR is 3.. px .* rectify the images"),
    ({"features": many(400.0, 200.0, 380.0, 212.0, struck=0.375)}, (), "in 38% of 40 sightings .* rectify the images"),
    ({"features": many(200.0, 400.0, 200.0, 380.0, struck=0.375)}, (), "in 38% of 40 .* u and v look exchanged"),
]
UTIAS: list[Broken] = [
    ({}, ("theta_vk_i", "b"), "missing theta_vk_i, b; it has C_c_v"),
    ({"v_vk_vk_i": np.ones((3, 3))}, (), "v_vk_vk_i has 3 columns for 4 stamps"),
    ({"y_k_j": np.ones((4, 9, 3))}, (), "y_k_j has shape"),
    ({"t": np.zeros((1, 1)), "y_k_j": np.ones((4, 1, 3))}, (), r"1 frame\(s\)"),
    ({"t": OBJECTS}, (), "t holds objects"),
    ({"fu": "wide"}, (), "fu holds"),
    ({"r_i_vk_i": np.full((3, 6), np.nan)}, (), "r_i_vk_i is not finite"),
    ({"C_c_v": np.ones((3, 3))}, (), "C_c_v is not a rotation"),
]


@pytest.mark.parametrize(("name", "broken"), [*(("course", row) for row in COURSE), *(("utias", row) for row in UTIAS)])
def test_arrays(name: str, broken: Broken, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    exchanged, left_out, says = broken
    sound: Arrays = request.getfixturevalue(name)
    arrays = {key: value for key, value in (sound | exchanged).items() if key not in left_out}
    path = tmp_path / "broken"
    with path.open("wb") as file:
        (np.savez if name == "course" else lambda stream, **values: scipy.io.savemat(stream, values))(file, **arrays)
    assert_refused(lambda: load_sequence(str(path)), path, says)


def edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    """Return what replaces a text in a file of a folder."""
    return lambda folder: replace(folder / name, old, new)


def cell(row: int, column: int, value: str) -> Callable[[Path], None]:
    """Return what exchanges a cell of tracks.csv."""

    def change(folder: Path) -> None:
        lines = (folder / "tracks.csv").read_text().splitlines()
        cells = lines[row].split(",")
        lines[row] = ",".join([*cells[:column], value, *cells[column + 1 :]])
        (folder / "tracks.csv").write_text("\n".join(lines))

    return change


def lines(name: str, keep: Callable[[list[str]], list[str]]) -> Callable[[Path], object]:
    """Return what keeps, or repeats, lines of a file of a folder."""
    return lambda d: (d / name).write_text("".join(keep((d / name).read_text().splitlines(keepends=True))))


def remove(*names: str) -> Callable[[Path], object]:
    return lambda d: [(d / name).unlink() for name in names]


def calibration(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    """Return what changes the calib.json of an export."""

    def apply(folder: Path) -> None:
        values = json.loads((folder / "calib.json").read_text())
        change(values)
        (folder / "calib.json").write_text(json.dumps(values))

    return apply


def truncated_gzip(folder: Path) -> None:
    content = gzip.compress((folder / "imu.csv").read_bytes())
    (folder / "imu.csv").write_bytes(content[: len(content) // 2])


OPENVINS: list[tuple[Callable[[Path], object], str]] = [
    (remove("imu.csv", "features.csv"), "missing imu.csv, features.csv"),
    (remove("calib.json"), "missing calib.json"),
    (calibration(lambda c: c.pop("imu")), "missing imu.accel_noise_density, imu.gyro"),
    (calibration(lambda c: c.update(pixel_noise_sigma=None)), "missing pixel_noise_sigma"),
    (calibration(lambda c: c.update(gravity_world=[[0], 0, 1])), "gravity_world holds text"),
    (lambda d: (d / "calib.json").write_text('{"cam0": '), "not valid JSON"),
    (lambda d: (d / "calib.json").write_text('["cam0"]'), "holds a JSON list"),
    (edit("features.csv", "uL,vL", "u,v"), "missing column uL .*, vL"),
    (edit("features.csv", "300", "many"), "features.csv: line 2: uL is many, expected a number"),
    (edit("imu.csv", "0.1,0.2,0.3,1,2,9.8\n", "0.1\n"), "imu.csv: line 2 has 2 columns, expected 7"),
    (truncated_gzip, "damaged or truncated gzip"),
    (lines("imu.csv", lambda all_lines: all_lines[:1]), "imu.csv: holds no rows"),
    (lines("truth_cam.csv", lambda all_lines: all_lines[:1]), "truth_cam.csv: holds no rows"),
    (lines("features.csv", lambda all_lines: all_lines[:5]), r"1 frame\(s\)"),
    (edit("truth_cam.csv", ",1,1,0", ",1,0,0"), "line 3 has a quaternion"),
]
OWN: list[tuple[Callable[[Path], object], str]] = [
    (remove("imu.csv"), r"missing imu\.csv or twist\.csv"),
    (edit("tracks.csv", "\n", "\n7,"), r"line 2 has 6 columns, expected 5|line 2 has 7 columns, expected 6"),
    (edit("tracks.csv", "t_ns,", "t,"), "must be in seconds, but the stamps look like nanoseconds"),
    (cell(4, 1, "1.5"), "line 5: track_id is 1.5, expected a whole number"),
    (cell(6, 2, ""), "line 7: uL is empty, expected a number"),
    (cell(3, 0, "never"), "line 4: t_ns is never, expected a whole number"),
    (cell(3, 0, "1" * 30), "line 4: t_ns is 1+, expected a whole number of at most 9223372036854775807"),
    (edit("rig.toml", "accel_noise_density", "acc_noise_density"), "there is no noise.acc_noise_density; did you mean"),
    (edit("rig.toml", "fx_px = ", "fx_px = -"), "fx_px is -.*, expected a positive number"),
    (edit("rig.toml", "fx_px = ", "f_px = "), "there is no f_px; did you mean fx_px"),
    (edit("rig.toml", "fx_px = ", f"fx_px = 1{400 * '0'} #"), "fx_px is inf, expected a finite number"),
    (edit("rig.toml", "T_imu_cam = [[", "T_imu_cam = [[{}], ["), "T_imu_cam holds text, expected real numbers"),
    (edit("rig.toml", "cy_px = ", "cy_px = '"), "is not TOML"),
    (edit("rig.toml", "T_imu_cam = [[", "T_imu_cam = [[1, 2, 3, 4], ["), "T_imu_cam"),
    (edit("rig.toml", "gyro_random_walk", "#"), "missing noise.gyro_random_walk; an IMU's data sheet has them"),
]


@pytest.mark.parametrize(("spoil", "says"), OPENVINS)
def test_exports_of_openvins(openvins: Path, spoil: Callable[[Path], object], says: str) -> None:
    spoil(openvins)
    assert_refused(lambda: load_sequence(str(openvins)), openvins, says)


@pytest.mark.parametrize(("spoil", "says"), OWN)
def test_own_tables(tmp_path: Path, spoil: Callable[[Path], object], says: str) -> None:
    folder = written(recorded("imu"), tmp_path / "own")
    spoil(folder)
    assert_refused(lambda: load_sequence(str(folder)), folder, says)


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
def test_a_cell_of_a_trajectory(tmp_path: Path, name: str, row: int, column: int, word: str, says: str) -> None:
    rng = np.random.default_rng(5)
    poses = se3(so3_exp(rng.normal(size=(6, 3))), rng.normal(size=(6, 3)))
    separator = "," if name == "euroc" else " "
    text = FORMATS[name].text(Trajectory(1_600_000_000_123_456_789 + 10**8 * np.arange(6), poses))
    rows = [line.split(separator) for line in text.splitlines() if not line.startswith("#")]
    path = tmp_path / "poses"

    def write() -> None:
        path.write_text("\n".join(separator.join(cells) for cells in rows))

    width = len(rows[0])
    rows[row][column] = rows[row - 1][column] if word == "the same" else word
    write()
    assert_refused(lambda: read_poses(path), path, says)
    del rows[row][4:]
    write()
    columns = re.escape(f"has 4 columns, expected {width} ({FORMATS[name].columns})")
    assert_refused(lambda: read_poses(path), path, f"line {row + 1} {columns}")


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


OTHERS = [
    (b"", "is empty"),
    (b"hello world", r"of no known format; there are .*course-npz"),
    (b"PK\x03\x04", r"of no known format; there are .*course-npz"),
    (gzip.compress(b"a bag"), r"is packed \(gzip\).*unpack it"),
    (b"\x28\xb5\x2f\xfd" + bytes(9), r"is packed \(zstd\)"),
    (b"1.5 0 0 0 0 0 0 1\n2.5 1 0 0 0 0 0 1\n", "is a trajectory and no recording; .* --trajectory NAME=FILE"),
]


@pytest.mark.parametrize(("content", "says"), OTHERS)
def test_a_file_that_is_no_recording(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "drive").write_bytes(content)
    assert_refused(lambda: load_sequence(str(tmp_path / "drive")), tmp_path / "drive", says)
