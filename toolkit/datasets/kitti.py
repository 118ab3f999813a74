"""KITTI: stereo images, rectified or raw, of an odometry sequence, or of a raw drive with its packets (oxts).

An odometry sequence has ``image_0`` and ``image_1`` (or ``image_2`` and ``image_3``, or ``image_l`` and ``image_r``),
calib.txt, and times.txt and poses where they are there, these in the folder or, as the download has it, in
``../../poses/<name>.txt``. No motion is measured, and a smooth one is assumed (:mod:`toolkit.models.twist`), which
every report says. The body, called IMU everywhere, is camera 0, whose poses these are, with the axes forward, left, up.
Source: Geiger, Lenz & Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark suite" (CVPR 2012).

A raw drive has ``image_00/data`` and ``image_01/data`` (or ``image_02`` and ``image_03``), the calib_*.txt of its day
in it or beside it, and ``oxts/data``. Packets at 50 Hz or more are read as an IMU, slower ones as body twists. Whether
images are rectified shows in their size. Truth and motion are of one instrument. Axes of the IMU: forward, left, up.
Source: Geiger, Lenz, Stiller & Urtasun, "Vision meets robotics: the KITTI dataset" (IJRR 2013), and the readme of its
development kit for the 30 values of a packet; positions are projected as that kit does, by Mercator's projection scaled
at the first latitude.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from toolkit.datasets.io.fields import Fields, rigid, stamps_ns
from toolkit.datasets.io.image_pairs import (
    UNPACK_IMAGES,
    Listed,
    check_both_cameras,
    check_one_clock,
    check_several_stamps,
    image_folder,
    image_size,
    images_in,
    images_only,
    numbered,
    pairs_by_name,
    pairs_by_stamps,
    pinhole_of,
    seen_in,
)
from toolkit.datasets.io.tables import is_number
from toolkit.datasets.trajectories import read_poses
from toolkit.datasets.trajectories.formats import read_rows
from toolkit.errors import DataError, printable
from toolkit.files.reading import is_regular, read_text_input
from toolkit.frontend import Camera, ImageRecording, RectifiedPair, already_rectified, rectified
from toolkit.geometry import Array, IntArray, se3, se3_inverse, so3_exp
from toolkit.measurements import NS_PER_S, ImuNoise, MotionNoise
from toolkit.models.noise import twist_noise, unmeasured_motion
from toolkit.motion_samples import ImuSamples, MotionSamples, NoSamples, TwistSamples
from toolkit.progress import SILENT, Progress
from toolkit.sequence import Provenance, Sequence, Truth
from toolkit.settings import DEFAULTS, Frontend

CITES = ("geiger2012kitti", "geiger2013kitti")
# The folders of both cameras, grey or colour, of an odometry sequence and of a raw drive.
_FOLDERS = (
    *(("image_0", "image_1"), ("image_2", "image_3"), ("image_l", "image_r")),
    *(("image_00", "image_01"), ("image_02", "image_03")),
)


class _Layout(NamedTuple):
    """The folder of a recording, and those of the images of its left and right camera."""

    root: Path
    left: Path
    right: Path
    is_raw: bool

    @classmethod
    def of(cls, root: Path, left: str, right: str) -> _Layout:
        if len(left) == len("image_0"):
            return cls(root, root / left, root / right, is_raw=False)
        return cls(root, image_folder(root / left), image_folder(root / right), is_raw=True)


class _Mounted(NamedTuple):
    """A pair for the front end, where its left camera is mounted, before it is rectified, and what to know of it."""

    pair: RectifiedPair
    T_imu_left: Array
    facts: tuple[str, ...]


# The motion samples, their noise, the truth, and what to know of them.
_Moved = tuple[MotionSamples, MotionNoise, Truth | None, tuple[str, ...]]
uses_images = images_only


def recognises(path: Path) -> bool:
    """Say whether the path has the folders of a pair, as KITTI names them, or one with images."""
    return _layout(path) is not None or any(all((path / side).is_dir() for side in folders) for folders in _FOLDERS)


def load(path: Path) -> Sequence:
    """Read a recording with the front end's default settings; see :func:`load_from_images`."""
    return load_from_images(path, DEFAULTS.frontend, SILENT)


