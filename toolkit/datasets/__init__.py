"""Reads recordings. Every module in this folder is a format or has built-in sequences, and is found by being here.

A module is a :class:`RecordingFormat`, or offers :class:`BuiltIns`, or both; a format whose recordings may hold
estimates of other systems is :class:`BringsReferences` too, one that simulates a part of them is
:class:`DrawnFromASeed`, one that has tracks made of images is :class:`HasImages`. One of named topics, of which
``frontend.topics`` says which is what, has the constant ``HAS_TOPICS``.
It imports nothing heavy at its top, because all modules are imported to recognise a path.
Read ``course_npz`` first, then the others; parts they share are in ``io``, formats of trajectories in ``trajectories``.

A package of another distribution is found where it is announced under the entry-point group ``toolkit.datasets``.
"""

import os
import re
from collections.abc import Callable, Mapping
from functools import cache
from itertools import islice
from numbers import Real
from pathlib import Path
from types import ModuleType
from typing import NamedTuple, Protocol, TypeGuard, runtime_checkable

import numpy as np

from toolkit.datasets.trajectories import read_poses
from toolkit.discovery import FoundModule, MissingDependency, announced, modules_in
from toolkit.errors import DataError, ExtensionError, did_you_mean, printable, type_of
from toolkit.estimate import Trajectory
from toolkit.files.reading import is_regular, open_input, unreadable
from toolkit.frontend import ImageRecording
from toolkit.measurements import StereoRig
from toolkit.progress import SILENT, Progress
from toolkit.sequence import Observations, Provenance, Sequence, check_stated, why_not_sightings
from toolkit.settings import DEFAULTS, Frontend, Tracks

# Names of a folder that are listed in the message for a name that is not in it.
_SHOWN = 8
# Names that are compared with the requested one: a folder of images may have a hundred thousand.
_COMPARED = 1000

_ADDRESS = re.compile(r"\w+://")
# What unpacks a file, by how it begins.
_UNPACKED_BY = {
    b"\x1f\x8b": "gunzip",
    b"\x28\xb5\x2f\xfd": "unzstd",
    b"BZh": "bunzip2",
    b"\xfd7zXZ": "unxz",
    b"PK\x03\x04": "unzip",
    b"7z\xbc\xaf": "7z x",
}
# Archives of NumPy arrays, which need not be unpacked.
_ARRAYS = ".npz"
_TAR, _TAR_AT = b"ustar", 257
# Entries of a folder that are examined, and recordings among them that are named.
_LOOKED_AT, _NAMED = 50, 3
# Levels below and above a path that are searched: users name dataset/sequences, or the folder of one camera.
_BELOW, _ABOVE = 3, 4

ENTRY_POINT_GROUP = "toolkit.datasets"
Maker = Callable[[int], Sequence]


@runtime_checkable
class RecordingFormat(Protocol):
    """A module that reads one kind of recording; the first line of its docstring is its summary."""

    def recognises(self, path: Path) -> bool:
        """Return whether the path is of this format, from the beginning of its content and never from its name alone.

        A damaged recording of the format should still be recognised, so that ``load`` can report what is wrong.
        """

    def load(self, path: Path) -> Sequence:
        """Read the recording, its faults included; raise DataError where it cannot be read at all."""


@runtime_checkable
class BringsReferences(Protocol):
    """A format whose recordings may hold what other systems estimated from them."""

    def references(self, path: Path) -> Mapping[str, Trajectory]:
        """Read those estimates, by the name a reader sees: the system's, then its file's in brackets.

        Return none where the recording holds none; raise DataError where one cannot be read.
        """


@runtime_checkable
class DrawnFromASeed(Protocol):
    """A format that completes its recordings by simulation, another under every seed."""

    def load_with_seed(self, path: Path, seed: int) -> Sequence:
        """Read the recording and draw the simulated part from the seed; ``load`` does so with seed 0."""


@runtime_checkable
class HasImages(Protocol):
    """A format whose recordings may hold images, of which tracks are made (:mod:`toolkit.frontend`)."""

    def uses_images(self, path: Path, tracks: Tracks) -> bool:
        """Say whether the tracks are made of images where these are asked for."""

    def load_from_images(self, path: Path, frontend: Frontend, progress: Progress) -> Sequence:
        """Read the recording with tracks made of its images; raise DataError where it cannot be."""

    def images_of(self, path: Path, frontend: Frontend) -> ImageRecording:
        """Return the image pairs that tracks are made of and their cameras; raise DataError where there are none."""


