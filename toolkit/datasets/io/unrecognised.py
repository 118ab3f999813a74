"""Messages for a path of no format: an archive, a trajectory, a run directory, a folder of recordings."""

import os
from collections.abc import Callable
from itertools import islice
from pathlib import Path

from toolkit.datasets.trajectories import read_poses
from toolkit.errors import DataError, printable
from toolkit.files.reading import is_regular, open_input

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


def why_unrecognised(path: Path, recognised: Callable[[Path], bool]) -> str:
    """Return what a path of no format is, and what to do; ``recognised`` says whether a path is a recording."""
    guess = _of_folder(path, recognised) if path.is_dir() else _of_file(path) if is_regular(path) else ""
    if guess:
        return guess
    whole = next((above for above in islice(path.absolute().parents, _ABOVE) if recognised(above)), None)
    if whole is not None:
        return (
            f"is a part of a recording: name the whole recording, {printable(str(whole))}; by itself it is of no "
            "known format"
        )
    return "its content is of no known format"


def _of_folder(path: Path, recognised: Callable[[Path], bool]) -> str:
    if (path / "manifest.json").is_file() and (path / "metrics.json").is_file():
        return (
            "is a run directory and no recording: vislam report shows it, and --config "
            f"{printable(str(path / 'manifest.json'))} runs it again; as a recording it is of no known format"
        )
    inside = [printable(str(entry.relative_to(path))) for entry in _recordings_in(path, recognised)]
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


def _recordings_in(path: Path, recognised: Callable[[Path], bool]) -> list[Path]:
    """Return a few recordings in a folder, or, where it has none, in the folders in it, and so on."""
    level = [path]
    for _ in range(_BELOW):
        entries = [entry for folder in level for entry in islice(sorted(folder.iterdir()), _LOOKED_AT)][:_LOOKED_AT]
        found = [entry for entry in entries if recognised(entry)][:_NAMED]
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
