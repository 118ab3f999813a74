"""The project's own recordings: a folder with recording.json (what it is) and recording.npz (the numbers).

The JSON is for people and holds what a person would want to read or change: name, rig, noise, conventions,
origin. The arrays are compressed and never pickled. A folder is written beside its place and moved there whole.
"""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
from msgspec import Struct

from toolkit.datasets.io.fields import check_numeric
from toolkit.datasets.io.numpy_files import opened
from toolkit.errors import DataError
from toolkit.files import documents
from toolkit.files.reading import is_regular, open_input
from toolkit.files.writing import check_replaceable, replaced_directory
from toolkit.geometry import Array
from toolkit.measurements import ImuNoise, MotionNoise, Prior, StereoRig, TwistChangeNoise, TwistNoise
from toolkit.motion_samples import ImuPairing, ImuSamples, MotionSamples, NoSamples, Pairing, TwistSamples
from toolkit.sequence import Observations, Provenance, Sequence, Truth, check_stated, why_not_sightings

_TEXT, _ARRAYS = "recording.json", "recording.npz"
_REMEDY = "copy or save the recording again"
_UNITS = "SI and px; time int64 ns; poses take the IMU frame to the world; bias and prior in [accel, gyro]"

Arrays = Mapping[str, np.ndarray[Any, Any]]


class _Motion(Struct, frozen=True):
    kind: Literal["imu", "twist", "none"]
    # Recordings saved before an IMU had a choice do not say.
    pairing: Pairing | ImuPairing | None = "mean"


class _Start(Struct, frozen=True):
    source: str


class _Truth(Struct, frozen=True):
    independent: bool


class _Text(Struct, frozen=True, kw_only=True):
    schema: Literal["vislam.recording/1"] = "vislam.recording/1"
    name: str
    provenance: Provenance
    counts: dict[str, int]
    units: str = _UNITS
    gravity_world: tuple[float, float, float]
    rig: dict[str, Any]
    motion: _Motion
    noise: dict[str, Any]
    prior: _Start | None
    truth: _Truth | None


def recognises(path: Path) -> bool:
    """Say whether the path is a recording of this format: its folder, or the JSON file in it; damaged ones too.

    Where both files stand side by side it is one, whatever became of the text.
    """
    text = _text_file(path)
    try:
        with open_input(text) as file:
            return b'"vislam.recording/' in file.read(4096) or is_regular(text.with_name(_ARRAYS))
    except (DataError, OSError):
        return False


def load(path: Path) -> Sequence:
    """Read a recording from its folder, or from the JSON file in it.

    Raises DataError where a file is missing, damaged or contradicts the other; values that are merely
    suspicious (NaN, reversed time) are left for the audit.
    """
    file = _text_file(path)
    text = documents.read(file, _Text, remedy=_REMEDY)
    with opened(file.parent / _ARRAYS) as archive:
        arrays = archive.fields().arrays
    for key, array in arrays.items():
        check_numeric(file.parent / _ARRAYS, key, array.dtype)
    try:
        sequence = _sequence(text, arrays)
    except KeyError as error:
        raise DataError(f"{file.parent}: {error.args[0]} is missing; {_REMEDY}") from error
    except (AttributeError, OverflowError, TypeError, ValueError) as error:
        raise DataError(f"{file.parent}: a field does not fit ({error}); {_REMEDY}") from error
    except DataError as error:
        raise DataError(f"{file.parent}: {error}") from error
    if text.counts != _counts(sequence):
        raise DataError(f"{file}: counts are {text.counts}, {_ARRAYS} holds {_counts(sequence)}; copy both files again")
    if wrong := why_not_sightings(sequence):
        raise DataError(f"{file.parent / _ARRAYS}: {wrong}; {_REMEDY}")
    return sequence


def save(sequence: Sequence, directory: Path) -> None:
    """Write a recording to a folder, whole or not at all; a recording that is there already is replaced.

    Raises OutputError where the folder holds anything else or cannot be written, DataError where it would not be read:
    a name, a noise or a calibration is not valid.
    """
    check_stated(sequence)
    with replaced_directory(Path(directory), _written_by_us) as partial:
        np.savez_compressed(partial / _ARRAYS, **_to_arrays(sequence))
        (partial / _TEXT).write_text(documents.to_text(_text_of(sequence)), encoding="utf-8")


def check_folder(directory: Path) -> None:
    """Raise OutputError unless a recording can be written to a folder without the loss of anything else."""
    check_replaceable(directory, _written_by_us)


def _written_by_us(directory: Path) -> frozenset[str]:
    return frozenset((_TEXT, _ARRAYS) if recognises(directory) else ())


def _text_file(path: Path) -> Path:
    path = Path(path)
    return path if path.name == _TEXT else path / _TEXT


# Writing ------------------------------------------------------------------------------------------------------


