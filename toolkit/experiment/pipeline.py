"""The one experiment: load, audit, start, run, score. The command line, the gate, notebooks and users all call this."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from toolkit.answers import Run
from toolkit.datasets import is_built_in, is_drawn_from_a_seed, load_references
from toolkit.datasets.trajectories.covariances import CovConvention
from toolkit.errors import DataError
from toolkit.estimate import Landmarks
from toolkit.estimator import Build
from toolkit.experiment.cluster import Cluster
from toolkit.experiment.comparison import Comparison, in_order
from toolkit.experiment.outcome_store import Conditions, OutcomeStore
from toolkit.experiment.recording import WHOLE, Part, Prepared, Recording, prepare
from toolkit.experiment.references import ExternalFile, check_file_names, read_external, runs_of_others
from toolkit.experiment.units import Outcome, Unit, outcome_of, recording_to_prepare, run_unit
from toolkit.experiment.workers import LostUnit, Workers, usable_cpus
from toolkit.progress import Progress, ProgressFor, silent
from toolkit.registry import LADDER, EstimatorEntry, check_options, find_all
from toolkit.sequence import Sequence as Recorded
from toolkit.settings import DEFAULTS, Settings, SettingsError
from toolkit.simulation.faults import Doses

# What does units of work side by side: processes here, or those of a cluster.
Pool = Workers | Cluster


@dataclass(frozen=True, eq=False)
class Plan:
    """What to compare.

    ``sources`` are paths, built-in names or sequences; ``estimators`` are names, files of one's own (``my_filter.py``),
    or the word for the whole ladder; ``own`` are further estimators as functions ``build(setup)`` by name. ``truth`` is
    a TUM file and ``trajectories`` are files of other systems by name, as FILE, FILE:causal or FILE:final, both for a
    single source; ``cov_convention`` is that of their covariances where they do not say it. ``keep`` names the
    faults that the audit reports but leaves as they are. ``workers`` is the number of processes, one a processor where
    it is None. ``keep_trajectories`` writes those of every seed; of a single one they always are. ``scheduler`` is the
    address of a Dask cluster that does the work instead. ``part`` is what is used of each source, ``max_frames`` the
    first frames of that. Raises SettingsError where nothing would be compared, or with nothing."""

    sources: tuple[str | Recorded, ...]
    estimators: tuple[str, ...]
    own: Mapping[str, Build] = field(default_factory=dict)
    settings: Settings = DEFAULTS
    truth: Path | None = None
    trajectories: Mapping[str, Path] = field(default_factory=dict)
    keep: frozenset[str] = frozenset()
    max_frames: int | None = None
    workers: int | None = None
    keep_trajectories: bool = False
    scheduler: str | None = None
    part: Part = WHOLE
    cov_convention: CovConvention | None = None

    def __post_init__(self) -> None:
        if not (self.estimators or self.own or self.trajectories):
            raise SettingsError("there is nothing to compare: name an estimator, or a trajectory of another system")
        if self.workers is not None and self.scheduler is not None:
            raise SettingsError("scheduler and workers exclude each other: a cluster has its own workers")
        for what, given in {"truth": self.truth is not None, "a trajectory": bool(self.trajectories)}.items():
            if given and len(self.sources) != 1:
                raise SettingsError(f"{what} goes with exactly one sequence")
            if given and self.settings.seeds > 1:
                raise SettingsError(f"{what} and seeds exclude each other: a file is of one recording")

    @property
    def seeds(self) -> tuple[int, ...]:
        return tuple(range(self.settings.first_seed, self.settings.first_seed + self.settings.seeds))

    def recording(self, source: str | Recorded, seed: int, faults: Doses | None = None) -> Recording:
        """Return a source of the plan under a seed, with faults to be planted in it."""
        return Recording.under(
            self.settings, source, seed, truth=self.truth, keep=self.keep, max_frames=self.max_frames, part=self.part,
            card=self.settings.card and seed == self.seeds[0], faults=faults,
        )  # fmt: skip


def run(plan: Plan, progress_for: ProgressFor = silent, directories: Sequence[Path] = ()) -> tuple[Comparison, ...]:
    """Run and score every estimator on every source; over seeds outcomes are kept in ``directories``, one a source.

    Raises as :func:`prepared_cases`, :func:`stores_of` and :func:`comparisons` do.
    """
    with workers_of(plan) as workers, ExitStack() as open_files:
        cases = prepared_cases(plan, workers, progress_for)
        stores = stores_of(plan, cases, directories) if directories else []
        for store in stores:
            open_files.callback(store.close)
        return tuple(comparisons(plan, cases, workers, progress_for, stores))


def workers_of(plan: Plan) -> Pool:
    """Return the processes that a plan asks for, which begin to import what they will need, or its cluster.

    Raises ClusterError where that cannot be used.
    """
    if plan.scheduler is not None:
        return Cluster(plan.scheduler)
    workers = Workers(plan.workers or usable_cpus())
    workers.warm_up(__name__)
    return workers


def prepared_cases(plan: Plan, workers: Pool, progress_for: ProgressFor = silent) -> tuple[Prepared, ...]:
    """Make every source ready, so that whatever is wrong with a plan is found before the first estimator starts.

    Raises EstimatorError for an estimator that is unknown or cannot be used, SettingsError for a trajectory's name that
    is taken, DataError for a recording, a truth or a trajectory that cannot be used, or for a recording without a seed
    that is to be repeated over seeds.
    """
    entries = find_all(plan.estimators)
    check_options(plan.settings, {*plan.own, *_own_digests(entries)})
    for entry in entries.values():
        entry.check_usable(plan.settings)
    check_file_names(plan.trajectories, {*entries, *plan.own})
    files = {name: read_external(path, plan.cov_convention) for name, path in plan.trajectories.items()}
    if len(plan.seeds) > 1:
        for source in plan.sources:
            if isinstance(source, Recorded) or not is_drawn_from_a_seed(source, plan.settings.frontend):
                same = f"{_name(source)} is the same under every seed"
                raise DataError(f"{same}; only simulated ones are repeated over seeds")
    recordings = [plan.recording(source, plan.seeds[0]) for source in plan.sources]
    names = ", ".join(_name(source) for source in plan.sources)
    with progress_for(f"{names}: loading and checking") as progress:
        prepared = _prepared(recordings, workers if plan.scheduler is None else Workers(1), progress)
        return tuple(_with_references(plan, one, files) for one in prepared)


def _prepared(recordings: Sequence[Recording], workers: Pool, progress: Progress) -> Iterator[Prepared]:
    """Prepare recordings: several side by side, a single one here, where it is there at once."""
    if len(recordings) == 1:
        yield prepare(recordings[0], progress)
        return
    with closing(workers.results(recordings, prepare, progress)) as coming:
        found = dict(coming)
    for place, recording in enumerate(recordings):
        result = found[place]
        if isinstance(result, LostUnit):
            raise DataError(f"{_name(recording.source)}: while it was loaded {result.why}; is there memory enough?")
        yield result


def _with_references(plan: Plan, case: Prepared, files: Mapping[str, ExternalFile]) -> Prepared:
    source, sequence = case.source, case.sequence
    brought = {} if isinstance(source, Recorded) or len(plan.seeds) > 1 else load_references(source)
    return replace(case, references=runs_of_others(brought, files, case.whole, sequence))


def stores_of(plan: Plan, cases: Sequence[Prepared], directories: Sequence[Path]) -> list[OutcomeStore]:
    """Return where the outcomes of each case are kept, of a comparison over seeds; of one seed the runs are needed.

    Raises DataError where what is kept in a directory is damaged, OutputError where another process writes there.
    """
    if len(plan.seeds) == 1:
        return []
    return [store_of(plan, case, directory) for case, directory in zip(cases, directories, strict=True)]


def store_of(plan: Plan, case: Prepared, directory: Path) -> OutcomeStore:
    """Return where the outcomes of a case are kept, in a directory. Raises as :func:`stores_of`."""
    own = _own_digests(find_all(plan.estimators))
    data = case.data if plan.seeds[0] == 0 else prepare(plan.recording(case.source, 0)).data
    return OutcomeStore(directory, Conditions(data, plan.keep, own))


def _own_digests(entries: Mapping[str, EstimatorEntry]) -> dict[str, str]:
    return {name: entry.own_digest for name, entry in entries.items() if entry.own_digest}


def comparisons(
    plan: Plan,
    cases: Sequence[Prepared],
    workers: Pool,
    progress_for: ProgressFor = silent,
    stores: Sequence[OutcomeStore] = (),
) -> Iterator[Comparison]:
    """Run and score every estimator; yield each case's comparison, in their order, as soon as it is complete.

    Outcomes that the ``stores``, one a case, have already are not run again. An estimator that fails is a row that says
    so. Raises DataError where a recording cannot be used under a seed.
    """
    entries = find_all(plan.estimators)
    kept: Sequence[OutcomeStore | None] = stores or [None] * len(cases)
    jobs = [Job(unit, store) for case, store in zip(cases, kept, strict=True) for unit in _units(plan, case, entries)]
    outcomes: list[list[Outcome]] = [[] for _ in cases]
    names, shown = ", ".join(dict.fromkeys(case.name for case in cases)), 0
    for place, outcome in outcomes_of(jobs, workers, names, progress_for):
        outcomes[place * len(cases) // len(jobs)].append(outcome)
        while shown < len(cases) and len(outcomes[shown]) * len(cases) == len(jobs):
            yield _comparison(plan, cases[shown], outcomes[shown], entries, workers.count)
            shown += 1
    for case in cases[shown:]:  # that no estimator runs on
        yield _comparison(plan, case, (), entries, workers.count)


class Job(NamedTuple):
    """A unit of work, and where its outcome is looked for first and kept afterwards, if anywhere."""

    unit: Unit
    store: OutcomeStore | None = None


def outcomes_of(
    jobs: Sequence[Job], workers: Pool, names: str, progress_for: ProgressFor = silent
) -> Iterator[tuple[int, Outcome]]:
    """Yield place and outcome of every job: at once where it is kept already, the others as they are run and kept.

    A job whose process died is a run that failed. Raises DataError where a recording cannot be used.
    """
    found = [None if job.store is None else job.store.find(job.unit) for job in jobs]
    yield from ((place, one) for place, one in enumerate(found) if one is not None)
    missing = [place for place, one in enumerate(found) if one is None]
    there = f" ({len(jobs) - len(missing)} are there)" if len(missing) < len(jobs) else ""
    units = [jobs[place].unit for place in missing]
    with (
        progress_for(f"{names}: {len(missing)} runs{there}") as progress,
        closing(workers.results(units, run_unit, progress, recording_to_prepare)) as coming,
    ):
        for i, result in coming:
            unit, store = jobs[missing[i]]
            if isinstance(result, LostUnit):
                run = Run(unit.estimator, "failed", None, None, Landmarks.none(), timings=None, log=(result.why,))
                kept = run if unit.keep_run else None
                yield missing[i], Outcome(unit.seed, unit.estimator, "failed", log=run.log, run=kept)
            else:
                yield missing[i], result if store is None else store.keep(unit, result)


def _units(plan: Plan, case: Prepared, entries: Mapping[str, EstimatorEntry]) -> Iterator[Unit]:
    """Yield the work of a case: seed by seed, the estimators that take longest first."""
    names = [*plan.own, *sorted(entries, key=lambda name: -(entries[name].rung() or 0))]
    # A worker of a cluster stands in another folder.
    source = case.source if plan.scheduler is None else located(case.source)
    single = len(plan.seeds) == 1
    for seed in plan.seeds:
        # Processes here use the prepared recording; workers of a cluster prepare it themselves and need not be sent it.
        is_ready = single or (seed == plan.seeds[0] and plan.scheduler is None)
        recording = replace(case, references=()) if is_ready else plan.recording(source, seed)
        for name in names:
            build, keep_trajectories = plan.own.get(name), plan.keep_trajectories and not single
            yield Unit(recording, seed, name, plan.settings, build, single, keep_trajectories, entry=entries.get(name))


def located(source: str | Recorded) -> str | Recorded:
    if isinstance(source, Recorded) or is_built_in(source):
        return source
    return str(Path(source).expanduser().absolute())


def _comparison(
    plan: Plan, case: Prepared, outcomes: Iterable[Outcome], entries: Mapping[str, EstimatorEntry], workers: int
) -> Comparison:
    sequence = case.sequence
    ordered = in_order(outcomes, (*entries, *plan.own), plan.seeds)
    others = tuple(outcome_of(reference, sequence, plan.seeds[0]) for reference in case.references)
    on_ladder = LADDER in plan.estimators
    return Comparison(
        source=_name(case.source),
        sequence=sequence,
        findings=case.findings,
        prior=case.prior,
        seeds=plan.seeds,
        outcomes=(*ordered, *others),
        changes={name: entry.change() for name, entry in entries.items()} if on_ladder else {},
        measured=case.measured,
        settings=plan.settings,
        workers=workers,
        undecided=case.undecided,
        card=case.card,
        own_files={name: entry.word for name, entry in entries.items() if entry.own_digest},
    )


def _name(source: str | Recorded) -> str:
    return source.name if isinstance(source, Recorded) else source
