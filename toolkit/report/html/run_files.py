"""What a run directory holds, read back with nothing but its own files, so that it works on any machine."""

import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array
from toolkit.report import manifest, metrics_json, report_json, seeds_json, seeds_report_json
from toolkit.resampling import NS_PER_S

# A parsed JSON document of ours, after its validator had nothing to say.
Document = dict[str, Any]
_METRICS, _SEEDS, _REPORT, _MANIFEST = "metrics.json", "seeds.json", "report.json", "manifest.json"
_TUM_COLUMNS, _LANDMARK_COLUMNS = 8, 4


@dataclass(frozen=True, eq=False)
class Track:
    """Positions (N, 3) m in their own world at times (N,) s from the first frame."""

    t_s: Array
    positions: Array


@dataclass(frozen=True, eq=False)
class RunFiles:
    """One run directory: its documents, and trajectories and landmarks (M, 3) by the names the documents give them.

    ``scores`` is metrics.json, or seeds.json where ``over_seeds``.
    """

    directory: Path
    scores: Document
    report: Document
    manifest: Document
    over_seeds: bool = False
    tracks: dict[str, Track] = field(default_factory=dict)
    landmarks: dict[str, Array] = field(default_factory=dict)


def read_run(directory: Path) -> RunFiles:
    """Read a run directory.

    Raises DataError, naming the file, where one is missing, damaged or of a version this toolkit does not know.
    """
    if not directory.is_dir():
        raise DataError(f"{directory} is not a directory; give a run directory, as vislam compare writes it")
    if not any((directory / name).is_file() for name in (_METRICS, _SEEDS)):
        raise DataError(f"{directory} is not a run directory: it holds neither {_METRICS} nor {_SEEDS}")
    told = _document(directory, _MANIFEST, _manifest_violations)
    if (directory / _SEEDS).is_file():
        seeds = _document(directory, _SEEDS, seeds_json.violations)
        return RunFiles(directory, seeds, _report(directory, told, seeds_report_json.violations), told, over_seeds=True)
    scores = _document(directory, _METRICS, metrics_json.violations)
    report = _report(directory, told, report_json.violations)
    names = [report["truth"], *(run["trajectory"] for run in report["runs"])]
    tracks = {name: _track(directory / name, report["start_ns"]) for name in names if name is not None}
    landmarks = {one["landmarks"]: _landmarks(directory / one["landmarks"]) for one in report["maps"]}
    return RunFiles(directory, scores, report, told, tracks=tracks, landmarks=landmarks)


def _report(directory: Path, told: Document, violations: Callable[[object], list[str]]) -> Document:
    if not (directory / _REPORT).is_file():
        again = f"repeat it: {told['command']}" if told.get("command") else "repeat the comparison"
        raise DataError(f"{directory} was written by an earlier version and has no {_REPORT}; {again}")
    return _document(directory, _REPORT, violations)


def _document(directory: Path, name: str, violations: Callable[[object], list[str]]) -> Document:
    path = directory / name
    try:
        document: Document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(f"{path} is missing; repeat the comparison") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read ({error}); repeat the comparison") from error
    broken = violations(document)
    if broken:
        raise DataError(f"{path} is not what this version writes: {broken[0]}; repeat the comparison")
    return document


def _manifest_violations(document: object) -> list[str]:
    schema = document.get("schema") if isinstance(document, dict) else None
    return [] if schema == manifest.SCHEMA else [f"schema is {schema!r}, not {manifest.SCHEMA!r}"]


def _track(path: Path, start_ns: int) -> Track:
    table = _numbers(path, _TUM_COLUMNS, None)
    return Track(table[:, 0] - start_ns / NS_PER_S, table[:, 1:4])


def _landmarks(path: Path) -> Array:
    points = _numbers(path, _LANDMARK_COLUMNS, ",", header_lines=1)[:, 1:]
    return points[np.isfinite(points).all(axis=1)]


def _numbers(path: Path, columns: int, delimiter: str | None, header_lines: int = 0) -> Array:
    """Read a table (N, columns); it may have no rows, for a run that diverged may leave no finite pose."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")
            table = np.loadtxt(path, delimiter=delimiter, skiprows=header_lines, ndmin=2)
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read ({error}); repeat the comparison") from error
    if not table.size:
        return np.empty((0, columns))
    if table.shape[1] != columns:
        raise DataError(f"{path} has {table.shape[1]} columns, not {columns}; repeat the comparison")
    return table
