"""What is told of a path that is of no format: an archive, a trajectory, a run directory, a folder of recordings."""

from collections.abc import Callable
from itertools import islice
from pathlib import Path

from toolkit.datasets.trajectories import read_poses
from toolkit.errors import DataError, printable
from toolkit.inputs import is_regular, open_input

_ARCHIVES = {
    b"\x1f\x8b": "gzip",
    b"\x28\xb5\x2f\xfd": "zstd",
    b"BZh": "bzip2",
    b"\xfd7zXZ": "xz",
    b"PK\x03\x04": "zip",
    b"7z\xbc\xaf": "7-zip",
}
_TAR, _TAR_AT = b"ustar", 257
# So many entries of a folder are looked at, and so many recordings among them named.
_LOOKED_AT, _NAMED = 50, 3


def why_unrecognised(path: Path, recognised: Callable[[Path], bool]) -> str:
    """Return what a path of no format is, and what to do; ``recognised`` says whether a path is a recording."""
    if path.is_dir():
        if (path / "manifest.json").is_file() and (path / "metrics.json").is_file():
            return (
                "is a run directory and no recording: vislam report shows it, and --config "
                f"{printable(str(path / 'manifest.json'))} runs it again; as a recording it is of no known format"
            )
        inside = [entry.name for entry in islice(sorted(path.iterdir()), _LOOKED_AT) if recognised(entry)][:_NAMED]
        if inside:
            return f"is no recording, and holds some: name {printable(' or '.join(inside))} in it"
    elif is_regular(path):
        if path.stat().st_size == 0:
            return "the file is empty and so of no known format"
        archive = _archive(path)
        if archive is not None:
            return f"is packed ({archive}), unpack it and name what was in it: as it stands it is of no known format"
        if _is_trajectory(path):
            return "is a trajectory and no recording; name a recording and --trajectory NAME=FILE, or vislam evaluate"
    return "its content is of no known format"


def _archive(path: Path) -> str | None:
    with open_input(path) as file:
        begin = file.read(_TAR_AT + len(_TAR))
    if begin[_TAR_AT:] == _TAR:
        return "tar"
    return next((name for magic, name in _ARCHIVES.items() if begin.startswith(magic)), None)


def _is_trajectory(path: Path) -> bool:
    try:
        return len(read_poses(path)) > 0
    except DataError:
        return False