def images_of(path: Path, frontend: Frontend) -> ImageRecording:
    """Return the image pairs and their cameras; raises DataError as :func:`load_from_images`."""
    layout = _whole(path)
    return ImageRecording(_listed(layout).pairs, _mounted(layout).pair)


def load_from_images(path: Path, frontend: Frontend, progress: Progress) -> Sequence:
    """Read calibration, stamps, and poses or packets, and make the tracks of the images.

    Raises DataError where a part is missing or damaged, or the images cannot be used.
    """
    layout = _whole(path)
    mounted, listed = _mounted(layout), _listed(layout)
    seen = seen_in(layout.root, ImageRecording(listed.pairs, mounted.pair), mounted.T_imu_left, frontend, progress)
    motion_of = _packets_motion if layout.is_raw else _assumed_motion
    samples, noise, truth, how = motion_of(layout, seen.frames_t_ns)
    facts = (*how, *seen.facts, *listed.remarks, *mounted.facts)
    return Sequence(
        name=layout.root.name,
        rig=seen.rig,
        noise=noise,
        frames_t_ns=seen.frames_t_ns,
        observations=seen.observations,
        motion=samples,
        provenance=Provenance("kitti", f"{path}: stereo tracks from the images", facts),
        truth=truth,
    )


def _layout(path: Path) -> _Layout | None:
    """Return the first pair of cameras that both have images, else the first of which one has."""
    layouts = [_Layout.of(path.resolve(), *folders) for folders in _FOLDERS]
    there = [(one, [bool(images_in(side)) for side in (one.left, one.right)]) for one in layouts]
    return next((one for how in (all, any) for one, both in there if how(both)), None)


def _whole(path: Path) -> _Layout:
    layout = _layout(path)
    if layout is None:
        folders = ", ".join(" and ".join(pair) for pair in _FOLDERS)
        raise DataError(f"{path}: no pair of folders, {folders}, with images; {UNPACK_IMAGES}")
    check_both_cameras(layout.root, layout.left, layout.right)
    return layout


def _mounted(layout: _Layout) -> _Mounted:
    size_px = image_size(layout.left, layout.right)
    return _of_the_day(layout, size_px) if layout.is_raw else _of_calib(layout, size_px)


def _listed(layout: _Layout) -> Listed:
    return _listed_by_stamps(layout) if layout.is_raw else _listed_by_number(layout)


def _rectified_pair(file: Path, names: list[str], P: tuple[Array, Array], size_px: tuple[int, int]) -> RectifiedPair:
    """Return the pair of two projections (3, 4), by these names in a file; raises DataError where they are none."""
    (left, right), both = P, " and ".join(names)
    for name, projection in zip(names, P, strict=True):
        if not (np.isfinite(projection).all() and projection[0, 0] > 0.0 and projection[1, 1] > 0.0):
            raise DataError(f"{file}: {name} is no projection: its focal lengths must be positive")
    if not np.allclose(left[:, :3], right[:, :3], rtol=1e-6):
        raise DataError(f"{file}: {both} differ in more than the baseline; they are not rectified")
    baseline_m = float((left[0, 3] - right[0, 3]) / left[0, 0])
    if baseline_m == 0.0:
        raise DataError(f"{file}: {both} are the same, so there is no baseline; give each its own")
    if not baseline_m > 0.0:
        raise DataError(f"{file}: by {both} the right camera is not to the right of the left; exchange them")
    return already_rectified(pinhole_of(left), baseline_m, size_px)


