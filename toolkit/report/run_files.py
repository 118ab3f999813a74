"""What a run directory holds, read back with nothing but its own files, so that it works on any machine."""

import io
import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec import UNSET

from toolkit.errors import DataError
from toolkit.estimate import Output
from toolkit.experiment.outcome_store import OUTCOMES, files_of_ours
from toolkit.files.reading import read_input
from toolkit.geometry import Array
from toolkit.report.records import (
    Manifest,
    Metrics,
    Report,
    Seeds,
    SeedsReport,
    read_manifest,
    read_metrics,
    read_report,
    read_seeds,
    read_seeds_report,
)
from toolkit.report.run_directory import MANIFEST, METRICS, REPORT, SEEDS
from toolkit.resampling import NS_PER_S

_TUM_COLUMNS, _LANDMARK_COLUMNS = 8, 4
_Rows = list[tuple[str, Output]]


class DrawnPath(NamedTuple):
    """Positions (N, 3) m in their own world at times (N,) s from the first frame."""

    t_s: Array
    positions: Array


@dataclass(frozen=True, eq=False)
class RunFiles:
    """The run directory of one seed; trajectories, landmarks (M, 3) and images by the names the report gives them."""

    directory: Path
    scores: Metrics
    report: Report
    manifest: Manifest
    tracks: dict[str, DrawnPath]
    landmarks: dict[str, Array]
    images: dict[str, bytes]


@dataclass(frozen=True, eq=False)
class SeedsFiles:
    """The run directory of a comparison over seeds, which holds no trajectories."""

    directory: Path
    scores: Seeds
    report: SeedsReport
    manifest: Manifest


def read_run(directory: Path) -> RunFiles | SeedsFiles:
    """Read a run directory.

    Raises DataError, naming the file, where one is missing, damaged or of a version this toolkit does not know.
    """
    if not os.path.isdir(directory):  # noqa: PTH112 - a name that is too long is no directory either
        raise DataError(f"{directory} is not a directory; give a run directory, as vislam compare writes it")
    if OUTCOMES in files_of_ours(directory) and not (directory / MANIFEST).exists():
        raise DataError(f"{directory} is of a comparison that has not ended; repeat its command, which continues it")
    if not any((directory / name).is_file() for name in (METRICS, SEEDS)):
        raise DataError(f"{directory} is not a run directory: it holds neither {METRICS} nor {SEEDS}")
    manifest = read_manifest(directory / MANIFEST)
    if not (directory / REPORT).is_file():
        again = f"repeat it: {manifest.command}" if manifest.command else "repeat the comparison"
        raise DataError(f"{directory} has no {REPORT}: an earlier version wrote it, or that was removed; {again}")
    return _over_seeds(directory, manifest) if (directory / SEEDS).is_file() else _one_seed(directory, manifest)


def _one_seed(directory: Path, manifest: Manifest) -> RunFiles:
    scores, report = read_metrics(directory / METRICS), read_report(directory / REPORT)
    drawn = [(run.estimator, run.output) for run in report.runs]
    _check_same_runs(directory, METRICS, [(run.estimator, run.output) for run in scores.runs], drawn)
    if not {(one.estimator, one.output) for one in report.maps} <= set(drawn):
        raise DataError(f"{directory / REPORT} has the map of a run it does not have; repeat the comparison")
    names = [report.truth, *(run.trajectory for run in report.runs)]
    tracks = {name: _track(directory / name, report.start_ns) for name in names if name is not None}
    landmarks = {one.landmarks: _landmarks(directory / one.landmarks) for one in report.maps}
    frames = () if report.frames is UNSET else report.frames
    images = {frame.image: _inside(directory, frame.image) for frame in frames}
    return RunFiles(directory, scores, report, manifest, tracks, landmarks, images)


def _inside(directory: Path, name: str) -> bytes:
    """Return the content of a file that a report names; raises DataError for a name that leads out of its directory."""
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise DataError(f"{directory / REPORT} names {name}, which is not in the run directory; repeat the comparison")
    return read_input(directory / name)


def _over_seeds(directory: Path, manifest: Manifest) -> SeedsFiles:
    scores, report = read_seeds(directory / SEEDS), read_seeds_report(directory / REPORT)
    drawn = [(run.estimator, run.output) for run in report.runs]
    _check_same_runs(directory, SEEDS, [(run.estimator, run.output) for run in scores.runs], drawn)
    return SeedsFiles(directory, scores, report, manifest)


def _check_same_runs(directory: Path, name: str, scored: _Rows, drawn: _Rows) -> None:
    """Raise DataError unless the report draws the runs that have scores, in their order."""
    if scored != drawn:
        raise DataError(f"{directory}: {REPORT} does not have the runs of {name}; repeat the comparison")


def _track(path: Path, start_ns: int) -> DrawnPath:
    table = _numbers(path, _TUM_COLUMNS, None)
    return DrawnPath(table[:, 0] - start_ns / NS_PER_S, table[:, 1:4])


def _landmarks(path: Path) -> Array:
    points = _numbers(path, _LANDMARK_COLUMNS, ",", header_lines=1)[:, 1:]
    return points[np.isfinite(points).all(axis=1)]


def _numbers(path: Path, columns: int, delimiter: str | None, header_lines: int = 0) -> Array:
    """Read a table (N, columns); it may have no rows, for a run that diverged may leave no finite pose."""
    if not path.exists():
        raise DataError(f"{path} is missing; repeat the comparison")
    content = read_input(path)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")
            table = np.loadtxt(io.BytesIO(content), delimiter=delimiter, skiprows=header_lines, ndmin=2)
    except ValueError as error:
        raise DataError(f"{path} cannot be read ({error}); repeat the comparison") from error
    if not table.size:
        return np.empty((0, columns))
    if table.shape[1] != columns:
        raise DataError(f"{path} has {table.shape[1]} columns, not {columns}; repeat the comparison")
    return table
