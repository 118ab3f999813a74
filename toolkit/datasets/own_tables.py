"""Own tables: tracks.csv, imu.csv or twist.csv, and rig.toml in a folder, with truth.tum where there is a truth.

Columns, in any order, are those of :data:`TRACKS`, :data:`IMU` and :data:`TWIST`, beside a stamp ``t`` in seconds or
``t_ns``. What they mean, and what rig.toml holds, is in docs/own-data.md. A frame is a stamp of the tracks.
:func:`read` takes the tables from anywhere, :func:`save` makes a recording of them.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.datasets import vislam_recording
from toolkit.datasets.io.fields import Fields, check_frame_count, check_rows, joined_imu, observations
from toolkit.datasets.io.tables import (
    NANOSECONDS,
    SECONDS,
    Columns,
    columns_given,
    columns_of_file,
    find_table,
    imu_columns,
)
from toolkit.datasets.io.truth import TruthRead, load_truth, with_truth
from toolkit.datasets.trajectories.formats import checked_poses
from toolkit.errors import DataError, did_you_mean
from toolkit.files.reading import is_regular, read_text_input
from toolkit.geometry import Array, IntArray
from toolkit.measurements import GRAVITY_WORLD, ImuNoise, MotionNoise, StereoRig, TwistNoise
from toolkit.models.noise import TRACKED_PIXEL_SIGMA_PX, twist_noise
from toolkit.motion_samples import ImuSamples, MotionSamples, TwistSamples
from toolkit.sequence import ONE_ROW_FOR_BOTH, Observations, Provenance, Sequence, Truth

TRACKS, ONE_ROW, TWO_ROWS = ("track_id", "uL", "uR"), ("v",), ("vL", "vR")
IMU = ("ax", "ay", "az", "gx", "gy", "gz")
TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
TRUTH = ("x", "y", "z", "qx", "qy", "qz", "qw")
_STAMPS = (SECONDS, NANOSECONDS)
_RIG = ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m", "T_imu_cam")
_OPTIONAL = ("pixel_sigma_px", "gravity_world")
_NOISE = "noise"
_IMU_NOISE = ("accel_noise_density", "gyro_noise_density", "accel_random_walk", "gyro_random_walk")
_TWIST_NOISE = ("velocity_noise_density", "gyro_noise_density", "gyro_random_walk")
_FILES = ("tracks.csv", ("imu.csv", "twist.csv"), "rig.toml", "truth.tum")

# From this share of rows on that have one sensor's values only, each has rows of its own.
_MOST_APART = 0.5

Table = str | PathLike[str] | Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Read:
    """A recording made of tables, and the columns that were not used, each with its table."""

    sequence: Sequence
    unused: tuple[str, ...]


def recognises(path: Path) -> bool:
    """Say whether the path is a folder with a rig.toml and a table of tracks or of motion."""
    tables = (_FILES[0], *_FILES[1])
    return is_regular(path / _FILES[2]) and any(find_table(path, name) is not None for name in tables)


def load(path: Path) -> Sequence:
    """Read a folder of tables; raises DataError as :func:`read`, or where one of the files is missing."""
    tracks = find_table(path, _FILES[0])
    motions = [found for name in _FILES[1] if (found := find_table(path, name)) is not None]
    if tracks is None or len(motions) != 1:
        missing = _FILES[0] if tracks is None else " or ".join(_FILES[1])
        raise DataError(f"{path}: {'missing' if tracks is None or not motions else 'both of'} {missing}")
    truth = path / _FILES[3]
    name = path.name or path.resolve().name  # of a folder named . as well
    return read(name, tracks, motions[0], path / _FILES[2], truth if is_regular(truth) else None).sequence


def save(
    directory: str | PathLike[str], *, tracks: Table, motion: Table, rig: Table, truth: Table | None = None
) -> Path:
    """Write a recording of your own measurements, which ``vislam`` and ``toolkit.compare`` read; return its folder.

    Each table is a file's path, or a mapping of column names to values (a dict of arrays, a data frame); ``rig`` is a
    TOML file or the same as nested dicts. Names and units are in docs/own-data.md. Raises DataError naming table, row
    and column of what cannot be used, OutputError where the folder holds anything else or cannot be written.
    """
    target = Path(directory)
    vislam_recording.check_folder(target)
    vislam_recording.save(read(target.name, tracks, motion, rig, truth).sequence, target)
    return target


def read(name: str, tracks: Table, motion: Table, rig: Table, truth: Table | None = None) -> Read:
    """Return the recording that tables describe, as :func:`save` takes them; raises DataError as it does."""
    sightings, measured = _columns("tracks", tracks), _columns("motion", motion)
    place, calibration = _calibration(rig)
    fields, (frames_t_ns, observations, unseen) = _fields(place, calibration), _observations(sightings)
    samples, noise, joined = _motion(measured, place, calibration.get(_NOISE, {}))
    facts = (*(() if _has_two_rows(sightings) else (ONE_ROW_FOR_BOTH,)), *unseen, *joined)
    sequence = Sequence(
        name=name,
        rig=_rig(fields, 2 if TWO_ROWS[0] in sightings else 1),
        noise=noise,
        frames_t_ns=frames_t_ns,
        observations=observations,
        motion=samples,
        provenance=Provenance("own-tables", ", ".join(str(table.what) for table in (sightings, measured)), facts),
        gravity_world=fields.constant(_OPTIONAL[1], 3) if _OPTIONAL[1] in fields else np.array(GRAVITY_WORLD),
    )
    if truth is not None:
        sequence = with_truth(sequence, *_truth(truth))
    used = {sightings: (*TRACKS, *ONE_ROW, *TWO_ROWS, *_STAMPS), measured: (*_imu(measured), *TWIST, *_STAMPS)}
    unused = (f"{table.what}: {name}" for table, names in used.items() for name in table.names if name not in names)
    return Read(sequence, tuple(unused))


def _columns(what: str, given: Table) -> Columns:
    return columns_of_file(Path(given)) if isinstance(given, str | PathLike) else columns_given(what, given)


def _has_two_rows(table: Columns) -> bool:
    return any(name in table for name in TWO_ROWS)


def _observations(table: Columns) -> tuple[IntArray, Observations, tuple[str, ...]]:
    """Return the stamps of the frames (K,), the sightings in them, and what to know of rows that are none."""
    rows = TWO_ROWS if _has_two_rows(table) else ONE_ROW
    table.require("|".join(_STAMPS), *TRACKS, *rows)
    frames_t_ns, frame = np.unique(table.stamps(), return_inverse=True)
    check_frame_count(table.what, frames_t_ns.size)
    track_id, left_px = table.whole(TRACKS[0]), table.numbers(TRACKS[1], rows[0])
    right_px = table.numbers_or_none(TRACKS[2], rows[-1])
    # A single row v is that of both images, or of the left one.
    right_px[:, 1] = np.where(np.isnan(right_px[:, 0]) & (rows == ONE_ROW), np.nan, right_px[:, 1])
    if rows == TWO_ROWS:
        # A right image that is missing may be written as -1, 0 or another number that is no place in an image; the mean
        # of the rows would hide it. Where the left image has the same value, the whole sighting is missing.
        u_right, v_right = right_px.T
        is_filler = (u_right == v_right) & (u_right <= 0.0) & (left_px[:, 0] != u_right)
        # Where only one of uR and vR is given, the right image counts as missing; the left one is used.
        right_px[is_filler | np.isnan(right_px).any(axis=1)] = np.nan
    corners_px = np.hstack([left_px, right_px])
    if rows == TWO_ROWS:
        check_rows(table.what, corners_px)
    order = np.lexsort((track_id, frame))
    twice = np.flatnonzero((np.diff(frame[order]) == 0) & (np.diff(track_id[order]) == 0))
    if twice.size:
        row = int(order[twice[0] + 1])
        raise DataError(f"{table.what}: {table.at(row)}: track {track_id[row]} is there twice in its frame; remove one")
    # As -1 or 0 in every coordinate a sighting is written that is none.
    seen = ~((corners_px == corners_px[:, :1]).all(axis=1) & (corners_px[:, 0] <= 0.0))
    count = int((~seen).sum())
    facts = (f"{count} rows of {table.what} are 0 or -1 in every coordinate: unseen, and left out",) if count else ()
    return frames_t_ns, observations(frame[seen], track_id[seen], corners_px[seen]), facts


def _motion(
    table: Columns, place: Path, noise: Mapping[str, Any]
) -> tuple[MotionSamples, MotionNoise, tuple[str, ...]]:
    """Return the samples, of an IMU or of body twists, as the columns say, their noise, and what to know of them."""
    imu = _imu(table)
    of_twist, of_imu = (len(set(columns) & set(table.names)) for columns in (TWIST, imu))
    if of_twist == of_imu:
        lacks = f"{', '.join(IMU)} of an IMU, or {', '.join(TWIST)} of a twist"
        raise DataError(f"{table.what}: missing column {lacks}; it has {', '.join(table.names)}")
    is_twist = of_twist > of_imu
    columns, known = (TWIST, _TWIST_NOISE) if is_twist else (imu, _IMU_NOISE)
    table.require("|".join(_STAMPS), *columns)
    _check_known(place, f"{_NOISE}.", noise, known)
    t_ns = table.stamps()
    if is_twist:
        values = table.numbers(*columns)
        return TwistSamples(t_ns, values[:, :3], values[:, 3:]), _twist_noise(place, t_ns, values, noise), ()
    missing = [key for key in known if key not in noise]
    if missing:
        lacking = ", ".join(f"{_NOISE}.{key}" for key in missing)
        raise DataError(f"{place}: missing {lacking}; an IMU's data sheet has them")
    fields = _fields(place, noise)
    samples, facts = _imu_samples(table, t_ns, columns)
    return samples, ImuNoise(**{key: fields.positive(key) for key in known}), facts


def _imu(table: Columns) -> tuple[str, ...]:
    of_twist = set(table.names) >= set(TWIST)
    return IMU if of_twist else imu_columns(table.names) or IMU


def _imu_samples(table: Columns, t_ns: IntArray, columns: tuple[str, ...]) -> tuple[ImuSamples, tuple[str, ...]]:
    """Return the samples of an IMU; where both sensors have rows of their own, at the gyro's stamps."""
    values = table.numbers_or_none(*columns)
    of_accel, of_gyro = (np.isfinite(values[:, part]).all(axis=1) for part in (slice(0, 3), slice(3, 6)))
    empty = np.isnan(values[:, :3]).all(axis=1) | np.isnan(values[:, 3:]).all(axis=1)
    apart = (of_accel ^ of_gyro) & empty
    if apart.sum() < _MOST_APART * len(values) or not (of_accel.sum() > 1 and of_gyro.any()):
        values = table.numbers(*columns)  # names what is empty
        return ImuSamples(t_ns, values[:, :3], values[:, 3:]), ()
    joined = joined_imu((t_ns[of_gyro], values[of_gyro, 3:]), (t_ns[of_accel], values[of_accel, :3]))
    if joined is None:
        raise DataError(f"{table.what}: accelerometer and gyro have no time in common; correct the stamps of one")
    counts = f"{of_accel.sum()} samples of the accelerometer are interpolated at the {joined.t_ns.size} of the gyro"
    return joined, (f"{counts}: each has rows of its own",)