def _calibration(file: Path, where: str) -> Fields:
    """Read rows of numbers with a name, else P0, P1, ...; a row that is none, such as a date, is a text."""
    if not file.exists():
        raise DataError(f"{file}: is missing; {where}")
    arrays: dict[str, np.ndarray] = {}
    lines = [line for line in read_text_input(file, "KITTI's calibration is text").splitlines() if line.strip()]
    # A row that is no numbers keeps its place, so that none after it is taken for another.
    for row, line in enumerate(lines):
        key, colon, rest = line.rpartition(":")
        words = rest.split()
        values = np.array(list(map(float, words)) if all(map(is_number, words)) else words)
        name = key.strip() if colon else f"P{row}"
        before = arrays.get(name, values)
        if before.dtype == values.dtype == np.float64 and not np.array_equal(before, values, equal_nan=True):
            raise DataError(f"{file}: {printable(name)} is there twice with other numbers; remove the wrong row")
        arrays[name] = values
    return Fields(file, arrays)


# Odometry sequences: calib.txt, times.txt, poses ---------------------------------------------------------------------

_PERIOD_S = 0.1
# No camera's axis meets its image this near the border: calib.txt is of larger images than these.
_BORDER = 0.1
# Few do so far from the middle both ways (shares of width and height); that of images half as large is 0.25 off.
_ASIDE = 0.15
# Axes right, down, forward of a camera, from forward, left, up.
T_FLU_CAM = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))


def _of_calib(layout: _Layout, size_px: tuple[int, int]) -> _Mounted:
    """Return the pair as calib.txt has it; the principal point must be one of images of this size.

    Images without motion samples have nothing else that would contradict a calibration of images half as large.
    """
    file, rows = layout.root / "calib.txt", (2, 3) if layout.left.name == "image_2" else (0, 1)
    names = [f"P{row}" for row in rows]
    fields = _calibration(file, "put the calib.txt of this sequence there, with the rows P0: to P3:")
    if lacking := [name for name in names if name not in fields]:
        there = ", ".join(fields.arrays) or "none"
        raise DataError(f"{file}: missing {', '.join(lacking)}, twelve numbers each; it has {there}")
    left, right = (fields.array(name, 12).reshape(3, 4) for name in names)
    pair = _rectified_pair(file, names, (left, right), size_px)
    centre, size = f"{pair.cx_px:g} {pair.cy_px:g}", f"{size_px[0]}x{size_px[1]} px"
    places = [c / length for c, length in zip((pair.cx_px, pair.cy_px), size_px, strict=True)]
    if not all(_BORDER < place < 1.0 - _BORDER for place in places):
        remedy = "where these were scaled or cut, do the same to P0 to P3"
        raise DataError(f"{file}: its principal point, {centre}, is not that of images of {size}; {remedy}")
    remark = (
        f"the principal point, {centre}, is far from the middle of images of {size}: check that calib.txt is of them"
    )
    T_cam0_left = se3(np.eye(3), np.array([-left[0, 3] / left[0, 0], 0.0, 0.0]))
    is_aside = all(abs(place - 0.5) > _ASIDE for place in places)
    return _Mounted(pair, T_FLU_CAM @ T_cam0_left, (remark,) if is_aside else ())


def _listed_by_number(layout: _Layout) -> Listed:
    stamps = _times(layout)[0]
    listed = pairs_by_name(layout.left, layout.right, dict(enumerate(stamps.tolist())))
    if not listed.pairs:
        numbers = sorted(numbered(layout.left))
        if not numbers:
            name = images_in(layout.left)[0].name
            raise DataError(f"{layout.left}: {name} has no number; name the images of an instant alike, as 000000.png")
        held = f"they are numbered {numbers[0]} to {numbers[-1]}, and times.txt has {stamps.size}, from number 0 on"
        raise DataError(f"{layout.root}: no image has a stamp: {held}; cut both or neither")
    check_several_stamps(layout.root / "times.txt", listed)
    return listed


def _times(layout: _Layout) -> tuple[IntArray, tuple[str, ...]]:
    """Return the stamp (N,) of each image number, and what must be known of them."""
    file = layout.root / "times.txt"
    if not is_regular(file):
        period_ns = round(_PERIOD_S * NS_PER_S)
        return period_ns * np.arange(_count(layout)), (f"no times.txt: an image every {_PERIOD_S:g} s is assumed",)
    rows = read_rows(file, "times.txt has one number a line, in seconds")
    return stamps_ns(file, "stamp", rows.numbers(1, "one number a line, in seconds")[:, 0]), ()


