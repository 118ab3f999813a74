"""KITTI raw drives: stereo images, synced and rectified or not, with the inertial navigation system's packets (oxts).

A folder with ``image_00/data`` and ``image_01/data`` (or ``image_02`` and ``image_03``), the calib_*.txt of its day in
it or beside it, and ``oxts/data``. Packets at 50 Hz or more are read as an IMU, slower ones as body twists; without any
a smooth motion is assumed. Whether images are rectified shows in their size. Truth and motion are of one instrument.
Axes of the IMU: forward, left, up. Source: Geiger, Lenz, Stiller & Urtasun, "Vision meets robotics: the KITTI dataset"
(IJRR 2013), and the readme of its development kit for the 30 values of a packet; positions are projected as that kit
does, by Mercator's projection scaled at the first latitude.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolkit.datasets.io.fields import Fields, rigid
from toolkit.datasets.io.image_pairs import (
    UNPACK_IMAGES,
    Listed,
    check_both_cameras,
    check_one_clock,
    check_several_stamps,
    first_with_images,
    has_folders,
    image_folder,
    image_size,
    images_only,
    pairs_by_stamps,
    pinhole_of,
    seen_in,
)
from toolkit.errors import DataError
from toolkit.files.reading import is_regular, read_text_input
from toolkit.frontend import Camera, ImageRecording, RectifiedPair, already_rectified, rectified
from toolkit.geometry import Array, IntArray, se3, se3_inverse, so3_exp
from toolkit.measurements import NS_PER_S, ImuNoise, MotionNoise
from toolkit.models.noise import twist_noise, unmeasured_motion
from toolkit.motion_samples import ImuSamples, MotionSamples, NoSamples, TwistSamples
from toolkit.progress import SILENT, Progress
from toolkit.sequence import Provenance, Sequence, Truth
from toolkit.settings import DEFAULTS, Frontend

CITES = ("geiger2013kitti",)
_SIDES = (("00", "01"), ("02", "03"))
# Between slower packets a car's specific force is not what its samples say.
_IMU_FROM_HZ = 50.0
# The same unit's, as GTSAM's example of drive 2011_10_03_drive_0027 states it.
_IMU_NOISE = ImuNoise(
    accel_noise_density=0.01, gyro_noise_density=1.75e-4, accel_random_walk=1.67e-4, gyro_random_walk=2.91e-6
)
_CAMERAS, _VELO, _IMU = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt"
_LARGEST_ANGLE_RAD = 2.0 * np.pi
_VALUES = 30
# Where in a packet stand: latitude, longitude (deg), altitude (m); roll, pitch, yaw (rad); north, east, up (m/s).
_PLACE, _ANGLES, _NORTH_EAST_UP = slice(0, 3), slice(3, 6), [6, 7, 10]
# Of the body: specific force (m/s^2) and rates (rad/s).
_ACCEL, _RATES = slice(11, 14), slice(17, 20)
_EARTH_RADIUS_M = 6378137.0
_STAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d+)?")


@dataclass(frozen=True)
class _Layout:
    """The folder of a drive and the numbers of its two cameras."""

    root: Path
    sides: tuple[str, str]

    def images(self, side: int) -> Path:
        return image_folder(self.camera(side))

    def camera(self, side: int) -> Path:
        return self.root / f"image_{self.sides[side]}"


uses_images = images_only


def recognises(path: Path) -> bool:
    """Say whether the path has the folders of a raw drive's cameras, or one with images."""
    return _layout(path) is not None or any(has_folders(path, *(f"image_{side}" for side in pair)) for pair in _SIDES)


def load(path: Path) -> Sequence:
    """Read a drive with the front end's default settings; see :func:`load_from_images`."""
    return load_from_images(path, DEFAULTS.frontend, SILENT)


def images_of(path: Path, frontend: Frontend) -> ImageRecording:
    """Return the image pairs and their cameras; raises DataError as :func:`load_from_images`."""
    layout = _whole(path)
    return ImageRecording(_listed(layout).pairs, _mounted(layout).pair)


