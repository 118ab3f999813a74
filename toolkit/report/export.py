"""Exports of a run directory: a trajectory in another program's format, or the run as one file to check and repeat.

A bundle is a zip archive with bundle.json (``vislam.bundle/1``), requirements.txt (the release of every package that is
installed) and the run's files but for its figures. The same directory gives the same bytes.
"""

import hashlib
import zipfile
import zlib
from importlib.metadata import distributions
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

from msgspec import UNSET, Meta, Struct

from toolkit.answers import Output
from toolkit.datasets.trajectories import FORMATS, read_poses, tum
from toolkit.datasets.trajectories.covariances import CovConvention
from toolkit.datasets.trajectories.formats import Stamped
from toolkit.errors import DataError, did_you_mean
from toolkit.experiment.comparison import TRUTH
from toolkit.experiment.outcome_store import OUTCOMES
from toolkit.files import documents
from toolkit.files.reading import open_input
from toolkit.files.writing import replaced_file, write_text
from toolkit.report.report_json import Report, file_of
from toolkit.report.run_directory import MANIFEST, RunFiles, SeedsFiles, read_run

BUNDLE, LOCK = "bundle.json", "requirements.txt"
_NEVER_IN = ("figures/",)
# The oldest stamp that a zip archive can hold, for every entry, so that the same files give the same bytes.
_STAMP = (1980, 1, 1, 0, 0, 0)
_MOST_BYTES = 4 * 2**30
_REMEDY = "make it again with vislam export --bundle"
_DAMAGED = (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError, ValueError)


def export(
    directory: Path,
    target: Path,
    format_name: str,
    estimator: str | None = None,
    output: Output | None = None,
    cov_convention: CovConvention | None = None,
) -> str:
    """Write a trajectory of a run directory as a file and return in words which it is.

    Without an estimator there must be only one; ``truth`` is the ground truth. Without an output it is the final one,
    where there is one. Covariances are written where a convention for them is given. Raises DataError where there is
    no such trajectory or the format cannot hold it, OutputError where the file cannot be written.
    """
    run = read_run(directory)
    if isinstance(run, SeedsFiles):
        raise DataError(
            f"{directory} is a comparison over seeds and holds no trajectories; run one seed without --seeds"
        )
    what, name, states = _chosen(directory, run.report, estimator, output)
    trajectory = tum.read(directory / name, "a run that diverged may leave no finite pose")
    if states is not None and (directory / states).is_file():
        trajectory = read_poses(directory / states).trajectory(trajectory.t_ns)
    frames, one = run.scores.sequence.frames, FORMATS[format_name]
    if format_name == "kitti" and len(trajectory) != frames:
        raise DataError(
            f"{what} has {len(trajectory)} poses for {frames} frames, and KITTI's rows are the frames; "
            "choose a format with stamps"
        )
    if cov_convention is None:
        text = one.text(trajectory)
    elif not isinstance(one, Stamped):
        raise DataError(f"a {format_name} file has no place for covariances; choose another format")
    elif trajectory.cov is None:
        raise DataError(f"no covariances of {what} are in the run directory; leave out --cov-convention")
    else:
        text = one.text_with_covariances(trajectory, cov_convention)
    write_text(target, text)
    return f"{what}, {len(trajectory)} poses"


def _chosen(
    directory: Path, report: Report, estimator: str | None, output: Output | None
) -> tuple[str, str, str | None]:
    """Return in words which trajectory is meant, its file in the run directory, and the one that has its states."""
    if estimator == TRUTH:
        if report.truth is None:
            raise DataError(f"{directory} has no ground truth")
        return TRUTH, report.truth, None
    files = {(run.estimator, run.output): run.trajectory for run in report.runs if run.trajectory}
    names = list(dict.fromkeys(name for name, _ in files))
    there = ", ".join([*names, *([TRUTH] if report.truth is not None else [])])
    if estimator is None and len(names) != 1:
        raise DataError(f"{directory} holds several trajectories; choose one with --estimator: {there}")
    name = names[0] if estimator is None else estimator
    if name not in names:
        raise DataError(f"{directory} has no trajectory of {name}{did_you_mean(name, names)}; there are {there}")
    outputs = [given for known, given in files if known == name]
    wanted = outputs[-1] if output is None else output
    if wanted not in outputs:
        raise DataError(f"{directory} has no {wanted} trajectory of {name}, only a {outputs[0]} one")
    repeats = any(run.repeats_causal for run in report.runs if (run.estimator, run.output) == (name, wanted))
    return f"{name} {wanted}", files[name, wanted], file_of("states", name, "causal" if repeats else wanted)