@runtime_checkable
class BuiltIns(Protocol):
    """A module whose sequences need no path: name -> maker, which takes a seed (real data ignore it)."""

    BUILT_IN: Mapping[str, Maker]


class _Found(NamedTuple):
    """The modules by the name a user reads, and why others cannot be used, by name."""

    modules: Mapping[str, ModuleType]
    missing: Mapping[str, str]


def modules() -> dict[str, FoundModule]:
    return {one.name: one for one in _modules()}


def _modules() -> tuple[FoundModule, ...]:
    return (*modules_in(__name__, __path__), *announced(ENTRY_POINT_GROUP))


@cache
def _found() -> _Found:
    modules: dict[str, ModuleType] = {}
    missing: dict[str, str] = {}
    for found in _modules():
        if found.name in modules:
            raise ExtensionError(f"two dataset modules are called {found.name}, the second is {found.path}; rename one")
        try:
            module = found.load()
        except MissingDependency as dependency:
            missing[found.name] = str(dependency)
            continue
        if not isinstance(module, RecordingFormat | BuiltIns):
            raise ExtensionError(f"{found.path}: defines neither recognises(path) and load(path) nor BUILT_IN")
        modules[found.name] = module
    _check_built_ins_differ(modules)
    return _Found(modules, missing)


def _check_built_ins_differ(modules: Mapping[str, ModuleType]) -> None:
    offered_by: dict[str, object] = {}
    for module in (module for module in modules.values() if isinstance(module, BuiltIns)):
        file = getattr(module, "__file__", module)
        for name in module.BUILT_IN:
            if name in offered_by:
                raise ExtensionError(f"{offered_by[name]} and {file}: both offer the sequence {name}; rename one")
            offered_by[name] = file


def _readers() -> dict[str, RecordingFormat]:
    return {name: module for name, module in _found().modules.items() if isinstance(module, RecordingFormat)}


def formats() -> dict[str, str]:
    """Return the summary of every format a path can have, by name."""
    return {name: (_found().modules[name].__doc__ or "").partition("\n")[0] for name in _readers()}


def unavailable() -> dict[str, str]:
    return dict(_found().missing)


def built_ins() -> dict[str, Maker]:
    offers = [module for module in _found().modules.values() if isinstance(module, BuiltIns)]
    return {name: make for offer in offers for name, make in sorted(offer.BUILT_IN.items())}


def built_in_names() -> tuple[str, ...]:
    return tuple(built_ins())


def load_sequence(
    source: str | Path, seed: int = 0, frontend: Frontend = DEFAULTS.frontend, progress: Progress = SILENT
) -> Sequence:
    """Load a built-in sequence by its name, made with the seed, or a recording by its path.

    The seed is also that of what a format simulates; whatever was recorded is the same under every seed. ``frontend``
    says whether and how tracks are made of images. Raises DataError where the source is neither, no format recognises
    it, or it cannot be read.
    """
    if not isinstance(source, str | Path):
        raise DataError(f"a SEQUENCE is a path or a built-in name, not {source!r}")
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise DataError(f"{source}: seed is {seed!r}, expected a whole number from 0 on")
    source = str(source)
    if is_built_in(source):
        check_built_in(source, frontend)
        return told_of_both(built_ins()[source](seed), source)
    path = Path(source).expanduser()
    reader = _reader_of(path, source)
    _check_topics(source, reader, frontend)
    # The checks report bad values of a file, so that NumPy's warnings add nothing.
    with np.errstate(all="ignore"):
        if _of_images(reader, path, frontend):
            sequence = reader.load_from_images(path, frontend, progress)
        elif isinstance(reader, DrawnFromASeed):
            sequence = reader.load_with_seed(path, seed)
        else:
            sequence = reader.load(path)
        if not isinstance(sequence, Sequence):
            file = getattr(reader, "__file__", reader)
            raise ExtensionError(f"{source}: load in {file} returned {type_of(sequence)}; it must return a Sequence")
        _check_types(sequence)
        check_stated(sequence)
    return told_of_both(sequence, source)


def is_built_in(source: str) -> bool:
    """Say whether a source is a built-in sequence: by its name, unless a recording of that name is here."""
    if source not in built_ins():
        return False
    path = Path(source)
    return not (path.exists() and _is_recording(path))


def _is_recording(path: Path) -> bool:
    return any(reader.recognises(path) for reader in _readers().values())


def told_of_both(sequence: Sequence, source: str) -> Sequence:
    """Return a sequence whose facts say what else is called as its source: a built-in one, or a file or folder here."""
    if source not in built_ins() or not Path(source).exists():
        return sequence
    other = f"the built-in sequence {source} is read: what is called so here is no recording"
    if not is_built_in(source):
        other = f"the recording here is read, and not the built-in sequence {source}, which is read elsewhere"
    return sequence.with_facts(other)