def _count(layout: _Layout) -> int:
    """Return how many images the sequence has, by the last number, for some may be missing."""
    return max(numbered(layout.left), default=-1) + 1


def _assumed_motion(layout: _Layout, t_ns: IntArray) -> _Moved:
    stamps, how = _times(layout)
    facts = ("no motion input: all estimators assume smooth motion", *how)
    return NoSamples(t_ns), unmeasured_motion(), _poses(layout, stamps, t_ns), facts


def _poses(layout: _Layout, stamps: IntArray, t_ns: IntArray) -> Truth | None:
    """Return the poses of the frames used, as those of the body; None where there are no poses."""
    beside = layout.root.parent.parent / "poses" / f"{layout.root.name}.txt"
    file = next((path for path in (layout.root / "poses.txt", beside) if is_regular(path)), None)
    if file is None:
        return None
    poses = read_poses(file)
    if poses.t_ns is not None:
        why = f"is a trajectory with stamps ({poses.format}), and KITTI's poses have twelve numbers a line and none"
        remedy = "move it away, and give poses of the body (forward, left, up) in TUM format with --truth"
        raise DataError(f"{file}: {why}; {remedy}")
    T_world_cam = poses.T_world_imu
    if len(T_world_cam) not in (stamps.size, _count(layout)):
        counts = f"{len(T_world_cam)} poses for {stamps.size} images"
        raise DataError(f"{file}: {counts}; cut both alike, or take the poses of this sequence")
    T_cam_flu = np.linalg.inv(T_FLU_CAM)
    posed = stamps[: len(T_world_cam)]
    used = np.flatnonzero(np.isin(posed, t_ns))
    used = used[np.unique(posed[used], return_index=True)[1]]
    return Truth(stamps[used], T_FLU_CAM @ T_world_cam[used] @ T_cam_flu)


# Raw drives: the day's calibration, stamps, packets ------------------------------------------------------------------

# Between slower packets a car's specific force is not what its samples say.
_IMU_FROM_HZ = 50.0
# The same unit's, as GTSAM's example of drive 2011_10_03_drive_0027 states it.
_IMU_NOISE = ImuNoise(
    accel_noise_density=0.01, gyro_noise_density=1.75e-4, accel_random_walk=1.67e-4, gyro_random_walk=2.91e-6
)
_CAMERAS, _VELO, _IMU = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt"
_LARGEST_ANGLE_RAD = 2.0 * np.pi
_VALUES = 30
# Where in a packet stand: latitude, longitude (deg), altitude (m); roll, pitch, yaw (rad); east, north, up (m/s).
_PLACE, _ANGLES, _EAST_NORTH_UP = slice(0, 3), slice(3, 6), [7, 6, 10]
# Of the body: specific force (m/s^2) and rates (rad/s).
_ACCEL, _RATES = slice(11, 14), slice(17, 20)
_EARTH_RADIUS_M = 6378137.0
_STAMP = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?")


def _listed_by_stamps(layout: _Layout) -> Listed:
    left, right = (camera / "timestamps.txt" for camera in _cameras(layout))
    stamps = _read_stamps(left)
    right_stamps = _read_stamps(right) if is_regular(right) else stamps
    listed = pairs_by_stamps(layout.left, layout.right, stamps, right_stamps)
    check_several_stamps(left, listed)
    return listed


def _cameras(layout: _Layout) -> tuple[Path, ...]:
    return tuple(layout.root / images.relative_to(layout.root).parts[0] for images in (layout.left, layout.right))