def load_from_images(path: Path, frontend: Frontend, progress: Progress) -> Sequence:
    """Read calibration, stamps and packets, and make the tracks of the images.

    Raises DataError where a part is missing or damaged, or the images cannot be used.
    """
    layout = _whole(path)
    mounted, listed = _mounted(layout), _listed(layout)
    seen = seen_in(layout.root, ImageRecording(listed.pairs, mounted.pair), mounted.T_imu_left, frontend, progress)
    packets = _read_packets(layout.root / "oxts")
    if packets is not None:
        check_one_clock(layout.root, seen.frames_t_ns, packets.t_ns, "the oxts packets")
    motion, noise, how = _motion(packets, seen.frames_t_ns)
    facts = (how, *_incomplete(packets), *seen.facts, *listed.remarks, mounted.source)
    return Sequence(
        name=layout.root.name,
        rig=seen.rig,
        noise=noise,
        frames_t_ns=seen.frames_t_ns,
        observations=seen.observations,
        motion=motion,
        provenance=Provenance("kitti-raw", f"{path}: stereo tracks from the images", facts),
        truth=None if packets is None else _truth(packets),
    )


def _layout(path: Path) -> _Layout | None:
    """Return the first pair of cameras that both have images, else the first of which one has."""
    layouts = [_Layout(path.resolve(), sides) for sides in _SIDES]
    place = first_with_images([(one.images(0), one.images(1)) for one in layouts])
    return None if place is None else layouts[place]


def _whole(path: Path) -> _Layout:
    layout = _layout(path)
    if layout is None:
        raise DataError(
            f"{path}: no image_00/data and image_01/data, or image_02 and image_03, with images; {UNPACK_IMAGES}"
        )
    check_both_cameras(layout.root, layout.images(0), layout.images(1))
    return layout


def _listed(layout: _Layout) -> Listed:
    left, right = (layout.camera(side) / "timestamps.txt" for side in (0, 1))
    stamps = _read_stamps(left)
    right_stamps = _read_stamps(right) if is_regular(right) else stamps
    listed = pairs_by_stamps(layout.images(0), layout.images(1), stamps, right_stamps)
    check_several_stamps(left, listed)
    return listed


def _mounted(layout: _Layout) -> _PairMounting:
    return _mounting(_day_of(layout.root), layout.sides, image_size(layout.images(0), layout.images(1)))


def _motion(packets: _Packets | None, frames_t_ns: np.ndarray) -> tuple[MotionSamples, MotionNoise, str]:
    """Return the motion samples, their noise, and which they are in words."""
    if packets is None:
        how = "no oxts: no motion input, all estimators assume smooth motion"
        return NoSamples(frames_t_ns), unmeasured_motion(), how
    rate_hz = NS_PER_S / float(np.median(np.abs(np.diff(packets.t_ns))))
    if rate_hz >= _IMU_FROM_HZ:
        samples = ImuSamples(packets.t_ns, packets.accel_mps2, packets.w_radps)
        return samples, _IMU_NOISE, f"the oxts packets, {rate_hz:.0f} a second, are read as an IMU"
    v_mps = packets.v_body_mps
    how = f"the oxts packets, {rate_hz:.0f} a second, are too few for an IMU and read as body twists"
    return TwistSamples(packets.t_ns, v_mps, packets.w_radps), twist_noise(packets.t_ns, v_mps, packets.w_radps), how


def _incomplete(packets: _Packets | None) -> tuple[str, ...]:
    """Return a remark where packets lack their stamp, or stamps their packet."""
    alone = 0 if packets is None else packets.alone
    return (f"{alone} oxts packets lack their file or their stamp and are left out",) if alone else ()


def _truth(packets: _Packets) -> Truth:
    """Return the poses of the same instrument, in order of time."""
    t_ns, first = np.unique(packets.t_ns, return_index=True)
    return Truth(t_ns, packets.T_world_imu[first], packets.v_world[first], independent=False)


@dataclass(frozen=True, eq=False)
class _PairMounting:
    """A pair for the front end, where its left camera is mounted, as it was before rectification, and how one knows."""

    pair: RectifiedPair
    T_imu_left: Array
    source: str


@dataclass(frozen=True, eq=False)
class _Day:
    """The three files of a drive's day: all cameras, the laser scanner in camera 0, and the IMU in the scanner."""

    cameras: Fields
    velo: Fields
    imu: Fields


