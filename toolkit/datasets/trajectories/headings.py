"""Which columns of a table are stamps, positions, quaternions or an IMU's, by the names that its heading gives them.

Programs name them alike but for words around the axis: ``qx``, ``q_RS_x``, ``quat_x``, ``field.pose.orientation.x``.
"""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

_UNITS_NS = {
    "ns": 1, "nsec": 1, "nsecs": 1, "nanosec": 1, "nanoseconds": 1, "us": 1_000, "usec": 1_000, "microseconds": 1_000,
    "ms": 1_000_000, "msec": 1_000_000, "milliseconds": 1_000_000, "s": 10**9, "sec": 10**9, "secs": 10**9,
    "seconds": 10**9,
}  # fmt: skip
# The last word of a name but for its unit.
_SECONDS, _NANOSECONDS = ("sec", "secs", "seconds"), ("nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds")
_STAMPS = ("t", "time", "timestamp", "stamp", "ts", "ns", *_SECONDS, *_NANOSECONDS)
_POSITIONS = ("", "p", "pos", "position", "t", "trans", "translation", "location", "xyz")
_QUATERNIONS = ("q", "quat", "quaternion", "orientation", "rot", "rotation")
_ACCELERATIONS = ("arss", "alpha", "a", "acc", "accel", "acceleration", "accelerometer", "linearacceleration")
_RATES = ("wrss", "omega", "w", "g", "gyr", "gyro", "gyroscope", "angularvelocity")
_IN_BRACKETS, _BETWEEN_WORDS = re.compile(r"[\[(](.*?)[\])]"), re.compile(r"[^a-z0-9]+")


class Named(NamedTuple):
    """The columns of a table from 0, quaternions x y z w; ``unit_ns`` is that of the stamps where their name says it.

    A table of positions alone has no quaternions. Whole seconds may have their nanoseconds in a column of their own.
    """

    stamp: int
    unit_ns: int | None
    position: tuple[int, ...]
    quaternion: tuple[int, ...]
    nanoseconds: int | None = None


def named_columns(names: Sequence[str]) -> Named | None:
    """Return the columns that names say; None where they name no stamp, or not each axis of a position once."""
    words = [_words(name) for name in names]
    stamps = [
        at for at, of_name in enumerate(words) if of_name and _stem(of_name)[-1:] and _stem(of_name)[-1] in _STAMPS
    ]
    position = _axes(words, "xyz", _POSITIONS)
    if not stamps or len(position) != 3:
        return None
    seconds, parts = ([at for at in stamps if words[at][-1] in of_unit] for of_unit in (_SECONDS, _NANOSECONDS))
    at, rest = (seconds[0], parts[0]) if seconds and parts else (stamps[0], None)
    return Named(at, _unit_ns(names[at]), position, _axes(words, "xyzw", _QUATERNIONS), rest)


def is_of_the_globe(names: Iterable[str]) -> bool:
    words = {word for name in names for word in _words(name)}
    return bool(words & {"lat", "latitude"} and words & {"lon", "long", "lng", "longitude"})


def stamp_unit_ns(name: str) -> int | None:
    """Return the unit of the stamps in a column of this name, ns; None where it names no stamp, or not their unit."""
    words = _words(name)
    return _unit_ns(name) if words and _stem(words)[-1] in _STAMPS else None


def _unit_ns(name: str) -> int | None:
    in_brackets = _IN_BRACKETS.search(name)
    return _UNITS_NS.get((in_brackets[1].strip().lower() if in_brackets else "") or _words(name)[-1])


def imu_columns(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of accelerations and of rates of rotation, x y z each, whatever a program calls them, or none.

    ``a_RS_S_x``, ``alpha_x`` (Kalibr), ``ax``, ``acc_x`` and ``linear_acceleration.x`` are one and the same, as are
    ``w_RS_S_x``, ``omega_x``, ``wx``, ``gx``, ``gyro_x`` and ``angular_velocity.x``. Names with more words are those of
    other quantities: ``b_w_RS_S_x`` is a bias, ``angular_acceleration.x`` no force.
    """
    plain = {"".join(_words(name)).removeprefix("field"): name for name in names}
    found: list[str] = []
    for kinds in (_ACCELERATIONS, _RATES):
        sets = ([plain.get(f"{kind}{axis}", "") for axis in "xyz"] for kind in kinds)
        found += next((one for one in sets if all(one)), [])
    return tuple(found) if len(found) == 6 else ()


def _words(name: str) -> list[str]:
    """Return the words of a name, without units in brackets, in small letters; the axis is a word of its own."""
    plain = _IN_BRACKETS.sub("", name).strip().strip("#%").lower()
    return [word for word in _BETWEEN_WORDS.split(plain) if word]


def _stem(words: list[str]) -> list[str]:
    """Return the words but for a unit behind the name of a stamp."""
    return words[:-1] if len(words) > 1 and words[-1] in _UNITS_NS else words


def _axes(words: list[list[str]], axes: str, kinds: tuple[str, ...]) -> tuple[int, ...]:
    """Return the columns of the axes of a quantity called one of several names; nothing where one is missing."""
    for kind in kinds:
        found = [[at for at, of_name in enumerate(words) if _is_axis(of_name, axis, kind)] for axis in axes]
        if all(found):
            return tuple(columns[0] for columns in found)
    return ()


def _is_axis(words: list[str], axis: str, kind: str) -> bool:
    """Say whether a name is that of an axis: ``x``, ``px``, ``p_x``, ``p_RS_R_x``, ``pose.position.x``, ``x_m``."""
    if words[-1:] == ["m"] and len(words) > 1:
        words = words[:-1]
    if not words or not words[-1].endswith(axis):
        return False
    if len(words) == 1 or words[-1] != axis:
        return words[-1] == f"{kind}{axis}"
    return bool(kind) and (kind in words[:-1])