def _packets_motion(layout: _Layout, frames_t_ns: IntArray) -> _Moved:
    packets = _read_packets(layout.root / "oxts")
    if packets is None:
        how = "no oxts: no motion input, all estimators assume smooth motion"
        return NoSamples(frames_t_ns), unmeasured_motion(), None, (how,)
    t_ns, values, alone = packets
    check_one_clock(layout.root, frames_t_ns, t_ns, "the oxts packets")
    facts = (f"{alone} oxts packets lack their file or their stamp and are left out",) if alone else ()
    # The world is east, north, up from the first place; the body forward, left, up, turned about z, then y, then x.
    about_x, about_y, about_z = (so3_exp(values[:, _ANGLES][:, i : i + 1] * np.eye(3)[i]) for i in range(3))
    R_world_imu, v_world, w_radps = about_z @ about_y @ about_x, values[:, _EAST_NORTH_UP], values[:, _RATES]
    stamps, first = np.unique(t_ns, return_index=True)
    truth = Truth(stamps, se3(R_world_imu, _positions(values[:, _PLACE]))[first], v_world[first], independent=False)
    rate_hz = NS_PER_S / float(np.median(np.abs(np.diff(t_ns))))
    if rate_hz >= _IMU_FROM_HZ:
        how = f"the oxts packets, {rate_hz:.0f} a second, are read as an IMU"
        return ImuSamples(t_ns, values[:, _ACCEL], w_radps), _IMU_NOISE, truth, (how, *facts)
    how = f"the oxts packets, {rate_hz:.0f} a second, are too few for an IMU and read as body twists"
    v_mps = np.einsum("nji,nj->ni", R_world_imu, v_world)
    noise = twist_noise(t_ns, v_mps, w_radps)
    return TwistSamples(t_ns, v_mps, w_radps), noise, truth, (how, *facts)


def _of_the_day(layout: _Layout, size_px: tuple[int, int]) -> _Mounted:
    """Return the pair of two cameras whose images have a size: the rectified one, or the sensor's."""
    folder = next((f for f in (layout.root, layout.root.parent) if is_regular(f / _CAMERAS)), layout.root.parent)
    where = (
        f"the day's calibration is a download of its own: put {_CAMERAS}, {_VELO} and {_IMU} into the folder of the "
        "day or of the drive"
    )
    cameras, velo, imu = (_calibration(folder / name, where) for name in (_CAMERAS, _VELO, _IMU))
    sides = tuple(camera.name.removeprefix("image_") for camera in _cameras(layout))
    names = [f"{what}_{side}" for side in sides for what in ("S", "K", "D", "R", "T", "S_rect", "P_rect")]
    cameras.require(*names, "R_rect_00")
    for other in (velo, imu):
        other.require("R", "T")
    T_cam0_imu = _rigid_motion(velo) @ _rigid_motion(imu)
    rectified_px, raw_px = (_size(cameras, f"{key}_{sides[0]}") for key in ("S_rect", "S"))
    if size_px == rectified_px:
        T_rect_cam0 = se3(cameras.constant("R_rect_00", 9).reshape(3, 3), np.zeros(3))
        rigid(cameras.path, "R_rect_00", T_rect_cam0)
        return _already(cameras, sides, size_px, T_rect_cam0 @ T_cam0_imu)
    if size_px != raw_px:
        size, *both = (f"{width}x{height}" for width, height in (size_px, rectified_px, raw_px))
        raise DataError(
            f"{cameras.path}: images of {size} px are neither rectified ones of that day, {both[0]}, nor raw ones, "
            f"{both[1]}; take the calibration of the images' day, or images that were not scaled or cut"
        )
    left, right = (_camera(cameras, side) for side in sides)
    T_left_cam0, T_right_cam0 = (_rigid_motion(cameras, f"_{side}") for side in sides)
    pair = rectified(left, right, T_right_cam0 @ se3_inverse(T_left_cam0), str(cameras.path))
    facts = ("raw images, rectified with the day's calibration",)
    return _Mounted(pair, se3_inverse(T_left_cam0 @ T_cam0_imu), facts)


