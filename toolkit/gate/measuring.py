"""Run what a baseline lists, in processes side by side, and gather what came of it by estimator, metric and seed."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from typing import cast

from toolkit.errors import EstimatorError, VislamError
from toolkit.estimate import Output
from toolkit.estimator import find
from toolkit.experiment.trial import OUTPUTS, Outcome
from toolkit.experiment.workers import Work, outcomes_of
from toolkit.gate.baseline import COVERAGE, Bounds, Case, Measured, Series, Values
from toolkit.gate.case_work import CaseTrial, Timed, case_sequence, run_case, trials_of

Advance = Callable[[int, int], None]


def measure(case: Case, metrics: Iterable[str], workers: int, advance: Advance) -> Measured:
    """Run every estimator of a case under every seed.

    An estimator that is not there is ``absent``, a sequence that cannot be had ``unreadable``; nothing of that is
    raised, for a check has to say all that is missing. ``advance`` hears how many of all runs are done.
    """
    absent = {name: why for name in case.estimators if (why := _why_absent(name))}
    present = replace(case, estimators=tuple(name for name in case.estimators if name not in absent))
    trials = trials_of(present)
    try:
        if trials:
            case_sequence(trials[0])
        outcomes = list(_outcomes(trials, workers, advance))
    except EstimatorError:
        raise
    except VislamError as error:
        return Measured((), (), {}, absent, unreadable=str(error))
    return gathered(present, outcomes, tuple(metrics), absent)


def metrics_of(case: Case, bounds: Bounds) -> tuple[str, ...]:
    """Return the metrics a case is judged by."""
    return (*(bounds.simulated if case.simulated else bounds.recorded), COVERAGE)


def _why_absent(name: str) -> str:
    try:
        find(name).load()
    except EstimatorError as error:
        return str(error)
    return ""


def _outcomes(trials: Sequence[CaseTrial], workers: int, advance: Advance) -> Iterator[Outcome]:
    total = sum(len(trial.estimators) for trial in trials)
    if total:
        advance(0, total)
    # run_case reads trials of its own kind, which are the only ones given here
    with closing(outcomes_of(trials, workers, cast(Work, run_case))) as coming:
        for done, outcome in enumerate(coming, 1):
            if done < total:
                advance(done, total)
            yield outcome


def gathered(case: Case, outcomes: Iterable[Outcome], metrics: Sequence[str], absent: dict[str, str]) -> Measured:
    """Arrange outcomes, which come in any order, by estimator and seed; keep the metrics of interest."""
    by_run = {(outcome.estimator, outcome.seed): _timed(outcome) for outcome in outcomes}
    read = {timed.seed: timed for timed in by_run.values() if timed.sequence_hash}
    hashes, prints = (
        tuple(getattr(read[seed], name) if seed in read else "" for seed in case.seeds)
        for name in ("sequence_hash", "fingerprint")
    )
    runs = {name: _series([by_run[name, seed] for seed in case.seeds], metrics) for name in case.estimators}
    return Measured(hashes, prints, runs, absent)


def _timed(outcome: Outcome) -> Timed:
    """Return the outcome as a process of ours made it; one whose process died has nothing but its status."""
    if isinstance(outcome, Timed):
        return outcome
    return Timed(outcome.seed, outcome.estimator, outcome.status, log=outcome.log)


def _series(timed: Sequence[Timed], metrics: Sequence[str]) -> Series:
    found = [dict(one.metrics) for one in timed]
    given: list[Output] = [output for output in OUTPUTS if any(output in outputs for outputs in found)]
    values: dict[Output, dict[str, Values]] = {
        output: {key: tuple(outputs.get(output, {}).get(key) for outputs in found) for key in metrics}
        for output in given
    }
    # A metric without any value, as a NEES without a covariance, is none that could get lost.
    kept = {o: {key: v for key, v in by_key.items() if any(x is not None for x in v)} for o, by_key in values.items()}
    return Series(tuple(one.status for one in timed), tuple(one.speed for one in timed), kept, _why(timed))


def _why(timed: Sequence[Timed]) -> str:
    """Return what the first run that did not end well says of it, in one line."""
    for one in timed:
        if one.status != "ok" and one.log:
            return " ".join(one.log[0 if one.status == "failed" else -1].split())
    return ""