def _day_of(root: Path) -> _Day:
    """Read the three files of a drive's day, in its folder or the one above it.

    Raises DataError where one is missing or no text.
    """
    folder = next((f for f in (root, root.parent) if is_regular(f / _CAMERAS)), root.parent)
    return _Day(*(_calibration(folder / name) for name in (_CAMERAS, _VELO, _IMU)))


def _calibration(file: Path) -> Fields:
    """Read a file of names and numbers; entries that are no numbers, such as dates, are left out."""
    if not file.exists():
        raise DataError(
            f"{file}: is missing; the day's calibration is a download of its own: put {_CAMERAS}, {_VELO} and {_IMU} "
            "into the folder of the day or of the drive"
        )
    arrays: dict[str, np.ndarray] = {}
    for line in read_text_input(file, "KITTI's calibration is text").splitlines():
        key, colon, rest = line.partition(":")
        with suppress(ValueError):
            if colon:
                arrays[key.strip()] = np.array([float(word) for word in rest.split()])
    return Fields(file, arrays)


def _mounting(day: _Day, sides: tuple[str, str], size_px: tuple[int, int]) -> _PairMounting:
    """Return the pair of two cameras, as "00" and "01", whose images have a size: the rectified one, or the sensor's.

    Raises DataError where a value is missing or impossible, or images have neither size.
    """
    names = [f"{what}_{side}" for side in sides for what in ("S", "K", "D", "R", "T", "S_rect", "P_rect")]
    day.cameras.require(*names, "R_rect_00")
    for other in (day.velo, day.imu):
        other.require("R", "T")
    T_cam0_imu = _rigid_motion(day.velo) @ _rigid_motion(day.imu)
    rectified_px, raw_px = (_size(day.cameras, f"{key}_{sides[0]}") for key in ("S_rect", "S"))
    if size_px == rectified_px:
        T_rect_cam0 = se3(day.cameras.constant("R_rect_00", 9).reshape(3, 3), np.zeros(3))
        rigid(day.cameras.path, "R_rect_00", T_rect_cam0)
        return _already(day.cameras, sides, size_px, T_rect_cam0 @ T_cam0_imu)
    if size_px != raw_px:
        size, *both = (f"{width}x{height}" for width, height in (size_px, rectified_px, raw_px))
        raise DataError(
            f"{day.cameras.path}: images of {size} px are neither rectified ones of that day, {both[0]}, nor raw ones, "
            f"{both[1]}; take the calibration of the images' day, or images that were not scaled or cut"
        )
    cameras = [_camera(day.cameras, side) for side in sides]
    T_left_cam0, T_right_cam0 = (_rigid_motion(day.cameras, f"_{side}") for side in sides)
    pair = rectified(cameras[0], cameras[1], T_right_cam0 @ se3_inverse(T_left_cam0), str(day.cameras.path))
    return _PairMounting(
        pair, se3_inverse(T_left_cam0 @ T_cam0_imu), "raw images, rectified with the day's calibration"
    )


def _already(cameras: Fields, sides: tuple[str, str], size_px: tuple[int, int], T_rect_imu: Array) -> _PairMounting:
    left, right = (cameras.constant(f"P_rect_{side}", 12).reshape(3, 4) for side in sides)
    pinhole_px = pinhole_of(left)
    if not min(pinhole_px[:2]) > 0.0:
        raise DataError(f"{cameras.path}: P_rect_{sides[0]} has no positive focal lengths; copy the file again")
    baseline_m = float((left[0, 3] - right[0, 3]) / pinhole_px[0])
    if not baseline_m > 0.0:
        raise DataError(
            f"{cameras.path}: by P_rect_{sides[0]} and P_rect_{sides[1]} the right camera is not to the right of the "
            "left one; copy the file again"
        )
    T_left_rect = se3(np.eye(3), np.linalg.inv(left[:, :3]) @ left[:, 3])
    pair = already_rectified(pinhole_px, baseline_m, size_px)
    return _PairMounting(pair, se3_inverse(T_left_rect @ T_rect_imu), "images rectified as the data set has them")


