"""The named values of a recording: checks of type and shape, stamps, stereo corners, and the YAML of calibrations.

Every check turns a malformed array into one line that names file and key. YAML in OpenCV's dialect begins with
``%YAML:1.0``, which is not YAML, and tags its matrices ``!!opencv-matrix``; Kalibr writes matrices as lists of rows,
which OpenCV's own reader does not take.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from toolkit.arrays import check_rigid, check_shape
from toolkit.errors import DataError, printable
from toolkit.files.reading import read_text_input
from toolkit.geometry import Array, IntArray
from toolkit.measurements import NS_PER_S
from toolkit.motion_samples import ImuSamples
from toolkit.sequence import Observations

# How far R^T R of a calibration may be from the identity: four printed decimals leave 1e-4.
_RIGID_TOLERANCE = 1e-3
# A pair whose rows are this far apart (median, px) is not rectified: at most 0.3 px in the recordings at hand.
_MOST_ROWS_APART_PX, _FEWEST_ROWS = 1.5, 30
# Corners whose rows are this far apart (px) are mismatches: 4 % of them at most in the recordings at hand, with 3 px of
# noise.
_NO_MATCH_PX, _MOST_NO_MATCH = 5.0, 0.1
# Share of the focal length that a skew may be: less than a pixel at the edge of the image.
_MOST_SKEW = 1e-3
# Latest plausible stamp, in the year 5000.
_LATEST_S = 1e11
# Largest time in seconds that int64 nanoseconds can hold: the year 2262.
_LATEST_NS_S = 9.2e9
_LARGEST_NS = 2**63 - 1
# The usual form of seconds; reading digits is several times as fast as decimal numbers.
_USUAL_STAMP = re.compile(r"([0-9]{1,10})\.([0-9]{1,9})")
# Stamps are finer than this; single precision is not, from 10 000 s on.
_COARSE_S = 9e-4
# Stamps are farther apart only where a few places are visited, and no such visits are hours apart.
_LONGEST_STEP_S, _LONGEST_VISIT_S = 30.0, 3600.0
# Seconds of the years 2005 to 2035, and a recording that would be shorter in another unit is of seconds.
_TODAY_S, _SHORTEST_S = (1.1e9, 2.05e9), 1.0
_UNITS = (
    (1e-9, "nanoseconds: divide by 1e9"),
    (1e-6, "microseconds: divide by 1e6"),
    (1e-3, "milliseconds: divide by 1e3"),
)
# Rates above two thousand samples a second are not plausible, so closer stamps are not in nanoseconds. Their unit is
# found from the step: thresholds are the geometric means of steps of 50 ms in one unit and the next.
_UNITS_OF_NS = (
    (1.6, "seconds: multiply by 1e9"),
    (1.6e3, "milliseconds: multiply by 1e6"),
    (5e5, "microseconds: multiply by 1e3"),
)
NO_SIGHTINGS = Observations(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3)))
_DIALECT = "%YAML:"
# A calibration of a rig of many cameras takes some thousand characters.
_MOST_CHARACTERS = 1_000_000
# Nine lists of ten, each of aliases of the one before, are a billion values in 600 characters.
_MOST_VALUES = 100_000


@dataclass(frozen=True, eq=False)
class Fields:
    """Arrays by key, and the file they were read from; every accessor raises DataError naming file and key."""

    path: Path
    arrays: Mapping[str, npt.NDArray[np.generic]]

    def __contains__(self, key: str) -> bool:
        return key in self.arrays

    def require(self, *alternatives: str) -> None:
        """Raise DataError listing every missing key; ``"a|b"`` is satisfied by either."""
        missing = [keys for keys in alternatives if not any(key in self for key in keys.split("|"))]
        if missing:
            wanted = ", ".join(keys.replace("|", " or ") for keys in missing)
            raise DataError(f"{self.path}: missing {wanted}; it has {', '.join(sorted(self.arrays)) or 'nothing'}")

    def array(self, key: str, *shape: int | None) -> Array:
        """Return a numeric array of the given shape (None = any length) as float64, NaN included."""
        array = self.arrays[key]
        check_numeric(self.path, key, array.dtype)
        check_shape(f"{self.path}: {key}", array.shape, shape)
        return array.astype(np.float64)

    def vector(self, key: str) -> Array:
        """Return an array stored as (), (n,), (1, n) or (n, 1) as (n,)."""
        array = self.arrays[key]
        check_numeric(self.path, key, array.dtype)
        if sum(length != 1 for length in array.shape) > 1:
            raise DataError(f"{self.path}: {key} has shape {array.shape}, expected one row of numbers")
        return array.astype(np.float64).ravel()

    def constant(self, key: str, *shape: int) -> Array:
        """Return a finite numeric array of the given shape: a calibration must not have gaps."""
        array = self.array(key, *shape)
        if not np.isfinite(array).all():
            raise DataError(f"{self.path}: {key} is not finite; a calibration needs every value")
        return array

    def positive(self, key: str) -> float:
        value = self.number(key)
        if value <= 0.0:
            raise DataError(f"{self.path}: {key} is {value:g}, expected a positive number")
        return value

    def number(self, key: str) -> float:
        """Return a single finite number, whatever its number of axes."""
        vector = self.vector(key)
        if vector.size != 1:
            raise DataError(f"{self.path}: {key} has {vector.size} values, expected one finite number")
        if not np.isfinite(vector[0]):
            raise DataError(f"{self.path}: {key} is {vector[0]:g}, expected a finite number")
        return float(vector[0])

    def rigid(self, key: str) -> Array:
        return rigid(self.path, key, self.constant(key, 4, 4))


def check_numeric(path: Path, key: str, dtype: np.dtype[np.generic]) -> None:
    """Raise DataError unless the dtype is one of real numbers."""
    if dtype.kind == "O":
        raise DataError(f"{path}: {key} holds objects, which are never unpickled; save it as plain numbers")
    if dtype.kind not in "fiu":
        raise DataError(f"{path}: {key} holds {'text' if dtype.kind in 'US' else dtype}, expected real numbers")


def rigid(path: Path, key: str, T: Array) -> Array:
    check_rigid(f"{path}: {key}", T, _RIGID_TOLERANCE)
    return T


def check_frame_count(path: Path, frame_count: int) -> None:
    """Raise DataError where a recording is too short to estimate any motion."""
    if frame_count < 2:
        raise DataError(f"{path}: the recording has {frame_count} frame(s); at least two are needed")


def stamps_ns(path: Path, key: str, stamps_s: Array) -> IntArray:
    """Return stamps (N,) given in seconds as int64 nanoseconds.

    Raises DataError naming the first stamp that is not finite, or the unit the stamps are probably in, or where they
    were rounded to single precision. The order is not checked: a recording may be repaired.
    """
    bad = np.flatnonzero(~np.isfinite(stamps_s))
    if bad.size:
        raise DataError(f"{path}: {key}[{bad[0]}] is {stamps_s[bad[0]]} ({bad.size} such stamps); remove these samples")
    far = np.abs(stamps_s) > _LATEST_NS_S
    if 2 * far.sum() >= far.size:  # most are of another unit, if of any
        far = np.abs(stamps_s) > NS_PER_S * _LATEST_NS_S
    if far.any():
        shown = f"{key}[{far.argmax()}] is {stamps_s[far.argmax()]:g} s"
        raise DataError(f"{path}: {shown}, beyond the year 2262 ({far.sum()} such stamps); correct them")
    unit = _unit_of(stamps_s)
    coarse_s = (1.0 if unit is None else unit[0]) * float(np.spacing(np.float32(np.abs(stamps_s).max(initial=0.0))))
    if coarse_s > _COARSE_S and stamps_s.size > 1 and _is_single_precision(stamps_s):
        raise DataError(f"{path}: {key} went through single precision, in steps of {coarse_s:g} s: write it in double")
    if unit is not None:
        raise DataError(f"{path}: {key} must be in seconds, but the stamps look like {unit[1]}")
    return np.rint(stamps_s * NS_PER_S).astype(np.int64)


def exact_ns(cells: Sequence[str], per_unit_ns: int, place: Callable[[int], str]) -> IntArray:
    """Return printed stamps, in units of ``per_unit_ns``, as int64 nanoseconds (N,), rounded only there.

    A double holds today's seconds to 0.2 us only. Raises DataError, with the ``place`` of a row, where a stamp is no
    finite number or beyond what 64 bits hold.
    """
    return np.array([_exact_ns(cell, per_unit_ns, row, place) for row, cell in enumerate(cells)], dtype=np.int64)


def _exact_ns(cell: str, per_unit_ns: int, row: int, place: Callable[[int], str]) -> int:
    if per_unit_ns == NS_PER_S and (usual := _USUAL_STAMP.fullmatch(cell)):
        t_ns = int(usual[1] + usual[2].ljust(9, "0"))
    else:
        try:
            # Decimal takes 1_0 for ten, and no other program does.
            t_ns = int((Decimal(cell.replace("_", "?")) * per_unit_ns).to_integral_value())
        except (InvalidOperation, OverflowError, ValueError):
            shown = printable(cell)[:50] or "empty"
            raise DataError(f"{place(row)} has no finite time ({shown}); remove the line") from None
    if abs(t_ns) > _LARGEST_NS:
        raise DataError(f"{place(row)} has the time {printable(cell)[:50]}, beyond any clock; check its unit")
    return t_ns


def _is_single_precision(stamps: Array) -> bool:
    """Say whether all stamps (N,) are numbers of single precision, and not only as whole seconds or quarters are."""
    step = float(np.spacing(np.float32(np.abs(stamps).max())))
    finest = step > 1.0 or (stamps / step % 2.0 == 1.0).any()
    return bool(finest and (stamps == stamps.astype(np.float32)).all())


def probable_unit(stamps_s: Array) -> str | None:
    """Return the unit, with its remedy, that stamps (N,) are probably in, or None where seconds are plausible."""
    return (_unit_of(stamps_s) or (0.0, None))[1]


def _unit_of(stamps_s: Array) -> tuple[float, str] | None:
    """Return the unit that stamps (N,) are probably in, in seconds, and its name; None where seconds are plausible.

    Seconds of today are, however far apart: control points are visited every few minutes. So are stamps that span too
    little for another unit: seven of them 45 apart are no recording of a quarter of a second.
    """
    largest, least = (float(np.abs(end(stamps_s))) if stamps_s.size else 0.0 for end in (np.max, np.min))
    step = float(np.median(np.abs(np.diff(stamps_s)))) if stamps_s.size > 1 else 0.0
    if largest < _LATEST_S and step < _LONGEST_STEP_S:
        return None
    if _TODAY_S[0] < least <= largest < _TODAY_S[1] and step < _LONGEST_VISIT_S:
        return None
    # The size of absolute stamps shows their unit (the epoch began 1.3e9 to 1.8e9 s ago), the step of relative ones.
    unit = next((one for one in _UNITS if largest * one[0] > 1e8 or step * one[0] > 1e-3), _UNITS[-1])
    spans_s = unit[0] * float(np.ptp(stamps_s)) if stamps_s.size else 0.0
    is_short = stamps_s.size > 1 and largest < _LATEST_S and step < _LONGEST_VISIT_S and spans_s < _SHORTEST_S
    return None if is_short else unit


def probable_unit_of_ns(t_ns: npt.NDArray[np.generic]) -> str | None:
    """Return the unit, with its remedy, that stamps (N,) are probably in, or None where nanoseconds are plausible."""
    steps = np.diff(np.unique(t_ns))
    step = float(np.median(steps)) if steps.size else np.inf
    return next((name for below, name in _UNITS_OF_NS if step < below), None)


def joined_imu(gyro: tuple[IntArray, Array], accel: tuple[IntArray, Array]) -> ImuSamples | None:
    """Return samples of a gyro with those of an accelerometer, which has other stamps, interpolated at its own.

    Both are stamps (N,) ns and values (N, 3). None where they have no time in common.
    """
    order = np.argsort(accel[0], kind="stable")
    t_ns, values = accel[0][order], accel[1][order]
    within = (gyro[0] >= t_ns[0]) & (gyro[0] <= t_ns[-1])
    if not within.any():
        return None
    at_ns = gyro[0][within]
    at_gyro = np.stack([np.interp(at_ns - t_ns[0], t_ns - t_ns[0], column) for column in values.T], axis=1)
    return ImuSamples(at_ns, at_gyro, gyro[1][within])


def check_rows(path: Path, corners_px: Array) -> None:
    """Raise DataError where the rows vL and vR of corners (N, 4) differ by a constant, or in many: not rectified.

    Or u and v are exchanged. It is checked here because a sequence has only the mean of the rows.
    """
    whole = corners_px[np.isfinite(corners_px).all(axis=1)]
    if len(whole) < _FEWEST_ROWS:
        return
    columns_px, rows_px = whole[:, 0] - whole[:, 2], whole[:, 1] - whole[:, 3]
    apart = np.abs(rows_px) > _NO_MATCH_PX
    if abs(np.median(rows_px)) > _MOST_ROWS_APART_PX:
        apart[:] = True
    elif apart.mean() <= _MOST_NO_MATCH:
        return
    exchanged = abs(np.median(columns_px[apart])) <= _MOST_ROWS_APART_PX
    remedy = "u and v look exchanged: exchange them" if exchanged else "rectify the images, or correct the rows"
    raise DataError(
        f"{path}: in {apart.mean():.0%} of {len(whole)} sightings vL - vR is {np.median(rows_px[apart]):.1f} px and "
        f"uL - uR {np.median(columns_px[apart]):.1f} px (medians), and the rows of a rectified pair are equal; {remedy}"
    )


def camera_matrix(path: Path, key: str, K: Array) -> Array:
    """Return a camera matrix (3, 3), or raise DataError, which names the entry, where it is none of a rectified pair.

    A transposed one has its principal point in the last row; a skew would be ignored by every measurement model.
    """
    if not np.allclose(K[2], [0.0, 0.0, 1.0]):
        transposed = np.allclose(K[:, 2], [0.0, 0.0, 1.0])
        remedy = "transpose it" if transposed else "write fx, 0, cx; 0, fy, cy; 0, 0, 1"
        raise DataError(f"{path}: the last row of {key} is {K[2].tolist()}, expected 0, 0, 1; {remedy}")
    skew_px = max(abs(float(K[0, 1])), abs(float(K[1, 0])))
    if skew_px > _MOST_SKEW * abs(float(K[0, 0])):
        raise DataError(f"{path}: {key} has a skew of {skew_px:g} px, a rectified pair has none; rectify the images")
    for axis, name in enumerate(("fx", "fy")):
        if not K[axis, axis] > 0.0:
            raise DataError(f"{path}: {name} in {key} is {K[axis, axis]:g}, expected a positive number; correct {key}")
    return K


def observations(frame: IntArray, track_id: IntArray, corners_px: Array) -> Observations:
    """Build sightings from rows in any order; corners (N, 4) are uL, vL, uR, vR and v is the mean of the two rows.

    Where uR and vR are NaN the right image is missing, and v is vL; where one of them is, the sighting is damaged.
    """
    u_left_px, v_left_px, u_right_px, v_right_px = corners_px.T
    no_u, no_v = np.isnan(u_right_px), np.isnan(v_right_px)
    v_px = np.where(no_u & no_v, v_left_px, np.where(no_u, np.nan, 0.5 * (v_left_px + v_right_px)))
    uv_px = np.stack([u_left_px, u_right_px, v_px], axis=1)
    return Observations.sorted(frame, track_id, uv_px)


def rectified_observations(path: Path, frame: IntArray, track_id: IntArray, corners_px: Array) -> Observations:
    """Build sightings as :func:`observations` does; raises DataError where the pair is not rectified."""
    check_rows(path, corners_px)
    return observations(frame, track_id, corners_px)


# YAML ----------------------------------------------------------------------------------------------------------------


def read_fields(path: Path) -> Fields:
    """Return what a file holds as arrays with dotted keys: numbers (), lists of numbers (n,) or (n, m), and texts ().

    OpenCV's matrices, mappings of rows, cols and data, are given as arrays (rows, cols) too, under their own key.
    A list of anything else is a text, and what has no value is left out. Raises DataError, naming the line where there
    is one, where the file cannot be read, is no YAML, or says a thing twice.
    """
    text = read_text_input(path, "copy it again")
    if len(text) > _MOST_CHARACTERS:
        raise DataError(f"{path}: {len(text)} characters are no calibration; name another file")
    # The line is kept, so that errors name the file's own lines; JSON may be indented by tabs.
    plain = "\n".join("" if line.startswith(_DIALECT) else line for line in text.replace("\t", " ").split("\n"))
    try:
        document = yaml.load(plain, _Loader)
    except yaml.MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f"line {error.problem_mark.line + 1}: "
        raise DataError(f"{path}: {line}{error.problem or error}; correct this line, or copy the file again") from error
    except RecursionError as error:
        raise DataError(f"{path}: is nested too deeply for a calibration; name another file") from error
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        why = str(error).partition("\n")[0].partition(";")[0]
        raise DataError(f"{path}: is no YAML of a calibration ({why}); copy it again, or name another file") from error
    if not isinstance(document, dict):
        raise DataError(f"{path}: holds no 'key: value', of which a calibration is made; copy it again")
    return Fields(path, dict(flattened(document)))


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._values, self._values_in = 0, dict[int, int]()

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return the next node; raises YAMLError where aliases make a small file into a huge document, or endless."""
        before, is_alias = self._values, self.check_event(yaml.AliasEvent)
        node = super().compose_node(parent, index)
        self._values += self._values_in.get(id(node), _MOST_VALUES) if is_alias else 1
        if self._values > _MOST_VALUES:
            raise yaml.YAMLError(f"more than {_MOST_VALUES} values, with those that aliases (*name) repeat")
        self._values_in[id(node)] = self._values - before
        return node


