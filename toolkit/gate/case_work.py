"""What a process does for the gate: one case under one seed, every estimator timed between two reference workloads."""

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from toolkit import runner
from toolkit.audit import audit
from toolkit.datasets import built_ins, load_sequence
from toolkit.datasets.io.truth_file import load_truth, with_truth
from toolkit.estimate import Output, Run, Status
from toolkit.estimator import find
from toolkit.experiment.trial import OUTPUTS, Outcome, Trial
from toolkit.gate.baseline import Case
from toolkit.gate.fingerprint import fingerprint
from toolkit.gate.reference import reference_s
from toolkit.initialization import start_from_measurements
from toolkit.metrics import score_run
from toolkit.progress import SILENT
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, simulate

DATA_ROOT = "VISLAM_DATA"


@dataclass(frozen=True)
class CaseTrial(Trial):
    """A trial of a case: simulated or cut to ``duration_s``, judged against the file ``truth`` if there is one."""

    duration_s: float | None = None
    truth: str | None = None


@dataclass(frozen=True, eq=False)
class Timed(Outcome):
    """An outcome as the gate keeps it: its metrics by kind of output, and its time over the reference's."""

    metrics: tuple[tuple[Output, dict[str, float | None]], ...] = ()
    speed: float | None = None
    fingerprint: str = ""


def trials_of(case: Case) -> list[CaseTrial]:
    """Return the trials of a case: one a seed; a recording has few seeds, so there each estimator is one as well.

    Files are found here, by whole paths: a process that runs a trial may stand elsewhere, in another environment.
    """
    groups = [case.estimators] if case.simulated else [(name,) for name in case.estimators]
    source, truth = located(case.source), None if case.truth is None else located(case.truth)
    return [
        CaseTrial(source, seed, group, start_from_measurements, duration_s=case.duration_s, truth=truth)
        for seed in case.seeds
        for group in groups
    ]


def case_sequence(trial: CaseTrial) -> Sequence:
    """Return the sequence as the estimators read it: simulated or loaded, audited and cut.

    Raises DataError where it cannot be had.
    """
    if trial.source in SCENARIOS and trial.duration_s is not None:
        scenario = replace(SCENARIOS[trial.source], duration_s=trial.duration_s)
        return audit(simulate(scenario, trial.seed)).sequence
    sequence = load_sequence(located(trial.source), trial.seed)
    if trial.truth is not None:
        sequence = with_truth(sequence, load_truth(Path(located(trial.truth))))
    sequence = audit(sequence).sequence
    if trial.duration_s is None:
        return sequence
    end_ns = sequence.frames_t_ns[0] + round(trial.duration_s * NS_PER_S)
    return sequence.truncated(int((sequence.frames_t_ns <= end_ns).sum()))


def located(source: str) -> str:
    """Return a built-in name as it is, and a path where it leads: from here, or from the folder VISLAM_DATA."""
    if source in built_ins():
        return source
    root, here = os.environ.get(DATA_ROOT), Path(source).expanduser()
    places = [here] if root is None else [here, Path(root).expanduser() / source]
    return next((str(place.absolute()) for place in places if place.exists()), source)


def run_case(trial: CaseTrial) -> Iterator[Timed]:
    """Run the estimators of a trial one after the other; yield each outcome as it is there."""
    sequence = case_sequence(trial)
    prior, content, rounded = trial.start(sequence), sequence.content_hash(), fingerprint(sequence)
    reference_s()  # warms up what every later one finds warm
    before_s = reference_s()
    for name in trial.estimators:
        run = runner.run(name, find(name).load(), sequence, prior, SILENT)
        after_s = reference_s()
        yield Timed(
            trial.seed, name, run.status, log=run.log, sequence_hash=content,
            metrics=scored(run, sequence), speed=_over(run, (before_s + after_s) / 2.0), fingerprint=rounded,
        )  # fmt: skip
        before_s = reference_s()


def scored(run: Run, sequence: Sequence) -> tuple[tuple[Output, dict[str, float | None]], ...]:
    """Return the metrics of every kind of output of a run; of a final one only where it is not the causal one."""
    given: list[Output] = [output for output in OUTPUTS if run.trajectory(output) is not None]
    if run.final_is_causal:
        given = ["causal"]
    return tuple((output, score_run(run, output, sequence).values) for output in given)


def _over(run: Run, reference: float) -> float | None:
    """Return a run's processor time over the reference's; of a run cut short it would say nothing."""
    ended: tuple[Status, ...] = ("ok", "diverged")
    return run.timings.cpu_s / reference if run.timings is not None and run.status in ended else None
