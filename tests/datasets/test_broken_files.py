"""One table of files that are wrong in one thing each: every one is refused in one line that names the file and words.

Folders of images have a table of their own beside them (tests/frontend/test_folders.py).
"""

import gzip
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from tests.datasets.conftest import assert_refused
from tests.datasets.conftest import edit as change
from tests.datasets.test_euroc import orientations, truth_text, write
from tests.datasets.test_euroc import recording as asl_folder
from tests.datasets.test_kitti_odometry import drive as odometry
from tests.datasets.test_kitti_odometry import stamps
from tests.datasets.test_kitti_raw import drive as raw
from tests.datasets.test_own_tables import recorded, written
from toolkit.datasets import load_sequence, vislam_recording
from toolkit.datasets.io.fields import read_fields
from toolkit.datasets.io.truth import load_truth
from toolkit.datasets.trajectories import FORMATS, read_poses
from toolkit.estimate import Trajectory
from toolkit.geometry import se3, so3_exp

__all__ = ["asl_folder", "odometry", "raw"]  # fixtures
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
    return lambda folder: change(folder / name, old, new)


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


def edit_json(name: str, change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    """Return what changes a JSON document of a folder."""

    def apply(folder: Path) -> None:
        values = json.loads((folder / name).read_text())
        change(values)
        (folder / name).write_text(json.dumps(values))

    return apply


def truncated_gzip(folder: Path) -> None:
    content = gzip.compress((folder / "imu.csv").read_bytes())
    (folder / "imu.csv").write_bytes(content[: len(content) // 2])


Spoiled = tuple[Callable[[Path], object], str]
OPENVINS: list[Spoiled] = [
    (remove("imu.csv", "features.csv"), "missing imu.csv, features.csv"),
    (remove("calib.json"), "missing calib.json"),
    (edit_json("calib.json", lambda c: c.pop("imu")), "missing imu.accel_noise_density, imu.gyro"),
    (edit_json("calib.json", lambda c: c.update(pixel_noise_sigma=None)), "missing pixel_noise_sigma"),
    (edit_json("calib.json", lambda c: c.update(gravity_world=[[0], 0, 1])), "gravity_world holds text"),
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
OWN: list[Spoiled] = [
    (remove("imu.csv"), r"missing imu\.csv or twist\.csv"),
    (edit("tracks.csv", "\n", "\n7,"), r"line 2 has 6 columns, expected 5|line 2 has 7 columns, expected 6"),
    (edit("tracks.csv", "t_ns,", "t,"), "must be in seconds, but the stamps look like nanoseconds"),
    (cell(4, 1, "1.5"), "line 5: track_id is 1.5, expected a whole number"),
    (cell(6, 2, ""), "line 7: uL is empty, expected a number"),
    (cell(3, 0, "never"), "line 4: t_ns is never, expected a whole number"),
    (cell(3, 0, "1" * 30), "line 4: t_ns is 1+, expected a whole number of 64 bits"),
    (edit("rig.toml", "accel_noise_density", "acc_noise_density"), "there is no noise.acc_noise_density; did you mean"),
    (edit("rig.toml", "fx_px = ", "fx_px = -"), "fx_px is -.*, expected a positive number"),
    (edit("rig.toml", "fx_px = ", "f_px = "), "there is no f_px; did you mean fx_px"),
    (edit("rig.toml", "fx_px = ", f"fx_px = 1{400 * '0'} #"), "fx_px is inf, expected a finite number"),
    (edit("rig.toml", "T_imu_cam = [[", "T_imu_cam = [[{}], ["), "T_imu_cam holds text, expected real numbers"),
    (edit("rig.toml", "cy_px = ", "cy_px = '"), "is not TOML"),
    (edit("rig.toml", "T_imu_cam = [[", "T_imu_cam = [[1, 2, 3, 4], ["), "T_imu_cam"),
    (edit("rig.toml", "gyro_random_walk", "#"), "missing noise.gyro_random_walk; an IMU's data sheet has them"),
]


def another_day(stamps: Path) -> None:
    stamps.write_text(stamps.read_text().replace("2011-09-26", "2011-09-30"))


ODOMETRY: list[Spoiled] = [
    (lambda d: change(d / "calib.txt", "P1", "P7"), "missing P1, twelve numbers each; it has P0, P7, Tr"),
    (lambda d: (d / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n"), "1 poses for 8 images"),
    (lambda d: (d / "times.txt").write_text("0\n0.1\nx\n"), "times.txt: line 3 is not numeric .* expected one number"),
    (lambda d: stamps(d, lambda k: f"{k}00000000"), "look like nanoseconds: divide by 1e9"),
    (lambda d: (d / "times.txt").write_text(""), "times.txt has one number a line, in seconds"),
]
CAMS, IMU = "calib_cam_to_cam.txt", "calib_imu_to_velo.txt"
RAW: list[Spoiled] = [
    (lambda d: change(d.parent / IMU, "T: 0 0 0", "T: 0 O 0"), f"{IMU}: missing T; it has R"),
    (lambda d: change(d.parent / CAMS, "-1.000000000e+02", "1.0e+02"), "is not to the right of the left"),
    (lambda d: (d / "image_00/timestamps.txt").unlink(), "timestamps.txt: cannot be read"),
    (lambda d: (d / "image_00/timestamps.txt").write_text("\n\n"), "holds no stamps"),
    (lambda d: (d / "oxts/data/0000000003.txt").write_text("1 2 3"), "0000000003.txt: 3 numbers"),
    (lambda d: shutil.rmtree(d / "image_01"), "image_00/data has images and image_01/data has none"),
    (
        lambda d: [p.unlink() for p in d.glob("image_*/data/*")],
        r"image_00/data and image_01/data, .* with images; unpack them there \(.png",
    ),
    (lambda d: another_day(d / "oxts/timestamps.txt"), "in the time of the oxts packets.*two recordings"),
]


def shift_truth(recording: Path) -> None:
    truth_s = np.arange(100.0, 102.0, 0.005)
    write(recording / "mav0/state_groundtruth_estimate0/data.csv", truth_text(truth_s, orientations(truth_s)))


def scale_truth(recording: Path, factor: float) -> None:
    """Write positions in another unit."""
    path = recording / "mav0/state_groundtruth_estimate0/data.csv"
    heading, *lines = path.read_text().splitlines()
    rows = [line.split(",") for line in lines]
    scaled = [[row[0], *(f"{factor * float(x):.12g}" for x in row[1:4]), *row[4:]] for row in rows]
    write(path, "\n".join([heading, *map(",".join, scaled)]) + "\n")


TRUTH = "state_groundtruth_estimate0"
# Nine lists of ten, each of the one before it: 600 characters that stand for a billion values.
BOMB = "a0: &a0 [1]\n" + "".join(f"a{i}: &a{i} [{', '.join(10 * [f'*a{i - 1}'])}]\n" for i in range(1, 10))
EUROC: list[Spoiled] = [
    (lambda d: shutil.rmtree(d / "mav0" / TRUTH), "no ground truth in mav0/state_groundtruth_estimate0"),
    (shift_truth, "overlap by less than 0.2 s"),
    (lambda d: (d / "mav0/cam0/data.csv").unlink(), "cam0/data.csv: cannot be read"),
    (lambda d: change(d / "mav0/imu0/data.csv", "w_RS_S_y", "rate_y"), "imu0/data.csv: missing column w_RS_S_y"),
    (lambda d: change(d / "mav0/cam0/sensor.yaml", "248.0]", "248.0"), "line 16: expected .* truncated"),
    (lambda d: (d / "mav0/cam0/sensor.yaml").write_text(BOMB), "more than 100000 values, with those that aliases"),
    (lambda d: change(d / "mav0/cam0/sensor.yaml", "rate_hz", "sensor_type"), "gives sensor_type a second time"),
    (lambda d: change(d / "mav0/cam0/sensor.yaml", "-1,", "-2,"), "T_BS is not a rotation"),
    (
        lambda d: scale_truth(d, 1e6),
        r"swing: the truth spans \S+ m, and tracks are simulated in a room; check its unit",
    ),
]


def test_a_rig_of_many_cameras_may_share_what_they_have(tmp_path: Path) -> None:
    shared = "".join(f"cam{i}:\n  T: *T\n  resolution: *size\n" for i in range(1, 9))
    (tmp_path / "rig.yaml").write_text(f"cam0:\n  T: &T [[1, 0], [0, 1]]\n  resolution: &size [3, 2]\n{shared}")
    np.testing.assert_array_equal(read_fields(tmp_path / "rig.yaml").arrays["cam8.T"], np.eye(2))


def edit_arrays(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        with np.load(folder / "recording.npz") as archive:
            arrays = dict(archive)
        change(arrays)
        np.savez_compressed(folder / "recording.npz", **arrays)

    return damage


def wrong_frame(arrays: dict[str, Any]) -> None:
    arrays["observations_frame"][-1] = 99


VISLAM: list[Spoiled] = [
    (lambda f: (f / "recording.npz").unlink(), "No such file"),
    (lambda f: (f / "recording.json").write_text('{"schema": "vislam'), "cannot be read as JSON"),
    (lambda f: (f / "recording.json").write_text("[]"), "has not the schema"),
    (edit_json("recording.json", lambda t: t.update(schema="vislam.recording/9")), "vislam.recording/9"),
    (edit_json("recording.json", lambda t: t.pop("rig")), "lacks `?rig"),
    (edit_json("recording.json", lambda t: t["rig"].update(fx_px=10**400)), "does not fit"),
    (edit_json("recording.json", lambda t: t["rig"].update(T_imu_cam=np.eye(3).tolist())), "T_imu_cam"),
    (edit_json("recording.json", lambda t: t["motion"].update(kind="gps")), "gps"),
    (edit_json("recording.json", lambda t: t["motion"].update(pairing="middle")), "middle"),
    (lambda f: np.save((f / "recording.npz").open("wb"), np.eye(3)), "damaged"),
    (edit_arrays(lambda a: a.update(motion_values=np.array([{}], dtype=object))), "never unpickled"),
    (edit_arrays(lambda a: a.pop("frames_t_ns")), "frames_t_ns is missing"),
    (edit_arrays(lambda a: a.update(motion_values=a["motion_values"][:, :5])), "motion_values"),
    (edit_arrays(lambda a: a.update(observations_track_id=a["observations_track_id"][1:])), "differ in length"),
    (edit_arrays(lambda a: a.update(frames_t_ns=a["frames_t_ns"][:-1])), "copy both files again"),
    (edit_arrays(wrong_frame), "is of frame 99"),
    (edit_json("recording.json", lambda t: t["provenance"].update(facts=[3])), "provenance.facts.0.: expected string"),
    (edit_arrays(lambda a: a.update(motion_values=a["motion_values"] * 1j)), "holds complex128"),
    (edit_arrays(lambda a: a.update(prior_cov=-a["prior_cov"])), "not positive definite"),
    (edit_arrays(lambda a: a.update(observations_frame=a["observations_frame"][::-1])), "not sorted"),
]


@pytest.fixture
def own(tmp_path: Path) -> Path:
    return written(recorded("imu"), tmp_path / "own")


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    vislam_recording.save(recorded("twist"), tmp_path / "saved")
    return tmp_path / "saved"


FOLDERS = {"openvins": OPENVINS, "own": OWN, "odometry": ODOMETRY, "raw": RAW, "asl_folder": EUROC, "saved": VISLAM}


@pytest.mark.parametrize(("kind", "row"), [(kind, row) for kind, rows in FOLDERS.items() for row in rows])
def test_a_folder(kind: str, row: Spoiled, request: pytest.FixtureRequest) -> None:
    folder, (spoil, says) = request.getfixturevalue(kind), row
    spoil(folder)
    # What is wrong with a raw drive may be in the files of its day.
    assert_refused(lambda: load_sequence(str(folder)), folder.parent if kind == "raw" else folder, says)


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
    (gzip.compress(b"a bag"), "is packed, unpack it with gunzip"),
    (b"\x28\xb5\x2f\xfd" + bytes(9), "is packed, unpack it with unzstd"),
    (b"1.5 0 0 0 0 0 0 1\n2.5 1 0 0 0 0 0 1\n", "is a trajectory and no recording; .* --trajectory NAME=FILE"),
]


@pytest.mark.parametrize(("content", "says"), OTHERS)
def test_a_file_that_is_no_recording(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "drive").write_bytes(content)
    assert_refused(lambda: load_sequence(str(tmp_path / "drive")), tmp_path / "drive", says)
