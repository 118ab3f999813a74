"""What is wrong with a recording is told in one line, and whoever does what it says is not told the same again (10 s).

One table of recordings that are wrong in one thing each.
"""

import gzip
import json
import os
import re
import shutil
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io

import toolkit
from tests.advice import TOOLKIT, advice_in, is_followed, unknown_beginnings
from tests.datasets.conftest import edit as replace_in
from tests.datasets.test_course_npy import T_REGULAR_OPTICAL, as_course, save_npy
from tests.datasets.test_kitti_raw import DRIVE, packet
from tests.datasets.test_kitti_raw import drive as day_and_drive
from tests.datasets.test_own_tables import recorded, rig_of, tables_of, written
from tests.frontend.conftest import IMU_NOISE, START_NS, camera_yaml, write_asl
from tests.frontend.test_bags import Item, Ros, images_of, motion_of, raw
from toolkit import load_sequence
from toolkit.audit import Audit
from toolkit.cli import main
from toolkit.datasets import load_references, vislam_recording
from toolkit.errors import VislamError
from toolkit.experiment import recording
from toolkit.frontend import Camera
from toolkit.geometry import se3, se3_exp
from toolkit.sequence import Sequence, check_runnable

__all__ = ["day_and_drive"]


Writer = Callable[[Path, dict[str, Any]], object]


@dataclass
class Case:
    """A recording that steps change: files, or the content of one file; the sound one; what is typed or called."""

    at: Path
    sound: Any
    writer: Writer | None = None
    content: dict[str, Any] = field(default_factory=dict)
    typed: tuple[str, ...] | Callable[[Path], object] = ()
    usual: tuple[str, ...] = ("check-data", "@")

    def __post_init__(self) -> None:
        self.write = self.writer

    def outcome(self, capsys: pytest.CaptureFixture[str]) -> str:
        """Return the refusal, empty where there is none; of what is typed, @ is the recording, @/.. where it is."""
        if self.write is not None:
            self.write(self.at, self.content)
        if callable(self.typed):
            try:
                self.typed(self.at)
            except VislamError as error:
                return str(error)
            return ""
        words = [word.replace("@/..", str(self.at.parent)) for word in self.typed or self.usual]
        try:
            status = main([word.replace("@", str(self.at)) for word in words])
        except SystemExit as left:  # argparse leaves this way
            status = int(left.code or 0)
        told = capsys.readouterr().err
        assert (status != 0) == told.startswith("vislam: error: ")
        assert told.count("\n") <= 1
        return told


Step = Callable[[Case], object]
Lines = Callable[[list[str]], list[str]]


def put(**arrays: Any) -> Step:
    return lambda case: case.content.update(arrays)


def gone(*names: str) -> Step:
    def remove(case: Case) -> None:
        for name in names:
            case.content.pop(name, None)
            path = case.at / name
            shutil.rmtree(path) if path.is_dir() else path.unlink() if path.is_file() else None

    return remove


def sound(case: Case) -> None:
    """Put in what is asked for: the recording is as it was, and so is what is typed."""
    case.typed, case.write = (), case.writer
    if isinstance(case.sound, dict):
        case.content = dict(case.sound)
    else:
        shutil.rmtree(case.at)
        shutil.copytree(case.sound, case.at)


def edit(name: str, old: str, new: str) -> Step:
    return lambda case: replace_in(case.at / name, old, new)


def text(name: str, content: str | bytes) -> Step:
    return lambda case: (case.at / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def lines(name: str, change: Lines) -> Step:
    """Return what changes the lines of a table; but for its heading, ``of_rows`` of it."""
    return lambda case: text(name, "".join(change((case.at / name).read_text().splitlines(True))))(case)


def of_rows(change: Callable[[str, str], str]) -> Lines:
    """Return what changes the first cell and the rest of each row behind the heading."""
    return lambda table: [table[0], *(change(*line.split(",", 1)) for line in table[1:])]


def restamped(change: Callable[[int], int]) -> Lines:
    return of_rows(lambda t, rest: f"{change(int(t))},{rest}")


def moved(pattern: str, name: Callable[[Path], str]) -> Step:
    """Return what renames files."""
    return lambda case: [path.rename(path.with_name(name(path))) for path in sorted(case.at.glob(pattern))]


def swap(one: str, other: str) -> Step:
    return lambda case: [(case.at / a).rename(case.at / b) for a, b in ((one, "x"), (other, one), ("x", other))]


def pixels(pattern: str, change: Callable[[Any], Any], ending: str = ".png") -> Step:
    def draw(case: Case) -> None:
        for path in case.at.glob(pattern):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            path.unlink()
            cv2.imwrite(str(path.with_suffix(ending)), change(image))

    return draw


def files(folder: str, content: Callable[[Path], bytes]) -> Step:
    """Return what writes other bytes into each file of a folder."""
    return lambda case: [path.write_bytes(content(path)) for path in (case.at / folder).iterdir()]


def rolled(case: Case) -> None:
    """Move all rows by ten from pair to pair, as where the camera tilts, and call right images a pair too early."""
    for path in case.at.glob("image_?/*.png"):
        cv2.imwrite(str(path), np.roll(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), 10 * int(path.stem), axis=0))
    later(-1)(case)


def later(by: int, count: int = 5) -> Step:
    """Return what calls each right image by another number, the last by the first."""
    return both(
        moved("image_1/*.png", lambda path: f"{(int(path.stem) + by) % count:06d}.p"),
        moved("image_1/*.p", lambda path: f"{path.name}ng"),
    )


def say(*words: str) -> Step:
    return lambda case: setattr(case, "typed", words)


def check(*words: str) -> Step:
    return say("check-data", "@", *words)


def call(of: Callable[[Path], object]) -> Step:
    """Return what calls a function of the toolkit with the recording in the place of a command."""
    return lambda case: setattr(case, "typed", of)


def write(of: Callable[..., object]) -> Step:
    return lambda case: setattr(case, "write", of)


def cut(share: float) -> Step:
    """Return what leaves a share of a file."""

    def shorten(case: Case) -> None:
        assert case.writer is not None
        case.writer(case.at, case.content)
        content = case.at.read_bytes()
        case.write = lambda path, _: path.write_bytes(content[: int(share * len(content))])

    return shorten


def document(name: str, change: Callable[[dict[str, Any]], object]) -> Step:
    """Return what changes a JSON document of a folder."""

    def apply(case: Case) -> None:
        values = json.loads((case.at / name).read_text())
        change(values)
        (case.at / name).write_text(json.dumps(values))

    return apply


def arrays(change: Callable[[dict[str, Any]], object]) -> Step:
    """Return what changes the arrays of a recording of the toolkit's own."""

    def apply(case: Case) -> None:
        with np.load(case.at / "recording.npz") as archive:
            values = dict(archive)
        change(values)
        np.savez_compressed(case.at / "recording.npz", **values)

    return apply


