"""Finds trajectory files by system, sequence and run, and the truth of each sequence.

A folder of a system has, for each sequence, one file (``V1_01.tum``) or a folder of repeated runs
(``V1_01/run-1.tum`` ...).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from toolkit.datasets.io.bag_reader import place_in_bag
from toolkit.errors import DataError, printable
from toolkit.files.reading import unreadable

SUFFIXES = (".tum", ".txt", ".csv")
_ZIPPED = ".gz"


@dataclass(frozen=True)
class Item:
    """One run of a system on a sequence: a file, or None where the file is missing."""

    system: str
    sequence: str
    run: str
    path: Path | None


class Gathered(NamedTuple):
    """The truths by sequence, every run by system and sequence, and what was left out, in words."""

    truths: Mapping[str, Path]
    items: tuple[Item, ...]
    notes: tuple[str, ...]


# The files of each sequence, by system.
_Found = dict[str, dict[str, tuple[Path, ...]]]


def gather(truth: Path, given: Iterable[str], runs: int | None = None) -> Gathered:
    """Find the runs that arguments name: NAME=FILE, FILE, NAME=FOLDER, or FOLDER with a folder for each system.

    With a truth that is a file there is one sequence, and the files of NAME=FOLDER are runs of it; with a folder of
    truths SEQUENCE.tum, folders of systems hold SEQUENCE.tum or SEQUENCE/RUN.tum. A system without a sequence that
    another system has gets items without a file, as many as it has runs of other sequences; a system with fewer than
    ``runs`` runs of a sequence gets the missing ones likewise. Raises DataError where an argument names nothing, or
    nothing that has a truth.
    """
    truths = {_name(truth): truth} if truth.is_file() else truths_in(truth)
    found = _of_one_sequence(truth, given) if truth.is_file() else _of_folders(given)
    known = {sequence for sequences in found.values() for sequence in sequences}
    scored = [sequence for sequence in truths if sequence in known]
    if not scored:
        there = ", ".join(sorted(known))
        raise DataError(f"{truth}: it has the truth of {', '.join(truths)}, and the trajectories are of {there}")
    items = [
        item for name, files in found.items() for sequence in scored for item in _items(name, sequence, files, runs)
    ]
    notes = (*_left_out(truths, known), *(() if runs else _fewer_runs(found, scored)))
    return Gathered({s: truths[s] for s in scored}, tuple(items), notes)


def _fewer_runs(found: _Found, scored: Iterable[str]) -> Iterable[str]:
    """Yield which systems have fewer runs of one sequence than of another: a run that crashed may have left no file."""
    for name, files in found.items():
        counts = {sequence: len(files[sequence]) for sequence in scored if sequence in files}
        most = max(counts.values(), default=0)
        fewer = [f"{count} of {sequence}" for sequence, count in counts.items() if count < most]
        if fewer:
            there = f"{name} has {', '.join(fewer)} and {most} runs elsewhere"
            yield f"{there}; --runs {most} counts those missing as failed"


def _items(system: str, sequence: str, files: Mapping[str, tuple[Path, ...]], runs: int | None) -> list[Item]:
    """Return the runs there are, and those that are missing: of a sequence without any, as many as of another one."""
    there = [Item(system, sequence, _name(file), file) for file in files.get(sequence, ())]
    wanted = runs or (0 if there else max(map(len, files.values())))
    return there + [Item(system, sequence, f"missing {n + 1}", None) for n in range(wanted - len(there))]


def _of_one_sequence(truth: Path, given: Iterable[str]) -> _Found:
    found: _Found = {}
    for word in given:
        name, path = _named(word)
        if path.is_dir() and name is None:
            raise DataError(
                f"{path}: a folder of one system's runs needs its name, NAME={path}; or give a folder of truths"
            )
        place = place_in_bag(path)
        if not (path if place is None else place[0]).exists():
            raise DataError(f"{path}: there is no such file; check the path")
        files = _trajectory_files(path) if path.is_dir() else (path,)
        if not files:
            raise DataError(f"{path}: it holds no trajectory")
        had = found.get(name or _name(path), {}).get(_name(truth), ())
        seen = {one.resolve() for one in had}
        if twice := [one for one in files if one.resolve() in seen]:
            raise DataError(f"{twice[0]}: it is given twice, and would count as two runs; keep one")
        found[name or _name(path)] = {_name(truth): (*had, *files)}
    return found


def _of_folders(given: Iterable[str]) -> _Found:
    found: _Found = {}
    for word in given:
        name, path = _named(word)
        if not path.is_dir():
            raise DataError(f"{path}: it is no folder; where the truth is a folder, give systems as NAME=FOLDER")
        if name is not None:
            systems = {name: path}
        else:
            folders = {printable(folder.name): folder for folder in sorted(path.iterdir()) if folder.is_dir()}
            systems = {system: folder for system, folder in folders.items() if not system.startswith(".")}
        if not systems:
            raise DataError(f"{path}: it has no folders; expected SYSTEM/SEQUENCE.tum or SYSTEM/SEQUENCE/RUN.tum")
        for system, folder in systems.items():
            if system in found:
                raise DataError(f"{folder}: {system} is given twice; give each system another name")
            found[system] = files_by_sequence(folder)
    return found


def truths_in(folder: Path) -> dict[str, Path]:
    """Return the truth of each sequence in a folder; raises DataError where there are none, or two of one."""
    if not folder.exists():
        raise DataError(f"{folder}: there is no such truth; give a file, or a folder that has SEQUENCE.tum")
    found = files_by_sequence(folder)
    for sequence, files in found.items():
        if len(files) != 1:
            raise DataError(f"{folder}: it has {len(files)} truths for {sequence}; leave one, {sequence}.tum")
    return {sequence: files[0] for sequence, files in found.items()}


def _left_out(truths: Mapping[str, Path], known: set[str]) -> Iterable[str]:
    without_truth, without_runs = sorted(known - set(truths)), sorted(set(truths) - known)
    if without_truth:
        yield f"no truth is given for {', '.join(without_truth)}: not scored"
    if without_runs:
        yield f"no system has a trajectory of {', '.join(without_runs)}: not scored"


def _named(word: str) -> tuple[str | None, Path]:
    """Split NAME=PATH; an argument that is an existing path, or has no name, is a path as a whole."""
    name, equals, path = word.partition("=")
    if not equals or not name.strip() or not path or Path(word).exists():
        return None, Path(word)
    return printable(name.strip()), Path(path)


def _name(path: Path) -> str:
    return printable(_unzipped(path).stem)


def _unzipped(path: Path) -> Path:
    return Path(path.name.removesuffix(_ZIPPED))


def files_by_sequence(folder: Path) -> dict[str, tuple[Path, ...]]:
    """Return the trajectory files of each sequence in a folder; raises DataError where there are none."""
    if not folder.is_dir():
        raise DataError(f"{folder}: it is no folder; give one that has SEQUENCE.tum or SEQUENCE/RUN.tum")
    found: dict[str, tuple[Path, ...]] = {}
    for path in _entries(folder):
        files = _trajectory_files(path) if path.is_dir() else (path,) if _is_file(path) else ()
        name = printable(path.name) if path.is_dir() else _name(path)
        if files and name in found:
            raise DataError(f"{folder}: {name} is given twice, as {found[name][0].name} and {path.name}; keep one")
        if files:
            found[name] = files
    if not found:
        raise DataError(
            f"{folder}: no SEQUENCE.tum and no SEQUENCE/RUN.tum in it ({', '.join(SUFFIXES)} are read, gzipped too)"
        )
    return found


def _trajectory_files(folder: Path) -> tuple[Path, ...]:
    return tuple(filter(_is_file, _entries(folder)))


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError as error:
        raise DataError(unreadable(folder, error)) from error


def _is_file(path: Path) -> bool:
    return path.is_file() and _unzipped(path).suffix in SUFFIXES and not path.name.startswith(".")
