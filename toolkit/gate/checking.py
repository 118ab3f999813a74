"""The whole gate: measure a new baseline, or measure an old one again and test the differences."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

from toolkit.experiment.recording import prepare
from toolkit.gate.baseline import DEFAULT_BOUNDS, Baseline, Case, installed_releases
from toolkit.gate.case_check import USUAL_TERMS, CaseVerdicts, CheckTerms, check_case
from toolkit.gate.interleaved import compare_speed
from toolkit.gate.measuring import measure, recordings_of
from toolkit.gate.significance import check_metrics
from toolkit.gate.verdict import Check
from toolkit.progress import ProgressFor, silent
from toolkit.registry import check_options, find_all
from toolkit.settings import DEFAULTS, Settings


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
    measured = tuple((case, measure(case, DEFAULT_BOUNDS, settings, workers, progress_for)) for case in cases)
    return Baseline(installed_releases(), measured, made_by=made_by, settings=settings)


def check(
    baseline: Baseline,
    name: str,
    workers: int,
    progress_for: ProgressFor,
    terms: CheckTerms = USUAL_TERMS,
    speed_against: str | None = None,
) -> Check:
    """Measure again what a baseline lists, and compare. Whatever is missing is a verdict, not an error.

    ``speed_against`` names another version of the code, a git revision or a wheel, to take turns with for speed, which
    is then not checked by the terms. Raises BaselineError where it cannot be found or timed.
    """
    began, collected = time.monotonic(), CaseVerdicts()
    if speed_against is not None:
        terms = replace(terms, speed=False)
        collected.add(compare_speed(baseline, speed_against, baseline.false_alarm_rate, progress_for))
    for case, before in baseline.cases:
        now = measure(case, baseline.bounds, baseline.settings, workers, progress_for)
        collected.add(check_case(case, before, now, baseline.bounds, terms))
    return check_all(collected, baseline, name, time.monotonic() - began, terms)


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
    notes, rate = tuple(dict.fromkeys(collected.notes)), baseline.false_alarm_rate
    releases = installed_releases()
    return Check(name, tuple(verdicts), notes, rate, len(tested), releases, seconds, terms.accept_better)