def check_built_in(source: str, frontend: Frontend) -> None:
    """Raise DataError where images or topics of a built-in sequence are asked for: it has neither."""
    _check_topics(source, None, frontend)
    if frontend.tracks == "images":
        raise DataError(f"{source}: a built-in sequence has tracks and no images; leave --tracks images out")


def _check_topics(source: str, reader: RecordingFormat | None, frontend: Frontend) -> None:
    if frontend.topics is not None and not getattr(reader, "HAS_TOPICS", False):
        raise DataError(f"{source}: it has no topics, a bag has; leave --topics out, or compare it by itself")


def _of_images(reader: RecordingFormat, path: Path, frontend: Frontend) -> TypeGuard[HasImages]:
    """Say whether a recording's tracks are made of its images; raise DataError where they must be and it has none."""
    if not isinstance(reader, HasImages):
        if frontend.tracks == "images":
            raise DataError(f"{path}: its format has tracks and no images; leave --tracks images out")
        return False
    return reader.uses_images(path, frontend.tracks)


def load_images(source: str, frontend: Frontend = DEFAULTS.frontend) -> ImageRecording:
    """Return the image pairs of a recording and their cameras; of a bag, from the topics that ``frontend`` names.

    Raises DataError where the source is no recording with images, or they cannot be used.
    """
    path, reader = _found_at(source)
    if not isinstance(reader, HasImages):
        raise DataError(f"{source}: holds no images; name a bag, or a folder as EuRoC's or KITTI's")
    _check_topics(source, reader, frontend)
    return reader.images_of(path, frontend)


def is_drawn_from_a_seed(source: str, frontend: Frontend = DEFAULTS.frontend) -> bool:
    """Say whether a source is another recording under another seed, as simulations are.

    Raises DataError where it is no source at all.
    """
    path, reader = _found_at(source)
    if reader is None:
        return _differs_by_seed(built_ins()[source])
    return isinstance(reader, DrawnFromASeed) and not _of_images(reader, path, frontend)


@cache
def _differs_by_seed(make: Maker) -> bool:
    return make(0).content_hash() != make(1).content_hash()


def load_references(source: str) -> dict[str, Trajectory]:
    """Load what other systems estimated from a recording, by name; none where it holds none, or is built in.

    Raises DataError as :func:`load_sequence` does, or where such an estimate cannot be read.
    """
    path, reader = _found_at(source)
    with np.errstate(all="ignore"):
        return dict(reader.references(path)) if isinstance(reader, BringsReferences) else {}


def _found_at(source: str) -> tuple[Path, RecordingFormat | None]:
    """Return the path of a source and the module that reads it, None of a built-in one; raise DataError where none."""
    path = Path(source).expanduser()
    return path, None if is_built_in(source) else _reader_of(path, source)


def _reader_of(path: Path, source: str) -> RecordingFormat:
    _check_readable(path, source)
    try:
        for reader in _readers().values():
            if reader.recognises(path):
                return reader
    except OSError as error:  # a file that can be opened and not read, as on a failing disk
        raise DataError(unreadable(path, error)) from error
    what = _why_unrecognised(path)
    lacking = "".join(f"; {name} is unavailable: {why}" for name, why in unavailable().items())
    raise DataError(f"{source}: {what}; there are {', '.join(formats())}{lacking}")


def _check_readable(path: Path, source: str) -> None:
    if not source:
        raise DataError(f"a SEQUENCE has no name: give a path, or one of {', '.join(built_in_names())}")
    try:
        if path.is_dir():
            next(path.iterdir(), None)
        else:
            open_input(path).close()
    except OSError as error:
        raise DataError(unreadable(path, error)) from error
    except DataError as error:
        if not isinstance(error.__cause__, FileNotFoundError):
            raise
        raise DataError(f"{source}: no such file or directory{_nearest_source(path, source)}") from error


def _nearest_source(path: Path, source: str) -> str:
    if _ADDRESS.match(str(source)):
        return "; it is an address: download it and name the file"
    if path.parent != Path():
        if not path.parent.is_dir():
            return f"; there is no folder {path.parent}"
        try:
            beside = [inside.name for inside in islice(path.parent.iterdir(), _COMPARED)]
        except OSError:  # a folder that may be entered and not listed
            return "; check the path"
        shown = sorted(beside, key=lambda name: (name.startswith("."), name))[:_SHOWN]
        some = f"{', '.join(shown)}{' and more' if len(beside) > _SHOWN else ''}" if shown else "nothing in it"
        return did_you_mean(path.name, beside) or f"; {path.parent} has {some}"
    names = built_in_names()
    return did_you_mean(source, names) or f", and the built-in sequences are {', '.join(names)}"


