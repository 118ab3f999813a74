"""The whole gate: measure a new baseline, or measure an old one again and test the differences."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from toolkit.experiment.recording import prepare
from toolkit.gate.baseline import DEFAULT_BOUNDS, Baseline, Case, Measured, installed_releases
from toolkit.gate.case_check import USUAL_TERMS, CaseVerdicts, CheckTerms, check_case
from toolkit.gate.interleaved import compare_speed
from toolkit.gate.measuring import measure, metrics_of, recordings_of
from toolkit.gate.significance import check_metrics
from toolkit.gate.verdict import Check
from toolkit.progress import ProgressFor, silent
from toolkit.registry import check_options, find_all
from toolkit.settings import DEFAULTS, Settings


@dataclass(frozen=True)
class How:
    """How to run a check: number of processes, whether time is checked, settings, and what passes.

    ``accept_better`` lets what moved pass unless it is worse; ``speed_against`` names another version of the code, a
    git revision or a wheel, to take turns with for speed.
    """

    workers: int
    speed: bool = True
    settings: Settings = DEFAULTS
    accept_better: bool = False
    speed_against: str | None = None

    @property
    def terms(self) -> CheckTerms:
        """The terms on which each case is checked; speed checked in turns with other code is not checked twice."""
        return CheckTerms(self.speed and self.speed_against is None, self.accept_better)


def new_baseline(
    cases: Sequence[Case],
    workers: int,
    made_by: Mapping[str, str],
    progress_for: ProgressFor = silent,
    settings: Settings = DEFAULTS,
) -> Baseline:
    """Measure a baseline; a check of it will run with the same settings.

    Raises EstimatorError for an estimator that is unknown or cannot be used, DataError for a sequence that cannot be
    read; both before the first run.
    """
    check_options(settings)
    for case in cases:
        for entry in find_all(case.estimators).values():
            entry.check_usable(settings)
        prepare(recordings_of(case, settings)[0])
    how = How(workers, settings=settings)
    measured = tuple((case, _measured(case, metrics_of(case, DEFAULT_BOUNDS), how, progress_for)) for case in cases)
    return Baseline(installed_releases(), measured, made_by=made_by, settings=settings)


def check(baseline: Baseline, name: str, how: How, progress_for: ProgressFor) -> Check:
    """Measure again what a baseline lists, and compare. Whatever is missing is a verdict, not an error.

    Raises BaselineError where another version of the code is asked for and cannot be found or timed.
    """
    began, how = time.monotonic(), replace(how, settings=baseline.settings)
    collected = CaseVerdicts()
    if how.speed_against is not None:
        speeds = compare_speed(baseline, how.speed_against, baseline.false_alarm_rate, progress_for)
        collected.verdicts += speeds.verdicts
        collected.notes += speeds.notes
    for case, before in baseline.cases:
        now = _measured(case, metrics_of(case, baseline.bounds), how, progress_for)
        one = check_case(case, before, now, baseline.bounds, how.terms)
        collected.verdicts += one.verdicts
        collected.tests += one.tests
        collected.notes += one.notes
    return check_all(collected, baseline, name, time.monotonic() - began, how.terms)


def check_all(
    collected: CaseVerdicts, baseline: Baseline, name: str, seconds: float, terms: CheckTerms = USUAL_TERMS
) -> Check:
    """Test all metrics of the check together, and collect the verdicts."""
    tested = check_metrics(collected.tests, baseline.false_alarm_rate, accept_better=terms.accept_better)
    places = {
        (case.source, name): (i, k)
        for i, (case, before) in enumerate(baseline.cases)
        for k, name in enumerate(("", *before.runs))
    }
    verdicts = sorted([*collected.verdicts, *tested], key=lambda v: (places[v.sequence, v.estimator], v.output))
    return Check(
        name,
        tuple(verdicts),
        tuple(dict.fromkeys(collected.notes)),
        baseline.false_alarm_rate,
        len(tested),
        installed_releases(),
        seconds,
        terms.accept_better,
    )


def _measured(case: Case, metrics: Sequence[str], how: How, progress_for: ProgressFor) -> Measured:
    runs = len(case.seeds) * len(case.estimators)
    with progress_for(f"{case.source}: {runs} runs") as progress:
        return measure(case, metrics, how.settings, how.workers, progress)