def _text_of(sequence: Sequence) -> _Text:
    motion, prior, truth = sequence.motion, sequence.prior, sequence.truth
    # A weight of the tracks stands there where it is not 1.
    rig = {name: x for name, x in _plain(sequence.rig).items() if name != "track_weight" or x != 1.0}
    return _Text(
        name=sequence.name,
        provenance=sequence.provenance,
        counts=_counts(sequence),
        gravity_world=tuple(sequence.gravity_world.tolist()),
        rig=rig,
        motion=_Motion(sequence.motion_kind, None if isinstance(motion, NoSamples) else motion.pairing),
        noise=_plain(sequence.noise),
        prior=None if prior is None else _Start(prior.source),
        truth=None if truth is None else _Truth(truth.independent),
    )


def _counts(sequence: Sequence) -> dict[str, int]:
    counts = {
        "frames": sequence.frame_count,
        "observations": len(sequence.observations),
        "motion_samples": sequence.motion.t_ns.size,
    }
    return counts if sequence.truth is None else counts | {"truth_poses": sequence.truth.t_ns.size}


def _plain(value: StereoRig | MotionNoise) -> dict[str, Any]:
    """Return the fields of a value with arrays as nested lists; Python writes floats so that they come back whole."""
    # Cached properties of a value are no fields of it.
    parts = {field.name: getattr(value, field.name) for field in fields(value)}
    return {name: x.tolist() if isinstance(x, np.ndarray) else x for name, x in parts.items()}


def _to_arrays(sequence: Sequence) -> dict[str, Any]:
    arrays: dict[str, Any] = {
        "frames_t_ns": sequence.frames_t_ns,
        "observations_frame": sequence.observations.frame,
        "observations_track_id": sequence.observations.track_id,
        "observations_uv_px": sequence.observations.uv_px,
        "motion_t_ns": sequence.motion.t_ns,
        "motion_values": sequence.motion.values,
    }
    for part, value in (("truth", sequence.truth), ("prior", sequence.prior)):
        fields = vars(value) if value is not None else {}
        arrays |= {f"{part}_{name}": x for name, x in fields.items() if isinstance(x, np.ndarray)}
    return arrays


# Reading ------------------------------------------------------------------------------------------------------


def _sequence(text: _Text, arrays: Arrays) -> Sequence:
    motion, noise = _motion(text, arrays)
    # Files of before had a noise of tracks here, which is measured now.
    rig = {name: x for name, x in text.rig.items() if name != "track_noise"}
    return Sequence(
        name=text.name,
        rig=StereoRig(**_arrays_again(rig)),
        noise=noise,
        frames_t_ns=arrays["frames_t_ns"],
        observations=Observations(
            arrays["observations_frame"], arrays["observations_track_id"], arrays["observations_uv_px"]
        ),
        motion=motion,
        provenance=text.provenance,
        prior=None if text.prior is None else _prior(text.prior, arrays),
        truth=None if text.truth is None else _truth(text.truth, arrays),
        gravity_world=np.array(text.gravity_world, dtype=float),
    )


def _arrays_again(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {name: np.array(x, dtype=float) if isinstance(x, list) else float(x) for name, x in fields.items()}


def _motion(text: _Text, arrays: Arrays) -> tuple[MotionSamples, MotionNoise]:
    t_ns, values, noise = arrays["motion_t_ns"], arrays["motion_values"], _arrays_again(text.noise)
    kind, pairing = text.motion.kind, text.motion.pairing
    width = 0 if kind == "none" else 6
    if values.shape != (t_ns.size, width):
        raise DataError(f"motion_values has shape {values.shape}, expected ({t_ns.size}, {width})")
    if kind == "imu" and pairing in get_args(ImuPairing):
        return ImuSamples(t_ns, values[:, :3], values[:, 3:], cast(ImuPairing, pairing)), ImuNoise(**noise)
    if kind == "twist" and pairing in get_args(Pairing):
        return TwistSamples(t_ns, values[:, :3], values[:, 3:], cast(Pairing, pairing)), TwistNoise(**noise)
    if kind == "none":
        return NoSamples(t_ns), TwistChangeNoise(**noise)
    raise DataError(f"motion.pairing is {pairing!r}, which {kind} samples do not have")


def _prior(start: _Start, arrays: Arrays) -> Prior:
    parts: dict[str, Array] = {name: arrays[f"prior_{name}"] for name in ("T_world_imu", "v_world", "bias", "cov")}
    prior = Prior(**parts, source=start.source)
    try:
        np.linalg.cholesky(prior.cov)
    except np.linalg.LinAlgError as error:
        raise DataError(f"prior_cov is not positive definite; {_REMEDY}") from error
    return prior


def _truth(stated: _Truth, arrays: Arrays) -> Truth:
    motion = arrays.get("truth_v_world"), arrays.get("truth_bias")
    return Truth(arrays["truth_t_ns"], arrays["truth_T_world_imu"], *motion, stated.independent)