def cell(row: int, column: int, value: str) -> Step:
    """Return what exchanges a cell of tracks.csv."""

    def exchanged(table: list[str]) -> list[str]:
        cells = table[row].rstrip().split(",")
        return [*table[:row], ",".join([*cells[:column], value, *cells[column + 1 :]]) + "\n", *table[row + 1 :]]

    return lines("tracks.csv", exchanged)


def both(*steps: Step) -> Step:
    return lambda case: [step(case) for step in steps]


# Sound recordings ----------------------------------------------------------------------------------------------------

PERIOD_NS, FRAMES = 50_000_000, 5
CAMERA = Camera((250.0, 250.0, 160.0, 100.0), "none", np.zeros(4), (320, 200))
T_LEFT_RIGHT = se3(np.eye(3), np.array([0.4, 0.0, 0.0]))
PLACES = [np.linalg.matrix_power(T_LEFT_RIGHT, side) for side in (0, 1)]
TABLES, YAMLS = ([f"mav0/cam{side}/{name}" for side in (0, 1)] for name in ("data.csv", "sensor.yaml"))
IMAGES = ["mav0/cam0/data", "mav0/cam1/data"]
LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"


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


def save_npz(path: Path, arrays: dict[str, Any]) -> None:
    np.savez(path, **arrays)


def save_twice(path: Path, arrays: dict[str, Any]) -> None:
    """Write an archive in which the first array stands twice."""
    np.savez(path, **arrays)
    with zipfile.ZipFile(path, "a") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        archive.writestr(archive.namelist()[0], archive.read(archive.namelist()[0]))


def save_short(path: Path, arrays: dict[str, Any]) -> None:
    """Write an archive whose features end before their header says."""
    np.savez(path, **{key: array for key, array in arrays.items() if key != "features"})
    with zipfile.ZipFile(path, "a") as archive, archive.open("features.npy", "w") as stream:
        header = {"descr": "<f8", "fortran_order": False, "shape": arrays["features"].shape}
        np.lib.format.write_array_header_1_0(stream, header)
        stream.write(arrays["features"].tobytes()[:-20])


