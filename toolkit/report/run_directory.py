"""The directories that commands leave behind, written at once or not at all: first that of a comparison.

It is read with nothing but its own files, so that this works on any machine. Then that of a sweep or an explanation.
"""

import io
import os
import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import msgspec
import numpy as np
from msgspec import UNSET, Struct

from toolkit.answers import Output
from toolkit.datasets.trajectories import openvins, tum
from toolkit.errors import DataError
from toolkit.estimate import Landmarks, Trajectory
from toolkit.experiment.comparison import Comparison
from toolkit.experiment.configuration import Request
from toolkit.experiment.outcome_store import OUTCOMES, files_of_ours
from toolkit.experiment.recording import Prepared
from toolkit.files.documents import to_line, to_text
from toolkit.files.reading import read_input
from toolkit.files.writing import check_parent, check_replaceable, plain_name, replaced_directory, with_folders
from toolkit.geometry import Array
from toolkit.measurements import NS_PER_S
from toolkit.report import FigureChoice, FigureFormat
from toolkit.report.comparison_table import report_text
from toolkit.report.curves import truth_during
from toolkit.report.html import card
from toolkit.report.manifest import Manifest, manifest_document, read_manifest
from toolkit.report.report_json import (
    TRUTH_FILE,
    DrawnOverSeeds,
    DrawnRun,
    Report,
    SeedsReport,
    file_of,
    read_report,
    read_seeds_report,
    report_document,
    seeds_report_document,
)
from toolkit.report.scores import (
    MetricsDocument,
    RunOverSeeds,
    ScoredRun,
    Seeds,
    metrics_document,
    read_metrics,
    read_seeds,
    seeds_document,
)
from toolkit.report.text import Table, Width, as_markdown, as_text, filled, in_markdown

_TUM_COLUMNS, _LANDMARK_COLUMNS = 8, 4
_ERRORS = ("ate_none_m", "ate_se3_m", "ate_yaw_m", "heldout_reproj_rmse_px", "nees_pose_mean")

if TYPE_CHECKING:
    from toolkit.report.figures.style import NamedFigure

METRICS, SEEDS, REPORT, MANIFEST = "metrics.json", "seeds.json", "report.json", "manifest.json"
# What a sweep or an explanation leaves in their place.
_RESULTS = ("sweep.json", "explain.json")
REPORT_TEXT, PAGE = "report.md", "report.html"
FOLDERS = ("figures", "landmarks", "states", "trajectories")
Found = TypeVar("Found")
Record = TypeVar("Record", bound=Struct)


def written_by_us(directory: Path) -> frozenset[str]:
    """Return what in a directory an earlier run wrote: files by their relative path, folders with a slash behind.

    They are the outcomes of a run that is not complete or is continued; those its manifest lists; and the page that
    ``vislam report`` puts beside them.
    """
    return own_files(directory, _written)


def own_files(directory: Path, written: Callable[[Path], Iterable[str]]) -> frozenset[str]:
    """Return what of ours is in a folder by its relative path, folders with a slash behind.

    It is outcomes, and what was ``written`` as the folder's document says, which may raise DataError where there is no
    such document of ours: many programs write a file of that name.
    """
    files = set(files_of_ours(directory))
    with suppress(DataError):
        files |= set(written(directory))
    return with_folders(files)


