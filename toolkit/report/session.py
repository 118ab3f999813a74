"""From sources to run directories: load, audit, start, run, score, write; what ``vislam compare`` does."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from toolkit import runner
from toolkit.audit import Audit, audit
from toolkit.datasets import load_references, load_sequence
from toolkit.datasets.io.truth_file import load_truth, with_truth
from toolkit.datasets.trajectories import read_poses
from toolkit.estimate import Output, Run
from toolkit.estimator import LADDER, Build, EstimatorEntry, find_all
from toolkit.files import check_parent
from toolkit.initialization import start_from_measurements, start_from_truth
from toolkit.metrics import Scores, describe, score_run
from toolkit.progress import ProgressFor
from toolkit.report.comparison import Comparison, Row, Start, outputs_of, plain_name
from toolkit.report.references import check_names, external_runs, reference_runs
from toolkit.report.run_directory import check_run_directory, write_run
from toolkit.sequence import Prior, Sequence, Truth

STARTS: dict[Start, Callable[[Sequence], Prior]] = {
    "measurements": start_from_measurements,
    "truth": start_from_truth,
}


@dataclass(frozen=True)
class Request:
    """What to compare and where to write it.

    ``estimators`` are names, or the word for the whole ladder; ``keep`` names the faults that the audit reports
    but leaves as they are; ``trajectories`` are files of other systems by name, all of the one source; ``command``
    is kept in the manifest.
    """

    sources: tuple[str, ...]
    estimators: tuple[str, ...]
    out: Path
    truth: Path | None = None
    max_frames: int | None = None
    keep: frozenset[str] = frozenset()
    start: Start = "measurements"
    seed: int = 0
    command: str = ""
    trajectories: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Case:
    """One audited sequence with its start, the runs of other systems, and the directory its results go to."""

    audited: Audit
    prior: Prior
    references: tuple[Run, ...]
    directory: Path


def compare_all(request: Request, progress_for: ProgressFor) -> Iterator[tuple[Comparison, Path]]:
    """Compare the estimators on every source; yield each comparison once its run directory is in place.

    Everything that can be wrong with the request is checked before the first estimator starts. Raises
    EstimatorError for an unknown or unavailable estimator, OutputError where the results cannot be written,
    DataError for a recording, truth or trajectory that cannot be used.
    """
    entries = find_all(request.estimators)
    builds = {name: entry.load() for name, entry in entries.items()}
    if len(request.sources) == 1:
        check_run_directory(request.out)
    else:
        check_parent(request.out)  # its sub-directories are checked once the sequences' names are known
    for case in _cases(request, progress_for):
        comparison = compare(case.audited, case.prior, builds, progress_for, case.references)
        comparison = replace(comparison, changes=changes_of(request, entries))
        with progress_for(f"{comparison.sequence.name}: figures and report"):
            write_run(comparison, case.directory, command=request.command, seed=request.seed)
        yield comparison, case.directory


def compare(
    audited: Audit,
    prior: Prior,
    builds: Mapping[str, Build],
    progress_for: ProgressFor,
    references: tuple[Run, ...] = (),
) -> Comparison:
    """Run and score every estimator on the same audited sequence from the same prior; score the references too."""
    sequence = audited.sequence
    runs = []
    for name, build in builds.items():
        with progress_for(f"{sequence.name}: {name}") as progress:
            runs.append(runner.run(name, build, sequence, prior, progress))
    runs += references
    rows = tuple(
        Row(one, output, _score(one, output, sequence))
        for one in runs
        for output in outputs_of(one)
    )  # fmt: skip
    return Comparison(sequence, audited.findings, prior, tuple(runs), rows)


def _score(run: Run, output: Output, sequence: Sequence) -> Scores:
    if run.trajectory(output) is not None:
        return score_run(run, output, sequence)
    keys = describe()
    return Scores(dict.fromkeys(keys), dict.fromkeys(keys, "the run gave no trajectory"))


def changes_of(request: Request, entries: Mapping[str, EstimatorEntry]) -> dict[str, str]:
    """Return what each estimator changes against the rung before it, where the ladder was asked for; else nothing."""
    return {name: entry.change() for name, entry in entries.items()} if LADDER in request.estimators else {}


def load_audited(source: str, truth: Truth | None, keep: frozenset[str], seed: int) -> Audit:
    """Load a recording, attach a truth given apart from it, and audit it."""
    sequence = load_sequence(source, seed)
    if truth is not None:
        sequence = with_truth(sequence, truth)
    return audit(sequence, keep)


def _cases(request: Request, progress_for: ProgressFor) -> list[_Case]:
    """Prepare every sequence before any estimator runs; several go into sub-directories by name."""
    truth = None if request.truth is None else load_truth(request.truth)
    files = {name: read_poses(path) for name, path in request.trajectories.items()}
    audits, others = [], []
    for source in request.sources:
        with progress_for(f"{source}: loading and checking"):
            whole = load_audited(source, truth, request.keep, request.seed)
            # Only now: the audit judges slow faults (a bias, a lag) better on the whole recording.
            sequence = whole.sequence.truncated(request.max_frames) if request.max_frames else whole.sequence
            brought = load_references(source)
            check_names(brought, files)
            audits.append(replace(whole, sequence=sequence))
            others.append(reference_runs(brought, sequence) + external_runs(files, whole.sequence, sequence))
    names = unique_names(a.sequence.name for a in audits)
    directories = [request.out] if len(audits) == 1 else [request.out / name for name in names]
    for directory in directories:
        check_run_directory(directory)
    start = STARTS[request.start]
    return [_Case(a, start(a.sequence), runs, d) for a, runs, d in zip(audits, others, directories, strict=True)]


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