def _check_types(sequence: Sequence) -> None:
    whose = sequence.name if isinstance(sequence.name, str) else "a recording"
    parts = {"name": str, "rig": StereoRig, "observations": Observations, "provenance": Provenance}
    found = {part: (getattr(sequence, part), kind) for part, kind in parts.items()}
    if isinstance(sequence.rig, StereoRig):
        of_rig = ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m")
        found |= {f"rig.{part}": (getattr(sequence.rig, part), Real) for part in of_rig}
    for part, (value, kind) in found.items():
        if not isinstance(value, kind):
            raise DataError(f"{whose}: its {part} is of type {type(value).__name__}, expected {kind.__name__}")
    for vector in getattr(sequence.motion, "VECTORS", ()):
        if len(getattr(sequence.motion, vector)) != sequence.motion.t_ns.size:
            rows, stamps = len(getattr(sequence.motion, vector)), sequence.motion.t_ns.size
            raise DataError(f"{whose}: motion.{vector} has {rows} rows, and there are {stamps} stamps")
    if why := why_not_sightings(sequence):
        raise DataError(f"{whose}: {why}")


# A path of no format: an archive, a trajectory, a run directory, a folder of recordings -------------------------------


def _why_unrecognised(path: Path) -> str:
    guess = _of_folder(path) if path.is_dir() else _of_file(path) if is_regular(path) else ""
    if guess:
        return guess
    whole = next((above for above in islice(path.absolute().parents, _ABOVE) if _is_recording(above)), None)
    if whole is not None:
        return (
            f"is a part of a recording: name the whole recording, {printable(str(whole))}; by itself it is of no "
            "known format"
        )
    return "its content is of no known format"


def _of_folder(path: Path) -> str:
    if (path / "manifest.json").is_file() and (path / "metrics.json").is_file():
        return (
            "is a run directory and no recording: vislam report shows it, and --config "
            f"{printable(str(path / 'manifest.json'))} runs it again; as a recording it is of no known format"
        )
    inside = [printable(str(entry.relative_to(path))) for entry in _recordings_in(path)]
    if not inside and (packed := _packed_in(path)):
        return packed
    return f"is not a recording, but contains some: name {' or '.join(inside)} in it" if inside else ""


def _packed_in(folder: Path) -> str:
    files = [entry for entry in islice(sorted(folder.iterdir()), _LOOKED_AT) if is_regular(entry)]
    packed = [f"{file.name} with {how}" for file in files if (how := _unpacked_by(file))]
    if not packed:
        return ""
    named = printable(", ".join(packed[:_NAMED]))
    of_rosbag2 = any(ending in name for name in packed for ending in (".db3", ".mcap"))
    lost = " (metadata.yaml is missing; a single one is read without it)" if of_rosbag2 else ""
    return f"holds packed files: unpack {named}{lost} and remove what was packed; as it stands it is of no known format"


def _of_file(path: Path) -> str:
    if path.stat().st_size == 0:
        return "the file is empty and so of no known format"
    if how := _unpacked_by(path):
        return f"is packed, unpack it with {how} and name what was in it: as it stands it is of no known format"
    try:
        read_poses(path)
    except DataError:
        return ""
    return "is a trajectory and no recording; name a recording and --trajectory NAME=FILE, or vislam evaluate"


def _recordings_in(path: Path) -> list[Path]:
    """Return a few recordings in a folder, or, where it has none, in the folders in it, and so on."""
    level = [path]
    for _ in range(_BELOW):
        entries = [entry for folder in level for entry in islice(sorted(folder.iterdir()), _LOOKED_AT)][:_LOOKED_AT]
        found = [entry for entry in entries if _is_recording(entry)][:_NAMED]
        if found:
            return found
        level = [entry for entry in entries if entry.is_dir() and os.access(entry, os.R_OK | os.X_OK)]
    return []


def _unpacked_by(path: Path) -> str:
    with open_input(path) as file:
        begin = file.read(_TAR_AT + len(_TAR))
    if path.suffix == _ARRAYS:
        return ""
    if begin[_TAR_AT:] == _TAR:
        return "tar xf"
    return next((how for magic, how in _UNPACKED_BY.items() if begin.startswith(magic)), "")