@pytest.fixture(scope="session")
def film(kitti_drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of KITTI's odometry, and beside it one of ASL with the same images."""
    odometry = Path(shutil.copytree(kitti_drive, tmp_path_factory.mktemp("advice") / "odometry"))
    asl, stamps = odometry.with_name("asl"), [START_NS + PERIOD_NS * k for k in range(FRAMES)]
    for path in odometry.glob("image_?/*.png"):
        if int(path.stem) >= FRAMES:
            path.unlink()
    for name in ("times.txt", "poses.txt"):
        (odometry / name).write_text("".join((odometry / name).read_text().splitlines(True)[:FRAMES]))
    write_asl(asl, CAMERA, PLACES, stamps)
    for side in (0, 1):
        for t_ns, path in zip(stamps, sorted((odometry / f"image_{side}").iterdir()), strict=True):
            shutil.copy(path, asl / IMAGES[side] / f"{t_ns}.png")
    poses = ((k, (START_NS + PERIOD_NS * k) / 1e9) for k in range(-1, FRAMES + 1))
    (asl / "truth.tum").write_text("".join(f"{t:.9f} 0 0 {0.05 * k} 0 0 0 1\n" for k, t in poses))
    return odometry.parent


@pytest.fixture
def given(kind: str, request: pytest.FixtureRequest, tmp_path: Path, film: Path) -> Case:
    """Return a sound recording of the kind that the test is called with."""
    at, kept, usual = tmp_path / f"drive.{kind}", tmp_path / "sound", ("check-data", "@")
    fixtures = {"npz": "course", "mat": "utias", "export": "openvins", "day": "day_and_drive"}
    made = request.getfixturevalue(fixtures[kind]) if kind in fixtures else None
    if kind in ("npz", "mat", "npy", "bag", "bare"):
        content = as_course(film / "odometry") if kind == "npy" else made
        content = messages(film / "asl", bare=kind == "bare") if content is None else content
        if kind == "bag":
            beside(Case(at, None))
        writers: dict[str, Writer] = {"npz": save_npz, "mat": scipy.io.savemat, "npy": save_npy}
        return Case(at, dict(content), writers.get(kind, write_bag), content)
    if kind in ("own", "twist"):
        written(recorded("imu" if kind == "own" else kind), kept)
    elif kind == "saved":
        vislam_recording.save(recorded("twist"), kept)
    elif kind in ("export", "day"):
        shutil.copytree(made if kind == "export" else made.parent, kept)
        usual = usual if kind == "export" else ("check-data", f"@/{Path(DRIVE).name}")
    else:
        kept = film / kind
    return Case(Path(shutil.copytree(kept, at)), kept, usual=usual)


ROS = Ros.of("ros1")
Items = list[Item]


def write_bag(path: Path, content: dict[str, Any]) -> None:
    path.unlink(missing_ok=True)
    ROS.write(path, content["items"])


def messages(asl: Path, *, bare: bool) -> dict[str, Any]:
    """Return a bag of the images and the IMU; rectified ones with their calibration where it is ``bare``."""
    items = [*motion_of(asl, ROS), *images_of(asl, raw(ROS))]
    renamed = [one._replace(topic=one.topic.replace("image_raw", "image_rect")) for one in items]
    return {"items": [*renamed, *calibration(PLACES)] if bare else items}


def calibration(places: list[Any], unstated: str = "") -> Items:
    """Return CameraInfo of both cameras, one of its matrices zero, and where they are mounted."""
    sensor = {"intrinsics": CAMERA.pinhole_px, "distortion_coefficients": [0.0] * 4, "resolution": CAMERA.size_px}
    infos = [ROS.camera_info(START_NS, f"cam{side}", sensor) for side in (0, 1)]
    for side, info in enumerate(infos):
        info.value.P[[0, 2, 3, 5, 6, 10]] = 250.0, 160.0, -100.0 * side, 250.0, 100.0, 1.0
        if unstated:
            getattr(info.value, unstated).fill(0.0)
    return [ROS.static(START_NS, {f"cam{side}": T for side, T in enumerate(places)}), *infos]


def beside(case: Case) -> None:
    """Put an ASL folder's calibration beside a bag."""
    for sensor, T in zip(("cam0", "cam1", "imu0"), (*PLACES, np.eye(4)), strict=True):
        (case.at.parent / sensor).mkdir()
        (case.at.parent / sensor / "sensor.yaml").write_text(camera_yaml(CAMERA, T) + IMU_NOISE)


def items(change: Callable[[Items], Items]) -> Step:
    return lambda case: case.content.update(items=change(case.content["items"]))


def without(*parts: str) -> Step:
    return items(lambda all_: [one for one in all_ if not any(part in one.topic for part in parts)])


def topic(old: str, new: str) -> Step:
    return items(lambda all_: [one._replace(topic=one.topic.replace(old, new)) for one in all_])


def more(*added: Item) -> Step:
    return items(lambda all_: [*all_, *added])


def compressed(make: Callable[[Item], tuple[int, bytes]]) -> Step:
    """Return what writes images as compressed ones, of a stamp and of bytes."""

    def packed(one: Item) -> Item:
        t_ns, content = make(one)
        return ROS.compressed(t_ns, one.topic[1:5], content)

    return items(lambda all_: [packed(one) if "cam" in one.topic else one for one in all_])


def imu(name: str, late_ns: int = 0, gyro: float = 1.0, accel: float = 1.0) -> list[Item]:
    stamps = START_NS + PERIOD_NS * np.arange(-1, FRAMES + 1, 0.1)
    samples = [ROS.imu(int(t) + late_ns, [0.0, 0.01 * gyro, 0.0], [0.0, 0.0, 9.81 * accel]) for t in stamps]
    return [one._replace(topic=name) for one in samples]


def wheels(name: str, speed_mps: float, kind: str = "nav_msgs/msg/Odometry") -> list[Item]:
    twist = {"linear": [speed_mps, 0.0, 0.0]}
    parts = {"child_frame_id": "imu0", "twist": {"twist": twist}} if kind.endswith("Odometry") else {"twist": twist}
    stamps = range(START_NS - PERIOD_NS, START_NS + FRAMES * PERIOD_NS, PERIOD_NS)
    return [ROS.item(t_ns, name, kind, "imu0", **parts) for t_ns in stamps]


def in_frame(one: Item, frame: str) -> Item:
    return one._replace(value=replace(one.value, header=replace(one.value.header, frame_id=frame)))


def of_one_frame(all_: Items) -> Items:
    return [in_frame(one, "0") if one.topic in ("/imu0", "/cam0/image_rect") else one for one in all_]


def elsewhere() -> list[Item]:
    """Return the messages of another IMU, twice as many, on a body that nothing joins to the camera."""
    return [in_frame(one, "base_link") for one in (*imu("/base/imu"), *imu("/base/imu", 2_000_000))]


def chain(first: str = "T_cam_imu", second: str = "cam1") -> Step:
    """Return what puts Kalibr's file in the place of the sensor.yaml of both cameras, with other names in it."""
    lens = "  camera_model: pinhole\n  distortion_model: none\n  distortion_coeffs: [0, 0, 0, 0]\n"
    lens += f"  intrinsics: {list(CAMERA.pinhole_px)}\n  resolution: [320, 200]\n"
    places = {"cam0": f"{first}: {np.eye(4).tolist()}", second: f"T_cn_cnm1: {np.linalg.inv(T_LEFT_RIGHT).tolist()}"}
    written_out = "".join(f"{name}:\n  {place}\n{lens}" for name, place in places.items())
    return both(gone(*YAMLS), text("camchain.yaml", written_out))


def as_kitti(case: Case) -> None:
    """Lay an ASL folder's images out as KITTI's, and name that folder."""
    for side in (0, 1):
        (case.at / f"kitti/image_{side}").mkdir(parents=True)
        for k, path in enumerate(sorted((case.at / IMAGES[side]).iterdir())):
            shutil.copy(path, case.at / f"kitti/image_{side}/{k:06d}.png")
    rows = (f"P{i}: 250 0 160 {-100 * i} 0 250 100 0 0 0 1 0\n" for i in (0, 1))
    both(text("kitti/calib.txt", "".join(rows)), say("check-data", "@/kitti"))(case)


def bag_inside(case: Case) -> None:
    """Put the measurements of an ASL folder into a bag in a folder of it."""
    (case.at / "bag").mkdir()
    write_bag(case.at / "bag/film.bag", messages(case.at, bare=False))
    beside(Case(case.at / "bag/film.bag", None))
    (case.at / "mav0/imu0/data.csv").unlink()


def apart(by_ns: int) -> Lines:
    """Return what writes accelerometer and gyro, so much later, in rows of their own."""

    def two(t: str, rest: str) -> str:
        values = rest.strip().split(",")
        return f"{t},{','.join(values[:3])},,,\n{int(t) + by_ns},,,,{','.join(values[3:])}\n"

    return of_rows(two)


def of_kilometres(rows: list[str]) -> list[str]:
    return [f"{row[:20]} {9e3 * k} {9e3 * k} 0 0 0 0 1\n" for k, row in enumerate(rows)]


def in_seconds(t: str, rest: str) -> str:
    return f"{int(t) / 1e9:.9f},{rest}"


# Advice --------------------------------------------------------------------------------------------------------------

OWN = tables_of(recorded("imu")) | {"rig": rig_of(recorded("imu"))}
FEW_S = 0.1 * np.arange(5)[None]
IMPORT = ("import", "--tracks", "@/tracks.csv", "--motion", "@/imu.csv", "--rig", "@/rig.toml", "--out")
INTO, TOPICS = say(*IMPORT, "made"), lambda words: check("--topics", words)
CHECKED = call(lambda at: check_runnable(load_sequence(str(at))))
NAN = f"nan{6 * ',nan'}\n"
OBJECTS = np.array([{}, []], dtype=object)
P = "250 0 160 0 0 250 100 0 0 0 1 0"
# Nine lists of ten, each of the one before it: 600 characters that stand for a billion values.
BOMB = "a0: &a0 [1]\n" + "".join(f"a{i}: &a{i} [{', '.join(10 * [f'*a{i - 1}'])}]\n" for i in range(1, 10))
DAY = Path(DRIVE).name
RAW = both(topic("image_rect", "image_raw"), without("info", "tf_static"))
TILTED = [T_REGULAR_OPTICAL @ T for T in PLACES]


def kept(**tables: Any) -> Step:
    return call(lambda at: toolkit.save(at.with_name("kept"), **(OWN | tables)))


def compared(estimators: list[str] | None, settings: Any) -> Step:
    return call(lambda at: toolkit.compare(str(at), estimators, settings=settings))


def yaml_of(place: Any, of_right: Any) -> Step:
    return both(text(YAMLS[0], camera_yaml(CAMERA, place)), text(YAMLS[1], camera_yaml(CAMERA, of_right)))


# By kind: what spoils it, what is told, and what somebody does who follows it: puts in what is asked for, where nothing
# else is named.
ADVICE: dict[str, list[tuple[Step, str] | tuple[Step, str, Step]]] = {
    "npz": [
        (gone("K", "angular_velocity"), "missing angular_velocity or rotational_velocity, K; it has"),
        (put(features=np.zeros((4, 3, 6))), "features has shape (4, 3, 6), expected (4, any, 5)"),
        (put(time_stamps=np.zeros((2, 5))), "time_stamps has shape (2, 5)"),
        (put(time_stamps=np.zeros((1, 0))), "0 frame(s)"),
        (put(b=np.array(0.0)), "b is 0, expected a positive number"),
        (put(b=np.array([0.5, 0.5])), "b has 2 values, expected one finite number"),
        (put(K=np.full((3, 3), np.nan)), "K is not finite"),
        (put(features=many(400.0, 200.0, 380.0, 212.0, struck=0.375)), "in 38% of 40 sightings vL - vR is"),
        (put(features=many(200.0, 400.0, 200.0, 380.0, struck=0.375)), "u and v look exchanged"),
        (cut(0.1), "damaged or truncated npz"),
        (write(save_short), "features ends after 57 of 60 values"),
        (both(put(Feature=1.0), gone("features")), "missing features (rename Feature?)"),
        (both(put(Feature=1.0), gone("features")), "without image features leave Feature out", gone("Feature")),
        (put(features=OBJECTS), "never unpickled; save it as plain numbers"),
        (put(time_stamps=np.array([[0, 1, np.nan, 3, 4]])), "(1 such stamps); remove these samples"),
        (put(time_stamps=np.array([[0, 1, 1e300, 3, 4]])), "beyond the year 2262 (1 such stamps)"),
        (put(time_stamps=FEW_S + 1e300), "(5 such stamps); correct them"),
        (put(time_stamps=1.3e18 + 1e9 * FEW_S), "divide by 1e9", put(time_stamps=(1.3e18 + 1e9 * FEW_S) / 1e9)),
        (put(time_stamps=1.3e15 + 1e6 * FEW_S), "divide by 1e6", put(time_stamps=(1.3e15 + 1e6 * FEW_S) / 1e6)),
        (put(time_stamps=1.3e12 + 1e3 * FEW_S), "divide by 1e3", put(time_stamps=(1.3e12 + 1e3 * FEW_S) / 1e3)),
        (put(time_stamps=(1.3e9 + FEW_S).astype(np.float32)), "write it in double"),
        (put(K=K().T), "expected 0, 0, 1; transpose it"),
        (put(K=K(m22=0.0)), "write fx, 0, cx; 0, fy, cy; 0, 0, 1"),
        (put(K=K(m01=50.0)), "a rectified pair has none; rectify the images"),
        (put(K=K(m00=-500.0)), "expected a positive number; correct K"),
        (put(features=many(400.0, 200.0, 380.0, 197.0)), "rectify the images, or correct the rows"),
        (
            put(features=many(200.0, 400.0, 200.0, 380.0)),
            "u and v look exchanged: exchange them",
            put(features=many(200.0, 400.0, 200.0, 380.0)[[1, 0, 3, 2]]),
        ),
        (put(imu_T_cam=TILTED[1].T), "expected 0, 0, 0, 1; transpose it?"),
        (put(cam_T_imu=np.eye(4)), "delete the one that is wrong"),
        (write(save_twice), "save it with one array of that name"),
        (check("--tracks", "images"), "its format has tracks and no images; leave --tracks images out"),
        (check("--topics", "imu=/imu0"), "a bag has; leave --topics out, or compare it by itself"),
        (say("tracks", "@", "--out", "x"), "a folder as EuRoC's or KITTI's", say("tracks", "@/../none", "--out", "x")),
    ],
    "npy": [
        (gone("w_t", "timestamps"), "missing w_t, timestamps"),
        (write(lambda path, _: np.save(path, np.zeros(3))), "one array of shape (3,), expected a dict"),
        (put(extra=1j), "only plain numbers"),
        (put(v_t=np.array(["2026"], dtype="M8[Y]")), "an array holds datetime64"),
        (put(cam_imgs_L=[]), "cam_imgs_L has 0 images and drive.npy 5 timestamps"),
        (put(cam_imgs_R=None), "cam_imgs_R is missing or no list of images"),
        (check("--tracks", "simulated"), "leave --tracks simulated out"),
        (say("check-data", "@/../drive_imgs.npy"), "name the file beside it without _imgs"),
        (put(extR_T_imu=T_REGULAR_OPTICAL @ se3_exp(0.3 * np.ones(6))), "no pair; rectify the recording"),
        (put(extR_T_imu=T_REGULAR_OPTICAL), "and so without a baseline; correct one"),
        (put(cam_imgs_L=[np.zeros((4, 4))] * FRAMES), "save the images as grey ones"),
        (
            write(lambda path, _: np.save(path, np.array([1, "x"], dtype=object), allow_pickle=True)),
            "save the recording as one with numpy.save",
        ),
    ],
    "mat": [
        (gone("theta_vk_i", "b"), "missing theta_vk_i, b; it has C_c_v"),
        (put(v_vk_vk_i=np.ones((3, 3))), "v_vk_vk_i has 3 columns for 4 stamps"),
        (put(C_c_v=np.ones((3, 3))), "C_c_v is not a rotation"),
        (cut(0.95), "not a whole Matlab file"),
        (
            write(lambda path, _: path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(64))),
            "save it with -v7",
        ),
        (put(r_i_vk_i=np.full((3, 6), np.nan)), "cut the recording to its truth"),
    ],
    "export": [
        (gone("calib.json", "imu.csv"), "missing calib.json, imu.csv"),
        (document("calib.json", lambda c: c.pop("imu")), "missing imu.accel_noise_density, imu.gyro"),
        (text("calib.json", '{"cam0": '), "correct this line, or copy the file again"),
        (text("calib.json", '["cam0"]'), "holds no 'key: value'"),
        (edit("features.csv", "uL,vL", "u,v"), "missing column uL (rename u?), vL"),
        (edit("imu.csv", "0.1,0.2,0.3,1,2,9.8\n", "0.1\n"), "imu.csv: line 2 has 2 columns, expected 7"),
        (text("imu.csv", gzip.compress(bytes(99))[:20]), "damaged or truncated gzip"),
        (lines("imu.csv", lambda table: table[:1]), "imu.csv: holds no rows"),
        (edit("truth_cam.csv", ",1,1,0", ",1,0,0"), "line 3 has a quaternion"),
        (edit("calib.json", '"k1": 0', '"k1": 0.1'), "export rectified features"),
        (
            edit("features.csv", ",7,", ",nan,"),
            "line 2 has no frame or feature_id; remove the row",
            lines("features.csv", lambda table: table[:1] + table[2:]),
        ),
        (
            both(text("est.txt", b"\xff\xfe"), call(lambda at: load_references(str(at)))),
            "or remove it to compare without it",
            gone("est.txt"),
        ),
    ],
    "own": [
        (gone("imu.csv"), "missing imu.csv or twist.csv"),
        (cell(4, 1, "1.5"), "line 5: track_id is 1.5, expected a whole number"),
        (cell(6, 2, ""), "line 7: uL is empty, expected a number"),
        (cell(6, 2, "1_0"), "line 7: uL is 1_0, expected a number"),
        (cell(3, 0, "1" * 30), f"line 4: t_ns is {'1' * 30}, expected a whole number"),
        (
            lines("tracks.csv", lambda table: [line.replace(",", ";").replace(".", ",") for line in table]),
            "expected a number with a decimal point",
        ),
        (lines("tracks.csv", lambda table: table[1:]), "holds numbers and no names; its first line names the columns"),
        (lines("tracks.csv", lambda table: ["# a drive\n\n", table[0], "x,x,x,x,x,x\n"]), "line 4: t_ns is x"),
        (edit("rig.toml", "fx_px = ", "fx_px = -"), "expected a positive number"),
        (edit("rig.toml", "fx_px = ", "f_px = "), "there is no f_px; did you mean fx_px"),
        (edit("rig.toml", "fx_px = ", f"fx_px = 1{400 * '0'} #"), "fx_px is inf, expected a finite number"),
        (edit("rig.toml", "T_imu_cam = [[", "T_imu_cam = [[{}], ["), "T_imu_cam holds text, expected real numbers"),
        (edit("rig.toml", "cy_px = ", "cy_px = '"), "is not TOML"),
        (edit("rig.toml", "gyro_random_walk", "#"), "missing noise.gyro_random_walk; an IMU's data sheet has them"),
        (kept(tracks=OWN["tracks"] | {"uL": [1.0]}), "tracks: its columns differ in length: t_ns", kept()),
        (kept(motion={"t_ns": [1], "vx": [0.0], "gx": [0.0]}), "motion: missing column ax, ay, az, gx, gy", kept()),
        (edit("rig.toml", "fx_px", "#"), "missing fx_px; it has T_imu_cam"),
        (kept(truth={"t": [1.0]}), "truth: missing column x, y", kept()),
        (edit("tracks.csv", "track_id", "trackid"), "(rename trackid?)"),
        (edit("tracks.csv", "t_ns,", "t,"), "nanoseconds: divide by 1e9", lines("tracks.csv", of_rows(in_seconds))),
        (lines("tracks.csv", lambda table: [*table, table[3]]), "is there twice in its frame; remove one"),
        (edit("rig.toml", "baseline_m", "baseline"), "remove or rename it"),
        (
            lines("rig.toml", lambda rows: [*(row for row in rows if "_d" not in row and "_w" not in row), "x = 1\n"]),
            "there is no noise.x; remove or rename it",
        ),
        (lines("rig.toml", lambda rows: ["noise = 1\n", *rows[: rows.index("[noise]\n")]]), "above its densities"),
        (
            lines("tracks.csv", lambda table: [f"t,{table[0]}", *(f"1.5,{row}" for row in table[1:])]),
            "has the columns t and t_ns; leave one out",
        ),
        (text("tracks.csv", b"\xff\xfe\x00\x80"), "write a CSV, one row a line, with names in the first"),
        (
            lines("imu.csv", lambda table: [line.replace(",", " ") for line in table]),
            "separate them by commas, semicolons or tabs",
            lines("imu.csv", lambda table: [line.replace(" ", ";") for line in table]),
        ),
        (edit("tracks.csv", "uL", "uR"), "rename or remove one"),
        (
            both(
                edit("tracks.csv", "t_ns", "t"), lines("tracks.csv", lambda rows: [*of_rows(in_seconds)(rows), NAN[4:]])
            ),
            "has no finite time (nan); remove the line",
        ),
        (lines("tracks.csv", restamped(lambda t: t // 10**9)), "multiply by 1e9"),
        (lines("imu.csv", restamped(lambda t: t // 10**6)), "multiply by 1e6"),
        (lines("imu.csv", apart(10**12)), "have no time in common; correct the stamps of one"),
        (
            both(lines("imu.csv", lambda table: [table[0], table[2], table[1], *table[3:]]), CHECKED),
            "correct the stamps; 'vislam check-data' says what is wrong",
        ),
        (
            both(lines("imu.csv", lambda table: table[:-10]), CHECKED),
            "cut the frames to the motion's time",
            lines("tracks.csv", lambda table: table[: len(table) // 2]),
        ),
        (
            both(lines("imu.csv", lambda rows: [*rows[:5], f"{rows[5].split(',')[0]}{NAN[3:]}", *rows[6:]]), CHECKED),
            "drop it from the recording",
            lines("imu.csv", lambda table: table[:5] + table[6:]),
        ),
        (say(*IMPORT, "made", "--truth", "@/absent.tum"), "check the path", INTO),
        (say(*IMPORT, "made", "--truth", "@"), "it is a directory; name a file", INTO),
        (say(*IMPORT, "made", "--truth", "/dev/null"), "it is a device; name a regular file", INTO),
        (
            both(lambda case: os.mkfifo(case.at / "pipe"), say(*IMPORT, "made", "--truth", "@/pipe")),
            "it is a pipe; write it to a regular file first",
            INTO,
        ),
        (say(*IMPORT, "@/tracks.csv"), "is not a directory; choose another place for the results", INTO),
        (say(*IMPORT, "@/tracks.csv/in"), "choose another directory with --out", INTO),
        (say(*IMPORT, "@"), "which no earlier run wrote and which would be lost; choose another directory", INTO),
        (say(*IMPORT, "."), "and cannot be replaced; name one inside it", INTO),
        (say(*IMPORT, "n" * 201), "too long for a recording; shorten it", INTO),
        (kept(tracks=3), "give a dict of arrays", kept()),
        (kept(tracks=OWN["tracks"] | {"uL": OWN["tracks"]["uL"].astype("M8[ns]")}), "uL is 1970-01-01T00:00", kept()),
        (kept(tracks=OWN["tracks"] | {"uL": OWN["tracks"]["uL"] * 1j}), "give their real parts", kept()),
        (
            call(lambda at: load_sequence(str(at)).truncated(-1)),
            "give the number of those to keep",
            call(lambda at: load_sequence(str(at)).truncated(3)),
        ),
        (
            compared(None, {"noise.motion_scale": 2.0}),
            "write {'noise': {'motion_scale': ...}}, or in TOML",
            compared(["absent"], {"noise": {"motion_scale": 2.0}}),
        ),
        (
            both(text("a.toml", "'window.lag_s' = 2.0\n"), say("compare", "@/none", "--config", "@/a.toml")),
            "or in TOML window.lag_s without quotes",
            text("a.toml", "window.lag_s = 2.0\n"),
        ),
        (compared(None, {"seeds": np.ones(2)}), "a number, a text, true or false", compared(["absent"], {"seeds": 1})),
        (
            say("compare", "@/none", "--set", "noise.motion_scale=wide"),
            "give a number or auto",
            say("compare", "@/none", "--set", "noise.motion_scale=auto"),
        ),
    ],
    "twist": [
        (say("card", "@", "--json", "@"), "is a directory; name a file in it", say("card", "@", "--json", "@/c.json")),
        (say("card", "@", "--json", "@/rig.toml"), "name another file", say("card", "@", "--json", "@/c.json")),
        (say("card", "@", "--json", "/dev/null"), "name a regular file", say("card", "@", "--json", "@/c.json")),
    ],
    "saved": [
        (gone("recording.npz"), "No such file"),
        (text("recording.json", '{"schema": "vislam'), "cannot be read as JSON"),
        (document("recording.json", lambda t: t["rig"].update(fx_px=10**400)), "does not fit"),
        (document("recording.json", lambda t: t["rig"].update(T_imu_cam=np.eye(3).tolist())), "T_imu_cam"),
        (document("recording.json", lambda t: t["motion"].update(kind="gps")), "gps"),
        (document("recording.json", lambda t: t["motion"].update(pairing="middle")), "middle"),
        (
            document("recording.json", lambda t: t["provenance"].update(facts=[3])),
            "provenance.facts[0]: expected string",
        ),
        (text("recording.npz", b"PK"), "damaged"),
        (arrays(lambda a: a.pop("frames_t_ns")), "frames_t_ns is missing"),
        (arrays(lambda a: a.update(motion_values=a["motion_values"][:, :5])), "motion_values has shape"),
        (arrays(lambda a: a.update(motion_values=a["motion_values"] * 1j)), "holds complex128"),
        (arrays(lambda a: a.update(observations_track_id=a["observations_track_id"][1:])), "differ in length"),
        (arrays(lambda a: a.update(frames_t_ns=a["frames_t_ns"][:-1])), "copy both files again"),
        (arrays(lambda a: a["observations_frame"].put(-1, 99)), "is of frame 99"),
        (arrays(lambda a: a.update(observations_frame=a["observations_frame"][::-1])), "not sorted"),
        (arrays(lambda a: a.update(prior_cov=-a["prior_cov"])), "not positive definite"),
        (edit("recording.json", "recording/1", "recording/9"), "copy or save the recording again"),
        (edit("recording.json", '"fx_px": ', '"fx_px": -'), "expected a positive number; correct the recording"),
    ],
    "odometry": [
        (edit("calib.txt", "P1", "P7"), "missing P1, twelve numbers each; it has P0, P7, Tr"),
        (text("calib.txt", f"7,2 0 3\n{P}\n{P}\n"), "P0 holds text, expected real numbers"),
        (edit("calib.txt", "P1", "P0: 1 2 3\nP1"), "P0 is there twice with other numbers; remove the wrong row"),
        (
            text("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n"),
            "1 poses for 5 images; cut both alike, or take the poses of this sequence",
        ),
        (text("times.txt", "0\n0.1\nx\n"), "times.txt: line 3 is not numeric"),
        (text("times.txt", ""), "times.txt has one number a line, in seconds"),
        (both(text("x", b""), say("check-data", "@/x")), "the file is empty"),
        (both(text("x", b"hello"), say("check-data", "@/x")), "of no known format; there are"),
        (both(text("x", b"PK\x03\x04"), say("check-data", "@/x")), "of no known format"),
        (both(text("x", b"\x28\xb5\x2f\xfd" + bytes(9)), say("check-data", "@/x")), "is packed, unpack it with unzstd"),
        (edit("calib.txt", "-100.0", "0"), "so there is no baseline; give each its own"),
        (edit("calib.txt", "-100.0", "100.0"), "is not to the right of the left; exchange them"),
        (
            pixels("image_?/*.png", lambda image: image[::2, ::2]),
            "where these were scaled or cut, do the same to P0 to P3",
            text("calib.txt", "P0: 125 0 80 0 0 125 50 0 0 0 1 0\nP1: 125 0 80 -50 0 125 50 0 0 0 1 0\n"),
        ),
        (gone("calib.txt"), "put the calib.txt of this sequence there, with the rows P0: to P3:"),
        (moved("image_?/*.png", lambda path: f"{path.stem}_left.png"), "the images of an instant alike, as 000000.png"),
        (moved("image_?/*.png", lambda path: f"{50 + int(path.stem):06d}.png"), "number 0 on; cut both or neither"),
        (
            text("poses.txt", "".join(f"{0.1 * k} {k} 0 0 0 0 0 1\n" for k in range(FRAMES))),
            "move it away, and give poses of the body (forward, left, up) in TUM format with --truth",
            both(moved("poses.txt", lambda _: "t.tum"), check("--truth", "@/t.tum")),
        ),
        (text("times.txt", "0.5\n" * FRAMES), "write the time of each"),
        (gone("image_1"), "and stereo needs both cameras; add those of image_1"),
        (lambda case: [path.unlink() for path in case.at.glob("*/*.png")], "with images; unpack them there (.png"),
        (swap("image_0", "image_1"), "exchange the two, or turn the images back"),
        (pixels("image_?/*.png", lambda image: image[:, ::-1]), "the images back if all are upside down or mirrored"),
        (
            rolled,
            "the pair before theirs: one camera began earlier or dropped an image; pair them by when they were taken",
            later(1),
        ),
        (pixels("image_1/*.png", lambda image: image[::2, ::2]), "cut or turned, do the same to the calibration"),
        (pixels("image_?/*.png", lambda image: image.astype(np.float32), ".tif"), "convert the images to 8 or 16 bits"),
        (check("--tracks", "simulated"), "leave --tracks simulated out"),
        (say("check-data", "@/image_0"), "is a part of a recording: name the whole recording"),
        (say("check-data", "@/poses.txt"), "name a recording and --trajectory NAME=FILE, or vislam evaluate"),
        (
            both(text("all.tar", bytes(257) + b"ustar" + bytes(9)), say("check-data", "@/all.tar")),
            "and name what was in it",
        ),
        (
            both(lambda case: shutil.make_archive(str(case.at / "all"), "gztar", case.at), gone("image_0", "image_1")),
            "and remove what was packed",
        ),
        (say("check-data", "@/.."), "is not a recording, but contains some: name drive.odometry in it"),
        (say("check-data", "https://example.org/a.npz"), "it is an address: download it and name the file"),
        (say("check-data", ""), "a SEQUENCE has no name: give a path, or one of "),
        (say("check-data", "@\0"), "is no path (embedded null byte); name a file"),
        (say("tracks", "@", "--out", "@/calib.txt/x"), "choose another directory with --out"),
    ],
    "day": [
        (gone(f"{DAY}/image_00/timestamps.txt"), "timestamps.txt: cannot be read"),
        (text(f"{DAY}/image_00/timestamps.txt", "\n\n"), "holds no stamps"),
        (text(f"{DAY}/oxts/data/0000000003.txt", "1 2 3"), "0000000003.txt: 3 numbers"),
        (
            lines(f"{DAY}/oxts/timestamps.txt", lambda all_: [row.replace("09-26", "09-30") for row in all_]),
            "in the time of the oxts packets",
        ),
        (gone("calib_cam_to_cam.txt"), "into the folder of the day or of the drive"),
        (pixels("*/image_*/data/*.png", lambda image: image[::2, ::2]), "day, or images that were not scaled or cut"),
        (text(f"{DAY}/oxts/data/0000000003.txt", packet(0.3, yaw=30.0)), "and no radians; convert degrees"),
        (edit(f"{DAY}/image_00/timestamps.txt", "2011-09-26 13", "yesterday 13"), "write it as 2011-09-26 13:02:25.96"),
    ],
    "asl": [
        (gone(TABLES[0], *IMAGES), "cam0/data.csv: cannot be read"),
        (gone("mav0/cam1"), "there is cam0 and no cam1; stereo needs both"),
        (edit("mav0/imu0/data.csv", "w_RS_S_y", "rate_y"), "imu0/data.csv: missing column w_RS_S_y"),
        (edit(YAMLS[0], "100.0]", "100.0"), "line 11: expected "),
        (text(YAMLS[0], BOMB), "values, with those that aliases (*name) repeat"),
        (edit(YAMLS[0], "rate_hz", "sensor_type"), "gives sensor_type a second time"),
        (edit(YAMLS[0], "data: [1", "data: [2"), "T_BS is not a rotation"),
        (bag_inside, "no measurements but those of a bag: name bag in it", say("check-data", "@/bag")),
        (gone("mav0/imu0/data.csv"), "lay them out as KITTI's image_0, image_1 and calib.txt", as_kitti),
        (edit(YAMLS[0], "distortion_model: none\n", ""), "lacks distortion_model or intrinsics of a camera; add them"),
        (
            both(gone("truth.tum", *TABLES), moved("mav0/cam?/data/*.png", lambda path: f"x{path.name}")),
            "write cam0/data.csv and cam1/data.csv",
        ),
        (
            both(gone("truth.tum"), moved("mav0/cam?/data/*.png", lambda path: f"{int(path.stem) + 7}.png")),
            "take these images' own data.csv, or none, where their names are stamps",
            gone(*TABLES),
        ),
        (gone("truth.tum", *IMAGES), "where there are no images; add one of them"),
        (gone("mav0/imu0/sensor.yaml"), "mav0: missing imu0/sensor.yaml"),
        (edit(YAMLS[0], "model: pinhole", "model: omni"), "camera_model omni"),
        (edit(YAMLS[0], "distortion_model: none", "distortion_model: fov"), "distortion_model fov is unknown"),
        (edit(YAMLS[0], "[250.0, 250.0", "[0.0, 250.0"), "intrinsics 0 250"),
        (edit(YAMLS[0], "data: [1", "data: [-1"), "a reflection"),
        (edit(TABLES[0], ",14", ",../14"), "the name of an image"),
        (lines("mav0/imu0/data.csv", restamped(lambda t: t - 10**17)), "two clocks"),
        (lines("mav0/imu0/data.csv", restamped(lambda _: START_NS)), "IMU are all of one instant"),
        (both(gone("mav0/cam1"), check("--tracks", "images")), "cam0/data has images and mav0/cam1/data has none"),
        (files(IMAGES[0], lambda path: path.read_bytes()[:99]), "image pairs cannot be"),
        (both(*(files(folder, lambda _: LFS) for folder in IMAGES)), "images with git lfs pull"),
        (files(IMAGES[1], lambda path: (path.parents[2] / "cam0/data" / path.name).read_bytes()), "are the same ones"),
        (pixels("mav0/cam?/data/*", lambda image: image * 0), "those of the pair before"),
        (pixels("mav0/cam1/data/*", lambda image: image[::2, ::2]), "160x100 px, expected 320x200"),
        (pixels("mav0/cam1/data/*", lambda image: np.roll(image, 25, axis=0)), "the calibration is not that of these"),
        (
            both(lines("truth.tum", of_kilometres), check("--tracks", "simulated")),
            "tracks are simulated in a room; check its unit, or take the tracks of images",
            check("--tracks", "images"),
        ),
        (
            lines("truth.tum", lambda all_: [f"{float(line[:20]) - 500.0:.9f}{line[20:]}" for line in all_]),
            "check that both are of one recording and clock",
        ),
        (
            both(lines("truth.tum", lambda all_: all_[::3]), check("--tracks", "simulated")),
            "the truth has a pose every 0.15 s, and where there are no images the tracks are simulated along it; "
            "give a truth of 10 Hz or more",
        ),
        (both(*(lines(name, restamped(lambda t: t // 1000)) for name in TABLES)), "microseconds: multiply by 1e3"),
        (lines(TABLES[0], of_rows(in_seconds)), "write seconds times 1e9"),
        (lines(TABLES[1], restamped(lambda t: t + 20_000_000)), "clocks differ, correct the stamps of cam1"),
        (
            both(gone(YAMLS[1]), text("orb.yaml", "Camera1.fx: 50.0")),
            "orb.yaml of ORB-SLAM3 is not read; write the calibration as docs/images.md describes",
            chain(),
        ),
        (chain(second="cam2"), "calibrate cam0 and cam1 together", chain()),
        (chain(first="T_imu_body"), "take the camchain that Kalibr writes when it calibrates cameras and IMU", chain()),
        (yaml_of(PLACES[0], PLACES[0]), "so there is no baseline; correct the extrinsics, or name two cameras"),
        (yaml_of(PLACES[0], se3(np.eye(3), np.array([0.0, 0.4, 0.0]))), "above, below or behind of the left one"),
        (yaml_of(*map(np.linalg.inv, TILTED)), "looks like the inverse of one: invert both", yaml_of(*TILTED)),
        (swap(*YAMLS), "stands left of the left one, at -0.4 0 0 m; exchange them, or correct the extrinsics"),
        (edit(YAMLS[1], "[320, 200]", "[640, 400]"), "a pair needs one size; record both alike"),
        (
            yaml_of(PLACES[0], PLACES[1] @ se3_exp(np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]))),
            "correct the extrinsics, or name two cameras",
        ),
        (text("camchain.yaml", "a: [" * 2000), "is nested too deeply for a calibration; name another file"),
        (text("camchain.yaml", "a: 1\n" * 1_000_000), "characters are no calibration; name another file"),
    ],
    "bag": [
        (TOPICS("left=/cam0/image"), "no topic is called /cam0/image (did you mean /cam0/image_raw"),
        (TOPICS("imu=/cam0/image_raw"), "cannot be imu, which is sensor_msgs/Imu"),
        (TOPICS("left=/cam0/image_raw,right=/cam0/image_raw"), "a pair has a topic each"),
        (without("cam1"), "holds images of one camera, /cam0/image_raw"),
        (both(without("imu0"), more(*imu("/a", gyro=0.0))), "/a measures no angular velocity"),
        (
            both(topic("cam0", "port"), topic("cam1", "starboard")),
            "name them with --topics left=TOPIC,right=TOPIC",
            TOPICS("left=/port/image_raw,right=/starboard/image_raw"),
        ),
        (
            say("compare", "@", "--set", "frontend.topics=ears=/imu0"),
            "write left=/cam0/image_raw,right=...,imu=...",
            TOPICS("left=/cam0/image_raw,right=/cam1/image_raw,imu=/imu0"),
        ),
        (
            say("compare", "@", "--set", "frontend.topics=imu=/imu0,imu=/imu0"),
            "names imu twice; leave one out",
            TOPICS("imu=/imu0"),
        ),
        (
            both(without("imu0"), more(*imu("/imu", 10**12), *imu("/imu0"))),
            "two recordings; stamp both by one, or name another topic with --topics imu=TOPIC",
            TOPICS("imu=/imu0"),
        ),
        (without("imu0"), "convert the topic that measures the motion to sensor_msgs/Imu (m/s^2, rad/s; "),
        (
            both(without("imu0"), more(ROS.item(START_NS, "/sensor_combined", "sensor_msgs/msg/FluidPressure", "px4"))),
            "record one with the images; there are /sensor_combined (sensor_msgs/FluidPressure), /cam0",
        ),
        (
            both(without("imu0"), more(*wheels("/wheels", 0.5, "geometry_msgs/msg/TwistStamped"))),
            "name one with --topics twist=TOPIC (/wheels)",
            TOPICS("twist=/wheels"),
        ),
        (
            both(without("imu0"), more(*wheels("/odom", 0.0))),
            "name another topic with --topics imu=TOPIC, or an odometry with --topics twist=TOPIC",
            both(more(*wheels("/wheels", 0.5)), TOPICS("twist=/wheels")),
        ),
        (
            both(without("imu0"), more(*imu("/a", accel=0.0), *imu("/b", 2_000_000, gyro=0.0))),
            "name the accelerometer's topic with --topics accel=TOPIC",
            TOPICS("imu=/a,accel=/b"),
        ),
        (
            compressed(lambda one: (one.t_ns + 20_000_000 * ("cam1" in one.topic), b"\x89PNG\r\n\x1a\n")),
            "synchronise the cameras, or correct the stamps",
        ),
        (compressed(lambda one: (one.t_ns, b"RIFF....WEBP")), "republish them as one of these, or as raw images"),
        (
            without("cam"),
            "no images that can be read; write them as sensor_msgs/Image, as image_transport republish does",
        ),
        (
            lambda case: [write_bag(case.at.with_stem("other"), case.content), say("check-data", "@/..")(case)],
            "name one of them, or if they are parts of one recording, let their names end in _0, _1",
        ),
    ],
    "bare": [
        (items(of_one_frame), "no /tf_static connects the frames '0' and '0'"),
        (more(*elsewhere()), "or name another Imu with --topics imu=TOPIC (/imu0)", TOPICS("imu=/imu0")),
        (without("camera_info"), "an ASL folder's cam0/sensor.yaml beside the bag", beside),
        (
            topic("camera_info", "lens"),
            "name it with --topics left_info=TOPIC,right_info=TOPIC",
            TOPICS("left_info=/cam0/lens,right_info=/cam1/lens"),
        ),
        (without("tf_static"), "put Kalibr's camchain.yaml or an ASL folder's cam0/sensor.yaml beside the bag", beside),
        (both(without("camera_info", "tf_static"), more(*calibration(PLACES, "P"))), "the bag and name the raw images"),
        (both(RAW, more(*calibration(PLACES, "K"))), "put Kalibr's camchain.yaml", beside),
        (both(RAW, more(*calibration([PLACES[1], PLACES[0]], "P"))), "exchange them, or correct the extrinsics"),
    ],
}
ROWS = [(kind, row) for kind, rows in ADVICE.items() for row in rows]


# What restores the file as it was written, which is what the fixtures are.
_WRITTEN_ANEW = re.compile(r"^(copy|export|save|make) .*(again|whole (export|recording))")
# What is done outside of a recording, with a test of its own where there can be one; or is told of one that is read.
ELSEWHERE = {
    "add noise to the twists for a meaningful comparison": "a fact",
    "do not rely on figures against it": "a fact",
    "check that calib.txt is of them": "a fact",
    "change its permissions": "whoever may read everything, as in a container, is never told so",
    "check the program that wrote them": "another program",
    "convert it with ros2 bag convert or rosbag decompress, or install a newer rosbags": "another program",
    "cut off, or a bag that cannot be read ({})": "no advice",
    "name its folder, which has {}, or copy it again": "test_bags, damaged",
    "run ros2 bag reindex on the folder": "another program",
    "name the topic of the poses, as in {}:/odom": "evaluation/test_covariances",
    "name another folder with VISLAM_CACHE": "the environment",
    "pip install \"vislam-toolkit[bags]\"": "the environment",
    "install gtsam>=4.3 from PyPI": "the environment",
    "pair the images by when they were taken": "test_folders, of most of many pairs",
    "rename one": "of modules of other packages, test_registry",
    "wait for its end, or choose another place with --out": "experiment/test_outcome_store",
}  # fmt: skip


def test_every_advice_about_a_recording_is_followed_in_a_test() -> None:
    folders = ("datasets", "frontend", "settings", "files")
    modules = {path for folder in folders for path in (TOOLKIT / folder).rglob("*.py")}
    of_trajectories = set((TOOLKIT / "datasets/trajectories").glob("*.py"))  # evaluation/test_public_cases
    told = advice_in([*(modules - of_trajectories), TOOLKIT / "sequence.py", TOOLKIT / "arrays.py"])
    assert ELSEWHERE.keys() <= told
    lacking = {advice for advice in told - ELSEWHERE.keys() if not _WRITTEN_ANEW.match(advice)}
    assert not [advice for advice in lacking if not is_followed(advice, [row[1] for _, row in ROWS])]


def test_every_end_of_an_error_is_known_to_be_an_advice_or_a_reason() -> None:
    """Whoever begins an advice with another word adds it to those of tests/advice.py, or it is never followed."""
    assert unknown_beginnings(TOOLKIT.rglob("*.py")) == set()


def no_audit(sequence: Sequence, keep: frozenset[str] = frozenset()) -> Audit:
    return Audit(sequence, ())


@pytest.mark.parametrize(("kind", "row"), ROWS, ids=[f"{kind}: {row[1][-60:]}" for kind, row in ROWS])
def test_whoever_follows_an_advice_is_not_refused_for_the_same_again(
    given: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], row: Any
) -> None:
    monkeypatch.setattr(recording, "audit", no_audit)
    monkeypatch.chdir(tmp_path)
    spoil, advice, *follow = row
    spoil(given)
    told = given.outcome(capsys)
    assert advice in told
    assert given.typed or given.at.stem in told
    for step in follow or [sound]:
        step(given)
    after = given.outcome(capsys)
    assert advice not in after
