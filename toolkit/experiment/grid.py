"""A grid of experiments on one recording: estimators under changed settings and planted faults, paired by their seeds.

Whoever asks what a change costs or brings lists the trials; what is not kept from before is run, side by side.
"""

import math
from collections.abc import Hashable, Iterable, Iterator, Mapping
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import msgspec

from toolkit.answers import Output
from toolkit.errors import no_such
from toolkit.experiment.comparison import Row
from toolkit.experiment.outcome_store import settings_of_a_run
from toolkit.experiment.pipeline import Job, Plan, located, outcomes_of, prepared_cases, store_of, workers_of
from toolkit.experiment.recording import WHOLE, Prepared
from toolkit.experiment.units import Outcome, Unit
from toolkit.experiment.workers import Workers
from toolkit.progress import ProgressFor, silent
from toolkit.registry import EstimatorEntry, check_options, find
from toolkit.settings import Scalar, SettingsError, as_values
from toolkit.settings.reading import settings_of, with_changes
from toolkit.simulation.faults import INJECTORS, Doses, planted


class Trial(NamedTuple):
    """What is run under every seed: an estimator, and what differs from the plan.

    ``changes`` are settings by key, an estimator's options among them (``estimators.NAME.option``); ``faults`` are
    planted, by name and dose; ``keep`` are faults that are not repaired.
    """

    estimator: str
    changes: tuple[tuple[str, Scalar | None], ...] = ()
    faults: Doses = ()
    keep: frozenset[str] = frozenset()

    @classmethod
    def of(
        cls,
        estimator: str,
        changes: Mapping[str, Scalar | None] | None = None,
        faults: Mapping[str, float] | None = None,
        keep: Iterable[str] = (),
    ) -> "Trial":
        """Return a trial; a fault at its clean dose is none. Raises SettingsError for a fault or dose there is not."""
        doses = dict(sorted((faults or {}).items()))
        for name in doses:
            if name not in INJECTORS:
                raise SettingsError(no_such("fault", name, INJECTORS))
        struck = tuple((name, float(dose)) for name, dose in doses.items() if dose != INJECTORS[name].clean)
        for name, dose in struck:
            unit = INJECTORS[name].unit
            if not (0.0 <= dose <= 1.0 if unit == "share" else math.isfinite(dose)):
                wanted = "a share from 0 to 1" if unit == "share" else f"a finite dose, in {unit}"
                raise SettingsError(f"fault:{name}={dose:g}: give {wanted}")
        return cls(estimator, tuple(sorted((changes or {}).items())), struck, frozenset(keep))

    def __str__(self) -> str:
        settings = [f"{key}={value}" for key, value in self.changes]
        faults = [f"fault:{name}={dose:g}" for name, dose in self.faults]
        return " ".join([*settings, *faults, *(f"keep:{name}" for name in sorted(self.keep))])


@dataclass(frozen=True, eq=False)
class Grid:
    """The outcomes of every trial, in the order of the plan's seeds; ``case`` is the recording under the first one.

    ``unusable`` counts the outcomes in the directory that no such trial can use.
    """

    plan: Plan
    case: Prepared
    outcomes: Mapping[Trial, tuple[Outcome, ...]]
    unusable: int = 0

    def row(self, trial: Trial, output: Output) -> Row:
        return Row(output, self.outcomes[trial])


def prepared_case(plan: Plan, progress_for: ProgressFor = silent) -> Prepared:
    """Make the plan's one source ready under its first seed.

    Raises SettingsError, EstimatorError or DataError where there is not one, or it cannot be used.
    """
    if len(plan.sources) != 1:
        raise SettingsError(f"{len(plan.sources)} sequences are given; a grid of experiments is on one")
    (case,) = prepared_cases(plan, Workers(1), progress_for)  # a single one is prepared in this process
    return case


def run_grid(
    plan: Plan,
    trials: Iterable[Trial],
    directory: Path | None = None,
    progress_for: ProgressFor = silent,
    case: Prepared | None = None,
) -> Grid:
    """Run trials on the plan's one source under its seeds; outcomes are kept in a directory and found there again.

    ``case`` is the source under the first seed, where it is ready already. Raises SettingsError, EstimatorError or
    DataError where a trial or the recording cannot be used, before any run.
    """
    plans = {trial: _plan_of(plan, trial) for trial in trials}
    with workers_of(plan) as workers:
        case = case or prepared_case(plan, progress_for)
        for faults in dict.fromkeys(trial.faults for trial in plans):
            planted(case.sequence, faults, plan.seeds[0])
        with nullcontext() if directory is None else closing(store_of(plan, case, directory)) as store:
            jobs: dict[Hashable, Job] = {}
            of_trial: dict[Trial, list[Hashable]] = {trial: [] for trial in plans}
            for trial, unit in _units(plans, case):
                of_trial[trial].append(_all_that_it_depends_on(unit))
                jobs.setdefault(of_trial[trial][-1], Job(unit, store))
            found = dict(outcomes_of(list(jobs.values()), workers, case.name, progress_for))
    outcomes, unusable = {job: found[place] for place, job in enumerate(jobs)}, 0 if store is None else store.unusable
    return Grid(plan, case, {trial: tuple(outcomes[job] for job in of) for trial, of in of_trial.items()}, unusable)


def _all_that_it_depends_on(unit: Unit) -> Hashable:
    """Return a key that two units share which come to the same run, as where a setting has its default."""
    settings = settings_of_a_run(unit.settings, unit.estimator)
    return unit.recording, unit.estimator, msgspec.json.encode(settings, order="deterministic")


def _plan_of(plan: Plan, trial: Trial) -> Plan:
    values = with_changes(as_values(plan.settings), dict(trial.changes))
    settings = settings_of(values, f"{trial.estimator} {trial}")
    entry = _entry(plan, trial)
    check_options(settings, {*plan.own, *([] if entry is None else [entry.name])})
    if entry is not None:
        entry.check_usable(settings)
    return replace(plan, estimators=(trial.estimator,), settings=settings, keep=plan.keep | trial.keep)


def _entry(plan: Plan, trial: Trial) -> EstimatorEntry | None:
    return None if trial.estimator in plan.own else find(trial.estimator)


def _units(plans: Mapping[Trial, Plan], case: Prepared) -> Iterator[tuple[Trial, Unit]]:
    """Yield the work: seed by seed and recording by recording, the estimators that take longest first."""
    one = next(iter(plans.values()))
    source = case.source if one.scheduler is None else located(case.source)
    # Where faults are planted in a part of a recording, noise is measured on that part: then so it is without any.
    is_part = (one.part, one.max_frames) != (WHOLE, None)
    clean = () if is_part and any(trial.faults for trial in plans) else None
    for seed in one.seeds:
        units = []
        for trial, plan in plans.items():
            entry, build = _entry(plan, trial), plan.own.get(trial.estimator)
            name = trial.estimator if entry is None else entry.name
            recording = plan.recording(source, seed, trial.faults or clean)
            units.append((trial, Unit(recording, seed, name, plan.settings, build, entry=entry)))
        alike = {recording: i for i, recording in enumerate(dict.fromkeys(unit.recording for _, unit in units))}
        yield from sorted(units, key=lambda pair: (alike[pair[1].recording], -_rung(pair[1])))


def _rung(unit: Unit) -> int:
    return 0 if unit.entry is None else unit.entry.rung() or 0