def _already(cameras: Fields, sides: tuple[str, ...], size_px: tuple[int, int], T_rect_imu: Array) -> _Mounted:
    names = [f"P_rect_{side}" for side in sides]
    left, right = (cameras.constant(name, 12).reshape(3, 4) for name in names)
    pair = _rectified_pair(cameras.path, names, (left, right), size_px)
    T_left_rect = se3(np.eye(3), np.linalg.inv(left[:, :3]) @ left[:, 3])
    return _Mounted(pair, se3_inverse(T_left_rect @ T_rect_imu), ("images rectified as the data set has them",))


def _camera(cameras: Fields, side: str) -> Camera:
    pinhole_px = pinhole_of(cameras.constant(f"K_{side}", 9).reshape(3, 3))
    if not min(pinhole_px[:2]) > 0.0:
        raise DataError(f"{cameras.path}: K_{side} has no positive focal lengths; copy the file again")
    return Camera(pinhole_px, "radtan", cameras.constant(f"D_{side}", 5), _size(cameras, f"S_{side}"))


def _size(cameras: Fields, key: str) -> tuple[int, int]:
    width, height = cameras.constant(key, 2)
    return int(width), int(height)


def _rigid_motion(fields: Fields, suffix: str = "") -> Array:
    rotation = fields.constant(f"R{suffix}", 9).reshape(3, 3)
    return rigid(fields.path, f"R{suffix}", se3(rotation, fields.constant(f"T{suffix}", 3)))


def _read_packets(folder: Path) -> tuple[IntArray, Array, int] | None:
    """Return the stamps (S,) ns of packets, their values (S, 30), and how many lack their file or their stamp."""
    if not folder.is_dir():
        return None
    stamps = _read_stamps(folder / "timestamps.txt")
    files = {int(path.stem): path for path in (folder / "data").glob("*.txt") if path.stem.isdecimal()}
    numbers = sorted(files.keys() & stamps.keys())
    if len(numbers) < 2:
        raise DataError(f"{folder}: {len(numbers)} packets with a stamp; copy oxts/data and oxts/timestamps.txt again")
    t_ns = np.array([stamps[number] for number in numbers], dtype=np.int64)
    return t_ns, np.stack([_packet(files[number]) for number in numbers]), len(files.keys() ^ stamps.keys())


def _read_stamps(file: Path) -> dict[int, int]:
    """Return the stamp (ns) of each row number of a timestamps.txt; blank rows, as unsynced drives have, have none."""
    stamps = {}
    for row, line in enumerate(read_text_input(file, "expected a date and time in each line").splitlines()):
        text = line.strip().replace(" ", "T")
        if not text:
            continue
        try:
            stamps[row] = int(np.datetime64(text if _STAMP.fullmatch(text) else "no stamp", "ns").astype(np.int64))
        except ValueError as error:
            raise DataError(f"{file}: line {row + 1} is no time; write it as 2011-09-26 13:02:25.96") from error
    if not stamps:
        raise DataError(f"{file}: holds no stamps; copy it again")
    return stamps


def _packet(file: Path) -> Array:
    try:
        values = np.array([float(word) for word in read_text_input(file, "a packet is text").split()])
    except ValueError as error:
        raise DataError(f"{file}: {error}; expected {_VALUES} numbers") from error
    if values.size != _VALUES or not np.isfinite(values).all():
        raise DataError(f"{file}: {values.size} numbers, expected {_VALUES} finite ones; copy it again")
    if np.abs(values[_ANGLES]).max() > _LARGEST_ANGLE_RAD:
        raise DataError(f"{file}: roll, pitch and yaw are {values[_ANGLES].tolist()}, and no radians; convert degrees")
    return values


def _positions(places: Array) -> Array:
    """Return (S, 3) m east, north and up of the first of some places (S, 3) deg, deg, m."""
    latitude, longitude = np.deg2rad(places[:, :2]).T
    scale = np.cos(latitude[0]) * _EARTH_RADIUS_M
    projected = np.stack(
        [scale * longitude, scale * np.log(np.tan(np.pi / 4.0 + latitude / 2.0)), places[:, 2]], axis=1
    )
    return np.asarray(projected - projected[0])