def _mapping(loader: _Loader, node: Any) -> dict[Any, Any]:
    before: set[str] = set()
    for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
        if isinstance(key, yaml.ScalarNode):
            if key.value in before:
                raise yaml.MarkedYAMLError(problem=f"gives {key.value} a second time", problem_mark=key.start_mark)
            before.add(key.value)
    mapping: dict[Any, Any] = loader.construct_mapping(node, deep=True)
    return mapping


for _tag in ("tag:yaml.org,2002:map", "tag:yaml.org,2002:opencv-matrix"):
    _Loader.add_constructor(_tag, _mapping)


def flattened(value: Any, key: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Yield what a tree of mappings holds as arrays with dotted keys, as :func:`read_fields` gives them."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from flattened(inner, f"{key}.{name}" if key else str(name))
        data, rows, cols = _as_array(value.get("data")), value.get("rows"), value.get("cols")
        if (
            isinstance(data, np.ndarray)
            and isinstance(rows, int)
            and isinstance(cols, int)
            and data.size == rows * cols
        ):
            yield key, data.reshape(rows, cols)
        return
    array = _as_array(value)
    if array is not None:
        yield key, array


def _as_array(value: Any) -> np.ndarray | None:
    """Return a number, a list of numbers or of rows of them, or a text; None for anything else."""
    if isinstance(value, str):
        try:  # YAML takes 1e-3, without a point, for a text
            return np.array(float(value))
        except ValueError:
            return np.array(value)
    try:
        array = np.array(value, dtype=np.float64)  # which takes texts like 1e-3 for numbers too
    except (TypeError, ValueError, OverflowError):
        return np.array(str(value)) if isinstance(value, list) else None
    return array if np.isfinite(array).all() or isinstance(value, list | float) else None
