"""The project's own recordings: a folder with recording.json (what it is) and recording.npz (the numbers).

The JSON is for people and holds what a person would want to read or change: name, rig, noise, conventions,
origin. The arrays are compressed and never pickled. A folder is written beside its place and moved there whole.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from toolkit.datasets.io.fields import check_numeric
from toolkit.datasets.io.numpy_files import opened
from toolkit.errors import DataError
from toolkit.files.reading import is_regular, open_input, read_text_input
from toolkit.files.writing import check_replaceable, replaced_directory
from toolkit.geometry import Array
from toolkit.measurements import ImuNoise, MotionNoise, Prior, StereoRig, TwistChangeNoise, TwistNoise
from toolkit.motion_samples import ImuPairing, ImuSamples, MotionSamples, NoSamples, Pairing, TwistSamples
from toolkit.sequence import Observations, Provenance, Sequence, Truth, why_not_sightings

SCHEMA = "vislam.recording/1"
_TEXT, _ARRAYS = "recording.json", "recording.npz"

Arrays = Mapping[str, np.ndarray[Any, Any]]
Text = dict[str, Any]


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
    text_file = _text_file(path)
    text, arrays = _read_text(text_file), _read_arrays(text_file.parent / _ARRAYS)
    try:
        sequence = _sequence(text, arrays)
    except KeyError as error:
        raise DataError(f"{text_file.parent}: {error.args[0]} is missing; save the recording again") from error
    except (AttributeError, OverflowError, TypeError, ValueError) as error:
        raise DataError(f"{text_file.parent}: a field does not fit ({error}); save the recording again") from error
    except DataError as error:
        raise DataError(f"{text_file.parent}: {error}") from error
    _check_whole(sequence, text, text_file)
    return sequence


def save(sequence: Sequence, directory: Path) -> None:
    """Write a recording to a folder, whole or not at all; a recording that is there already is replaced.

    Raises OutputError where the folder holds anything else or cannot be written.
    """
    with replaced_directory(Path(directory), _written_by_us) as partial:
        np.savez_compressed(partial / _ARRAYS, **_to_arrays(sequence))
        text = json.dumps(_to_text(sequence), indent=2, ensure_ascii=False)
        (partial / _TEXT).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def check_folder(directory: Path) -> None:
    """Raise OutputError unless a recording can be written to a folder without the loss of anything else."""
    check_replaceable(directory, _written_by_us)


def _written_by_us(directory: Path) -> frozenset[str]:
    return frozenset((_TEXT, _ARRAYS) if recognises(directory) else ())


def _text_file(path: Path) -> Path:
    path = Path(path)
    return path if path.name == _TEXT else path / _TEXT


# Writing ------------------------------------------------------------------------------------------------------


def _to_text(sequence: Sequence) -> Text:
    motion, prior, truth = sequence.motion, sequence.prior, sequence.truth
    return {
        "schema": SCHEMA,
        "name": sequence.name,
        "provenance": asdict(sequence.provenance),
        "counts": _counts(sequence),
        "units": "SI and px; time int64 ns; poses take the IMU frame to the world; bias and prior in [accel, gyro]",
        "gravity_world": sequence.gravity_world.tolist(),
        "rig": _rig_to_text(sequence.rig),
        "motion": {
            "kind": sequence.motion_kind,
            "pairing": None if isinstance(motion, NoSamples) else motion.pairing,
        },
        "noise": _plain(sequence.noise),
        "prior": None if prior is None else {"source": prior.source},
        "truth": None if truth is None else {"independent": truth.independent},
    }


def _counts(sequence: Sequence) -> dict[str, int]:
    counts = {
        "frames": sequence.frame_count,
        "observations": len(sequence.observations),
        "motion_samples": sequence.motion.t_ns.size,
    }
    return counts if sequence.truth is None else counts | {"truth_poses": sequence.truth.t_ns.size}


def _rig_to_text(rig: StereoRig) -> Text:
    """Return a rig, with the weight of its tracks where it is not 1."""
    return {name: x for name, x in _plain(rig).items() if name != "track_weight" or x != 1.0}


def _plain(value: StereoRig | MotionNoise) -> Text:
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


def _read_text(file: Path) -> Text:
    try:
        text = json.loads(read_text_input(file, "it is not JSON; copy or save the recording again"))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{file} is not JSON ({error}); copy or save the recording again") from error
    if not isinstance(text, dict) or text.get("schema") != SCHEMA:
        schema = text.get("schema") if isinstance(text, dict) else None
        raise DataError(f"{file}: the schema is {schema!r}, this version reads {SCHEMA!r}; save it with this version")
    return cast(Text, text)


def _read_arrays(file: Path) -> Arrays:
    with opened(file) as archive:
        arrays = archive.fields().arrays
    for key, array in arrays.items():
        check_numeric(file, key, array.dtype)
    return arrays


def _sequence(text: Text, arrays: Arrays) -> Sequence:
    motion, noise = _motion(text, arrays)
    return Sequence(
        name=str(text["name"]),
        rig=_rig(text["rig"]),
        noise=noise,
        frames_t_ns=arrays["frames_t_ns"],
        observations=Observations(
            arrays["observations_frame"], arrays["observations_track_id"], arrays["observations_uv_px"]
        ),
        motion=motion,
        provenance=_provenance(text["provenance"]),
        prior=_prior(text, arrays),
        truth=_truth(text, arrays),
        gravity_world=np.array(text["gravity_world"], dtype=float),
    )


def _rig(fields: Text) -> StereoRig:
    # Files of before had a noise of tracks here, which is measured now.
    return StereoRig(**_arrays_again({name: x for name, x in fields.items() if name != "track_noise"}))


def _arrays_again(fields: Text) -> Text:
    return {name: np.array(x, dtype=float) if isinstance(x, list) else float(x) for name, x in fields.items()}


def _motion(text: Text, arrays: Arrays) -> tuple[MotionSamples, MotionNoise]:
    t_ns, values = arrays["motion_t_ns"], arrays["motion_values"]
    kind, noise = text["motion"]["kind"], _arrays_again(text["noise"])
    width = 0 if kind == "none" else 6
    if values.shape != (t_ns.size, width):
        raise DataError(f"motion_values has shape {values.shape}, expected ({t_ns.size}, {width})")
    if kind == "none":
        return NoSamples(t_ns), TwistChangeNoise(**noise)
    if kind == "imu":
        imu_noise = ImuNoise(**noise)
        # Recordings saved before an IMU had a choice do not say.
        pairing = _one_of(text["motion"].get("pairing", "mean"), get_args(ImuPairing))
        return ImuSamples(t_ns, values[:, :3], values[:, 3:], pairing), imu_noise
    if kind == "twist":
        pairing = _one_of(text["motion"]["pairing"], get_args(Pairing))
        return TwistSamples(t_ns, values[:, :3], values[:, 3:], pairing), TwistNoise(**noise)
    raise DataError(f"motion.kind is {kind!r}, expected imu, twist or none")


def _one_of(pairing: Any, known: tuple[Any, ...]) -> Any:
    if pairing not in known:
        raise DataError(f"motion.pairing is {pairing!r}, expected one of {', '.join(known)}")
    return pairing


def _provenance(fields: Text) -> Provenance:
    texts = (fields["format"], fields["source"], *fields["facts"])
    if not all(isinstance(text, str) for text in texts):
        raise DataError("provenance contains a value that is not text; save the recording again")
    return Provenance(texts[0], texts[1], texts[2:])


def _prior(text: Text, arrays: Arrays) -> Prior | None:
    if text["prior"] is None:
        return None
    parts: dict[str, Array] = {name: arrays[f"prior_{name}"] for name in ("T_world_imu", "v_world", "bias", "cov")}
    prior = Prior(**parts, source=text["prior"]["source"])
    try:
        np.linalg.cholesky(prior.cov)
    except np.linalg.LinAlgError as error:
        raise DataError("prior_cov is not positive definite; save the recording again") from error
    return prior


def _truth(text: Text, arrays: Arrays) -> Truth | None:
    if text["truth"] is None:
        return None
    return Truth(
        arrays["truth_t_ns"],
        arrays["truth_T_world_imu"],
        arrays.get("truth_v_world"),
        arrays.get("truth_bias"),
        text["truth"]["independent"],
    )


def _check_whole(sequence: Sequence, text: Text, file: Path) -> None:
    """Raise DataError where the two files are not of one recording or the observations point to no frame."""
    if text.get("counts") != _counts(sequence):
        raise DataError(
            f"{file}: counts are {text.get('counts')}, {_ARRAYS} holds {_counts(sequence)}; copy both files again"
        )
    wrong = why_not_sightings(sequence)
    if wrong:
        raise DataError(f"{file.parent / _ARRAYS}: {wrong}; copy it again, or save the recording again")