def _twist_noise(place: Path, t_ns: IntArray, values: Array, noise: Mapping[str, Any]) -> TwistNoise:
    """Return the noise stated, one number or one an axis; what is not stated is estimated from the scatter."""
    fields, stated = _fields(place, noise), dict(vars(twist_noise(t_ns, values[:, :3], values[:, 3:])))
    for key in noise:
        stated[key] = np.full(3, fields.positive(key)) if fields.vector(key).size == 1 else fields.constant(key, 3)
    return TwistNoise(**stated)


def _calibration(rig: Table) -> tuple[Path, Mapping[str, Any]]:
    place = Path(rig) if isinstance(rig, str | PathLike) else Path("rig")
    if isinstance(rig, Mapping):
        values: Mapping[str, Any] = rig
    else:
        try:
            values = tomllib.loads(read_text_input(place, "the calibration is TOML"))
        except (tomllib.TOMLDecodeError, RecursionError) as error:
            raise DataError(f"{place}: is not TOML ({error})") from error
    _check_known(place, "", values, (*_RIG, *_OPTIONAL, _NOISE))
    if not isinstance(values.get(_NOISE, {}), Mapping):
        raise DataError(f"{place}: {_NOISE} is not a table; write [{_NOISE}] above its densities")
    return place, values


def _check_known(place: Path, prefix: str, given: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for key in given:
        if key not in known:
            # Rather a name that is not there yet: f_px stands for a missing fx_px, beside fy_px.
            missing = [name for name in known if name not in given]
            near = did_you_mean(str(key), missing) or did_you_mean(str(key), known)
            raise DataError(f"{place}: there is no {prefix}{key}{near}; remove or rename it")


def _fields(place: Path, values: Mapping[str, Any]) -> Fields:
    return Fields(place, {key: _array(value) for key, value in values.items() if key != _NOISE})


def _array(value: Any) -> Any:
    """Return what a key of the calibration holds as an array; a whole number beyond any integer's as the infinite."""
    try:
        array = np.asarray(value)
        return array.astype(np.float64) if array.dtype == object else array
    except OverflowError:
        return np.asarray(np.inf)
    except (TypeError, ValueError):  # rows of different lengths, values that are no numbers
        return np.asarray(str(value))


def _rig(fields: Fields, rows_averaged: int) -> StereoRig:
    fields.require(*_RIG)
    fx_px, fy_px, cx_px, cy_px, baseline_m = (
        fields.positive(key) if key[0] in "fb" else fields.number(key) for key in _RIG[:-1]
    )
    sigma_px = fields.positive(_OPTIONAL[0]) if _OPTIONAL[0] in fields else TRACKED_PIXEL_SIGMA_PX
    cov_uv_px2 = sigma_px**2 * np.diag([1.0, 1.0, 1.0 / rows_averaged])
    return StereoRig(fx_px, fy_px, cx_px, cy_px, baseline_m, fields.rigid(_RIG[-1]), cov_uv_px2)


def _truth(given: Table) -> TruthRead:
    if isinstance(given, str | PathLike):
        return load_truth(Path(given))
    table = columns_given("truth", given)
    table.require("|".join(_STAMPS), *TRUTH)
    t_ns = table.stamps()
    return TruthRead(Truth(t_ns, checked_poses(table.what, list(range(t_ns.size)), t_ns, table.numbers(*TRUTH))), ())