def take_over(file: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        place.hardlink_to(file)
    except OSError:  # a file system without links
        shutil.copyfile(file, place)


def _written(directory: Path) -> Iterator[str]:
    files = read_manifest(directory / MANIFEST).files
    yield from (f"{folder}/" for folder in FOLDERS)
    yield from () if files is UNSET else files
    if _is_page(directory / PAGE):
        yield PAGE


def _is_page(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return b"vislam report</title>" in file.read(4096)
    except OSError:
        return False


def directories_for(cases: Sequence[Prepared], out: Path) -> tuple[Path, ...]:
    """Return the run directory of each case: ``out`` for a single one, else folders in it by the sequences' names.

    Raises OutputError where one cannot be written or holds something else.
    """
    names = unique_names(case.name for case in cases)
    directories = (out,) if len(names) == 1 else tuple(out / name for name in names)
    if len(names) > 1:
        check_parent(out)
    for directory in directories:
        check_replaceable(directory, written_by_us)
    return directories


def unique_names(names: Iterable[str]) -> list[str]:
    """Turn sequence names into directory names, all different; a second ``drive`` becomes ``drive-2``."""
    taken: list[str] = []
    for name in names:
        plain = plain_name(name) or "sequence"
        candidate, n = plain, 2
        while candidate in taken:
            candidate, n = f"{plain}-{n}", n + 1
        taken.append(candidate)
    return taken


@dataclass(frozen=True)
class MadeBy:
    """The command line that made a comparison, and what it asked for.

    ``figures`` is the kind of files that figures are written as, ``choice`` which of them.
    """

    command: str
    request: Request = field(default_factory=Request)
    figures: FigureFormat = "png"
    choice: FigureChoice = "few"


def write_run(comparison: Comparison, target: Path, made_by: MadeBy) -> None:
    """Write the run directory of a comparison, in the place of an earlier one if there is one.

    The outcomes that are kept there stay, with the trajectories of those that are in the comparison. Raises OutputError
    where ``target`` cannot be written or holds something else; nothing is left behind then.
    """
    with replaced_directory(target, written_by_us) as directory:
        kept = (OUTCOMES, *(name for outcome in comparison.outcomes for name in outcome.files))
        for name in kept if OUTCOMES in files_of_ours(target) else ():
            take_over(target / name, directory / name)
        for name, text in _texts(comparison):
            (directory / name).parent.mkdir(exist_ok=True)
            _write_text(directory / name, text)
        captions: dict[str, str] = {}
        (directory / "figures").mkdir()
        if made_by.choice != "none":
            # Here alone, for matplotlib takes long to import.
            from toolkit.report.figures import drawn, save

            captions = save(drawn(comparison, made_by.choice), directory / "figures", made_by.figures)
        _write_text(directory / REPORT_TEXT, report_text(comparison, captions))
        manifest = manifest_document(comparison, made_by.command, made_by.request)
        manifest = msgspec.structs.replace(manifest, files=tuple(sorted([*files_in(directory), MANIFEST])))
        _write_text(directory / MANIFEST, to_text(manifest))


def files_in(directory: Path) -> list[str]:
    """Return the relative paths of all files in a directory, sorted."""
    return sorted(path.relative_to(directory).as_posix() for path in directory.rglob("*") if path.is_file())


def _texts(comparison: Comparison) -> Iterator[tuple[str, str]]:
    """Yield name and content of every document and table, one after the other."""
    truth = truth_during(comparison.sequence)
    if truth is not None and (not comparison.over_seeds or any(outcome.files for outcome in comparison.outcomes)):
        yield TRUTH_FILE, tum.text(Trajectory(truth.t_ns, truth.T_world_imu))
    if comparison.over_seeds:
        yield SEEDS, to_text(seeds_document(comparison))
        yield REPORT, to_line(seeds_report_document(comparison))
        return
    yield METRICS, to_text(metrics_document(comparison))
    yield REPORT, to_line(report_document(comparison))
    for row in comparison.rows:
        trajectory = row.run.trajectory(row.output)
        if trajectory is not None:
            yield file_of("trajectory", row.estimator, row.output), tum.text(trajectory)
            if trajectory.cov is not None and not row.repeats_causal:
                yield file_of("states", row.estimator, row.output), openvins.text_with_covariances(trajectory)
    for run in comparison.runs:
        yield file_of("landmarks", run.estimator), _landmarks_text(run.landmarks)


def _landmarks_text(landmarks: Landmarks) -> str:
    """Return landmarks as CSV, one a row: track id and position in the world in metres."""
    rows = zip(landmarks.track_ids.tolist(), landmarks.points_world.tolist(), strict=True)
    lines = [f"{track_id},{x:.15g},{y:.15g},{z:.15g}" for track_id, (x, y, z) in rows]
    return "\n".join(["track_id,x_m,y_m,z_m", *lines]) + "\n"


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


class DrawnPath(NamedTuple):
    """Positions (N, 3) m in their own world at times (N,) s from the first frame."""

    t_s: Array
    positions: Array


@dataclass(frozen=True, eq=False)
class RunFiles:
    """The run directory of one seed; trajectories, landmarks (M, 3) and images by the names the report gives them."""

    directory: Path
    scores: MetricsDocument
    report: Report
    manifest: Manifest
    tracks: dict[str, DrawnPath]
    landmarks: dict[str, Array]


@dataclass(frozen=True, eq=False)
class SeedsFiles:
    """The run directory of a comparison over seeds, which holds no trajectories."""

    directory: Path
    scores: Seeds
    report: SeedsReport
    manifest: Manifest


def repeated(files: RunFiles | SeedsFiles) -> frozenset[str]:
    """Return the estimators whose final answer is the causal one; over seeds, where all known errors say so."""
    if isinstance(files, RunFiles):
        return frozenset(run.estimator for run in files.report.runs if run.repeats_causal)
    of = {(run.estimator, run.output): [run.metrics[key].values for key in _ERRORS] for run in files.scores.runs}
    finals = [(name, values) for (name, output), values in of.items() if output == "final"]
    known = [(name, values) for name, values in finals if any(value is not None for one in values for value in one)]
    return frozenset(name for name, values in known if values == of.get((name, "causal")))


def runs_in(directory: Path) -> tuple[Path, ...]:
    """Return a run directory itself; of the folder that a comparison of several recordings made, all in it, by name."""
    inside = sorted(directory.iterdir()) if os.path.isdir(directory) and not _holds_run(directory) else []  # noqa: PTH112
    return tuple(filter(_holds_run, inside)) or (directory,)


def _holds_run(directory: Path) -> bool:
    return any((directory / name).is_file() for name in (METRICS, SEEDS, OUTCOMES))


def read_run(directory: Path) -> RunFiles | SeedsFiles:
    """Read a run directory.

    Raises DataError, naming the file, where one is missing, damaged or of a version this toolkit does not know.
    """
    if not os.path.isdir(directory):  # noqa: PTH112 - a name that is too long is no directory either
        raise DataError(f"{directory} is not a directory; give a run directory, as vislam compare writes it")
    if any((directory / name).is_file() for name in _RESULTS):
        raise DataError(f"{directory} is of a sweep or an explanation, and no comparison; vislam report shows it")
    if OUTCOMES in files_of_ours(directory) and not (directory / MANIFEST).exists():
        raise DataError(f"{directory} is of a comparison that has not ended; repeat its command, which continues it")
    if not any((directory / name).is_file() for name in (METRICS, SEEDS)):
        raise DataError(f"{directory} is not a run directory: it holds neither {METRICS} nor {SEEDS}")
    manifest = read_manifest(directory / MANIFEST)
    if not (directory / REPORT).is_file():
        again = f"repeat it: {manifest.command}" if manifest.command else "repeat the comparison"
        raise DataError(f"{directory} has no {REPORT}: an earlier version wrote it, or that was removed; {again}")
    if not (directory / SEEDS).is_file():
        return _one_seed(directory, manifest)
    scores, report = read_seeds(directory / SEEDS), read_seeds_report(directory / REPORT)
    _check_same_runs(directory, SEEDS, scores.runs, report.runs)
    return SeedsFiles(directory, scores, report, manifest)


def _one_seed(directory: Path, manifest: Manifest) -> RunFiles:
    scores, report = read_metrics(directory / METRICS), read_report(directory / REPORT)
    drawn = _check_same_runs(directory, METRICS, scores.runs, report.runs)
    if not {(one.estimator, one.output) for one in report.maps} <= set(drawn):
        raise DataError(f"{directory / REPORT} has the map of a run it does not have; repeat the comparison")
    names = [report.truth, *(run.trajectory for run in report.runs)]
    tables = {name: _numbers(directory / name, _TUM_COLUMNS, None) for name in names if name is not None}
    start_s = report.start_ns / NS_PER_S
    tracks = {name: DrawnPath(table[:, 0] - start_s, table[:, 1:4]) for name, table in tables.items()}
    points = {one.landmarks: _numbers(directory / one.landmarks, _LANDMARK_COLUMNS, ",", 1) for one in report.maps}
    landmarks = {name: each[np.isfinite(each).all(axis=1), 1:] for name, each in points.items()}
    return RunFiles(directory, scores, report, manifest, tracks, landmarks)


def _check_same_runs(
    directory: Path, name: str, scored: Sequence[ScoredRun | RunOverSeeds], drawn: Sequence[DrawnRun | DrawnOverSeeds]
) -> list[tuple[str, Output]]:
    runs = [(run.estimator, run.output) for run in drawn]
    if [(run.estimator, run.output) for run in scored] != runs:
        raise DataError(f"{directory}: {REPORT} does not have the runs of {name}; repeat the comparison")
    return runs


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


class Shown(NamedTuple):
    """What a document says: title, words, table, captions by figure, and files."""

    title: str
    words: str
    table: Table
    figures: Mapping[str, str]
    files: tuple[str, ...]


@dataclass(frozen=True)
class Results(Generic[Found, Record]):
    """The folder of a sweep or an explanation: the names of its document and its Markdown, and how they come about.

    The document is ``made`` of what was found, the command, captions by figure and the names of all files; it is
    ``read`` back and ``shown``.
    """

    document: str
    markdown: str
    made: Callable[[Found, str, Mapping[str, str], tuple[str, ...]], Record]
    read: Callable[[Path], Record]
    shown: Callable[[Record], Shown]

    def drawn(self, found: Found) -> "Iterator[NamedFigure]":
        from toolkit.report.figures.trials import DRAWN  # here alone, for matplotlib takes long to import

        return DRAWN[self.document](found)

    def check(self, target: Path) -> None:
        """Raise OutputError unless the results can be written at ``target`` without the loss of anybody's files."""
        check_replaceable(target, self._ours)

    def _ours(self, directory: Path) -> frozenset[str]:
        return own_files(directory, lambda at: (self.document, PAGE, *self.shown(self.read(at / self.document)).files))

    def text(self, record: Record, width: Width = None) -> str:
        shown = self.shown(record)
        return f"{filled(shown.words, width, further='')}\n\n{as_text(shown.table)}"

    def as_markdown(self, record: Record) -> str:
        shown = self.shown(record)
        figures = (f"![{in_markdown(said)}]({name})\n\n{in_markdown(said)}" for name, said in shown.figures.items())
        parts = (f"# {in_markdown(shown.title)}", in_markdown(shown.words), as_markdown(shown.table), *figures)
        return "\n\n".join(parts) + "\n"

    def section(self, directory: Path) -> str:
        """Return the section of the page for a folder; raises DataError where its document or a figure is missing."""
        shown = self.shown(self.read(directory / self.document))
        figures = {directory / name: caption for name, caption in shown.figures.items()}
        return card(shown.title, [shown.words], shown.table, figures)

    def write(self, found: Found, target: Path, command: str) -> Record:
        """Write the folder anew: figures, PNG and PDF, then the document and its Markdown; return the document.

        Outcomes kept in the folder stay. Raises OutputError where it cannot be written or holds something else;
        nothing is left behind then.
        """
        from toolkit.report.figures import save

        drawn, names = list(self.drawn(found)), (self.markdown, self.document)
        with replaced_directory(target, self._ours) as directory:
            if (target / OUTCOMES).exists():
                take_over(target / OUTCOMES, directory / OUTCOMES)
            (directory / "figures").mkdir()
            save(drawn, directory / "figures", "pdf")
            captions = {f"figures/{name}": text for name, text in save(drawn, directory / "figures").items()}
            record = self.made(found, command, captions, (*files_in(directory), *names))
            for name, text in zip(names, (self.as_markdown(record), to_text(record)), strict=True):
                _write_text(directory / name, text)
        return record