class BundleRecord(Struct, frozen=True, kw_only=True):
    """What a bundle holds."""

    schema: Literal["vislam.bundle/1"]
    name: Annotated[str, Meta(description="of the run directory")]
    hashes: Annotated[tuple[str | None, ...], Meta(description="SHA-256 of what was read, one a seed; null: unknown")]
    packages: Annotated[dict[str, str], Meta(description="every installed package's release")]
    files: Annotated[dict[str, str], Meta(description="SHA-256 of each file, by its path in the run directory")]

    def __post_init__(self) -> None:
        for name in self.files:
            path = PurePosixPath(name)
            if path.is_absolute() or ".." in path.parts or "\\" in name or not path.parts:
                raise ValueError(f"files has {name!r}, which is no path inside a run directory")


def write_bundle(directory: Path, target: Path) -> str:
    """Write the bundle of a run directory and return in words what is in it.

    Raises DataError where the directory is none, OutputError where the file cannot be written.
    """
    run = read_run(directory)
    contents = {name: (directory / name).read_bytes() for name in _names(run)}
    record = BundleRecord(
        schema="vislam.bundle/1",
        name=directory.resolve().name,
        hashes=run.scores.hashes if isinstance(run, SeedsFiles) else (run.scores.sequence.hash,),
        packages=installed_packages(),
        files={name: hashlib.sha256(content).hexdigest() for name, content in contents.items()},
    )
    contents |= {
        BUNDLE: documents.to_text(record).encode(),
        LOCK: "".join(f"{name}=={release}\n" for name, release in record.packages.items()).encode(),
    }
    with replaced_file(target) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in sorted(contents.items()):
            archive.writestr(zipfile.ZipInfo(name, _STAMP), content, zipfile.ZIP_DEFLATED)
    return f"{len(record.files)} files of {record.name}, {len(record.packages)} packages"


def installed_packages() -> dict[str, str]:
    found = {str(one.metadata["Name"]).lower().replace("_", "-"): one.version for one in distributions()}
    return dict(sorted(found.items()))


def unpack_bundle(path: Path, directory: Path) -> BundleRecord:
    """Write the run's files of a bundle into an empty directory and return what it says of them.

    Only files that bundle.json lists are written, after the hash of each has been checked. Raises DataError, in one
    line, where the file is no bundle, or damaged.
    """
    with open_input(path) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                record, contents = _read_bundle(archive)
        except DataError as error:
            raise DataError(f"{path}: {error}; {_REMEDY}") from error
        except _DAMAGED as error:
            raise DataError(f"{path}: it cannot be read as a bundle ({error}); {_REMEDY}") from error
    for name, content in contents.items():
        place = directory / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)
    return record


def _read_bundle(archive: zipfile.ZipFile) -> tuple[BundleRecord, dict[str, bytes]]:
    entries = {entry.filename: entry.file_size for entry in archive.infolist()}
    if BUNDLE not in entries:
        raise DataError(f"it is a zip archive without {BUNDLE}")
    if sum(entries.values()) > _MOST_BYTES:
        raise DataError("it would unpack to more than 4 GB, which no bundle does")
    try:
        record = documents.parse(archive.read(BUNDLE), BundleRecord)
    except DataError as error:
        raise DataError(f"{BUNDLE} {error}") from error
    contents = {}
    for name, digest in record.files.items():
        if name not in entries:
            raise DataError(f"{name} is missing")
        contents[name] = archive.read(name)
        if hashlib.sha256(contents[name]).hexdigest() != digest:
            raise DataError(f"{name} is not as it was when the bundle was made")
    return record, contents


def _names(run: RunFiles | SeedsFiles) -> list[str]:
    listed = run.manifest.files
    if listed is UNSET:
        raise DataError(
            f"{run.directory / MANIFEST} lists no files, as an earlier version left it; repeat the comparison"
        )
    names = [name for name in listed if not name.startswith(_NEVER_IN) and name != OUTCOMES]
    for name in names:
        if not (run.directory / name).is_file():
            raise DataError(f"{run.directory / name} is missing, and {MANIFEST} lists it; repeat the comparison")
    return names