def _camera(cameras: Fields, side: str) -> Camera:
    pinhole_px = pinhole_of(cameras.constant(f"K_{side}", 9).reshape(3, 3))
    if not min(pinhole_px[:2]) > 0.0:
        raise DataError(f"{cameras.path}: K_{side} has no positive focal lengths; copy the file again")
    return Camera(pinhole_px, "radtan", cameras.constant(f"D_{side}", 5), _size(cameras, f"S_{side}"))


def _size(cameras: Fields, key: str) -> tuple[int, int]:
    width, height = cameras.constant(key, 2)
    return int(width), int(height)


def _rigid_motion(fields: Fields, suffix: str = "") -> Array:
    """Return the rigid motion (4, 4) of an R and a T."""
    rotation = fields.constant(f"R{suffix}", 9).reshape(3, 3)
    return rigid(fields.path, f"R{suffix}", se3(rotation, fields.constant(f"T{suffix}", 3)))


@dataclass(frozen=True, eq=False)
class _Packets:
    """Packets (S,) in the order of their files: poses (S, 4, 4), velocities, specific force and rates (S, 3).

    The world is east, north, up from the first place; the body forward, left, up. ``alone`` is how many packets have a
    file and no stamp, or a stamp and no file.
    """

    t_ns: IntArray
    T_world_imu: Array
    v_world: Array
    accel_mps2: Array
    w_radps: Array
    alone: int

    @property
    def v_body_mps(self) -> Array:
        """Return the velocities (S, 3) in the body's axes."""
        return np.asarray(np.einsum("nji,nj->ni", self.T_world_imu[:, :3, :3], self.v_world))


def _read_packets(folder: Path) -> _Packets | None:
    """Read the packets that have a stamp; None where there is no such folder.

    Raises DataError, naming the file, where one does not hold thirty finite numbers.
    """
    if not folder.is_dir():
        return None
    stamps = _read_stamps(folder / "timestamps.txt")
    files = {int(path.stem): path for path in (folder / "data").glob("*.txt") if path.stem.isdecimal()}
    numbers = sorted(files.keys() & stamps.keys())
    if len(numbers) < 2:
        raise DataError(f"{folder}: {len(numbers)} packets with a stamp; copy oxts/data and oxts/timestamps.txt again")
    rows = np.stack([_packet(files[number]) for number in numbers])
    north, east, up = rows[:, _NORTH_EAST_UP].T
    return _Packets(
        np.array([stamps[number] for number in numbers], dtype=np.int64),
        se3(_attitudes(rows[:, _ANGLES]), _positions(rows[:, _PLACE])),
        np.stack([east, north, up], axis=1),
        rows[:, _ACCEL],
        rows[:, _RATES],
        len(files.keys() ^ stamps.keys()),
    )


def _read_stamps(file: Path) -> dict[int, int]:
    """Return the stamp (ns) of each row number of a timestamps.txt; blank rows, as unsynced drives have, have none.

    Raises DataError, naming the line, where one is no date and time.
    """
    stamps = {}
    for row, line in enumerate(read_text_input(file, "expected a date and time in each line").splitlines()):
        if not line.strip():
            continue
        try:
            stamps[row] = _stamp_ns(line.strip())
        except ValueError as error:
            raise DataError(
                f"{file}: line {row + 1} is no date and time; write it as in 2011-09-26 13:02:25.96"
            ) from error
    if not stamps:
        raise DataError(f"{file}: holds no stamps; copy it again")
    return stamps


def _stamp_ns(stamp_text: str) -> int:
    """Return the nanoseconds since 1970 of a date and time; raises ValueError where it is none."""
    if not _STAMP.fullmatch(stamp_text):
        raise ValueError(stamp_text)
    return int(np.datetime64(stamp_text.replace(" ", "T"), "ns").astype(np.int64))


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


def _attitudes(angles: Array) -> Array:
    """Return rotations (S, 3, 3) of roll, pitch and yaw (S, 3) rad: about z, then y, then x."""
    about = [so3_exp(angles[:, i : i + 1] * np.eye(3)[i]) for i in range(3)]
    return np.asarray(about[2] @ about[1] @ about[0])
