"""Packets of KITTI's inertial navigation system, one file each, and its stamps in words.

Positions are projected as the development kit of the data set does: Mercator, scaled at the first latitude.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array, IntArray, se3, so3_exp
from toolkit.inputs import read_text_input

_VALUES = 30
# Where in a packet stand: latitude, longitude (deg), altitude (m); roll, pitch, yaw (rad); north, east, up (m/s).
_PLACE, _ANGLES, _NORTH_EAST_UP = slice(0, 3), slice(3, 6), [6, 7, 10]
# Of the body: specific force (m/s^2) and rates (rad/s).
_ACCEL, _RATES = slice(11, 14), slice(17, 20)
_EARTH_RADIUS_M = 6378137.0
_STAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d+)?")


@dataclass(frozen=True, eq=False)
class Packets:
    """Packets (S,) in the order of their files: poses (S, 4, 4), velocities, specific force and rates (S, 3).

    The world is east, north, up from the first place; the body forward, left, up.
    """

    t_ns: IntArray
    T_world_imu: Array
    v_world: Array
    accel_mps2: Array
    w_radps: Array

    @property
    def v_body_mps(self) -> Array:
        """Return the velocities (S, 3) in the body's axes."""
        return np.asarray(np.einsum("nji,nj->ni", self.T_world_imu[:, :3, :3], self.v_world))


def read_packets(folder: Path) -> Packets | None:
    """Read the packets that have a stamp; None where there is no such folder.

    Raises DataError, naming the file, where one does not hold thirty finite numbers.
    """
    if not folder.is_dir():
        return None
    stamps = read_stamps(folder / "timestamps.txt")
    files = {int(path.stem): path for path in (folder / "data").glob("*.txt") if path.stem.isdecimal()}
    numbers = [number for number in sorted(files) if number in stamps]
    if len(numbers) < 2:
        raise DataError(f"{folder}: {len(numbers)} packets with a stamp; copy oxts/data and oxts/timestamps.txt again")
    rows = np.stack([_packet(files[number]) for number in numbers])
    north, east, up = rows[:, _NORTH_EAST_UP].T
    return Packets(
        np.array([stamps[number] for number in numbers], dtype=np.int64),
        se3(_attitudes(rows[:, _ANGLES]), _positions(rows[:, _PLACE])),
        np.stack([east, north, up], axis=1),
        rows[:, _ACCEL],
        rows[:, _RATES],
    )


def read_stamps(file: Path) -> dict[int, int]:
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


def _stamp_ns(words: str) -> int:
    """Return the nanoseconds since 1970 of a date and time; raises ValueError where it is none."""
    if not _STAMP.fullmatch(words):
        raise ValueError(words)
    return int(np.datetime64(words.replace(" ", "T"), "ns").astype(np.int64))


def _packet(file: Path) -> Array:
    try:
        values = np.array([float(word) for word in read_text_input(file, "a packet is text").split()])
    except ValueError as error:
        raise DataError(f"{file}: {error}; expected {_VALUES} numbers") from error
    if values.size != _VALUES or not np.isfinite(values).all():
        raise DataError(f"{file}: {values.size} numbers, expected {_VALUES} finite ones; copy it again")
    return values


def _positions(places: Array) -> Array:
    """Return (S, 3) m east, north and up of the first of some places (S, 3) deg, deg, m."""
    latitude, longitude = np.deg2rad(places[:, :2]).T
    scale = np.cos(latitude[0]) * _EARTH_RADIUS_M
    mapped = np.stack([scale * longitude, scale * np.log(np.tan(np.pi / 4.0 + latitude / 2.0)), places[:, 2]], axis=1)
    return np.asarray(mapped - mapped[0])


def _attitudes(angles: Array) -> Array:
    """Return rotations (S, 3, 3) of roll, pitch and yaw (S, 3) rad: about z, then y, then x."""
    about = [so3_exp(angles[:, i : i + 1] * np.eye(3)[i]) for i in range(3)]
    return np.asarray(about[2] @ about[1] @ about[0])
