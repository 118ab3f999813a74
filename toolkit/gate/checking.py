"""The whole gate: measures a new baseline, or an old one again, and compares what is missing, tested or has a bound.

On a recording results are the same every time, up to rounding, so that any change is real. It is shown from one part in
a million on, and fails beyond its bound in either direction.

A change of a metric's formula is told apart from one of the trajectory: where the errors of positions, the reprojection
of withheld tracks or the NEES are the same to six digits under every seed, so are the poses, and any of the others that
moved by a thousandth is computed differently. A NEES may move with the covariance alone and is never called changed.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from toolkit.answers import Status
from toolkit.experiment.recording import prepare
from toolkit.gate.baseline import (
    COVERAGE,
    DEFAULT_BOUNDS,
    SPEED,
    Baseline,
    BoundsRecord,
    Case,
    Criterion,
    Measured,
    SeriesRecord,
    Values,
    installed_releases,
)
from toolkit.gate.interleaved import compare_speed
from toolkit.gate.measuring import measure, recordings_of
from toolkit.gate.significance import Pairs, check_metrics
from toolkit.gate.verdict import FAILURES, Check, Finding, Verdict, Where, verdict_on
from toolkit.geometry import Array
from toolkit.progress import ProgressFor, silent
from toolkit.registry import check_options, find_all
from toolkit.settings import DEFAULTS, Settings

_SEVERITY: dict[Status, int] = {"ok": 0, "diverged": 1, "failed": 2}
SHOWN = 1e-6
# Fewer timed runs than this scatter too much to be checked (docs/gate.md).
FEWEST_TIMED = 16
Sides = tuple[Array, Array]

_STILL, _MOVED = 1e-6, 1e-3
_SAME_POSES_BY = {"ate_": ("heldout_", "nees_"), "rpe_": ("heldout_", "nees_"), "heldout_": ("ate_", "nees_")}


@dataclass(frozen=True)
class CheckTerms:
    """Terms of the check: whether time counts, and whether a metric that moved passes unless it is worse."""

    speed: bool = True
    accept_better: bool = False


USUAL_TERMS = CheckTerms()


@dataclass
class CaseVerdicts:
    """Verdicts that are decided already, notes, and metrics to be tested together with those of the whole check."""

    verdicts: list[Verdict] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    tests: list[Pairs] = field(default_factory=list)

    def add(self, other: "CaseVerdicts") -> None:
        self.verdicts += other.verdicts
        self.tests += other.tests
        self.notes += other.notes


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
        collected.add(CaseVerdicts(*compare_speed(baseline, speed_against, baseline.false_alarm_rate, progress_for)))
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
    return Check.of(
        verdicts, baseline=name, notes=notes, false_alarm_rate=rate, tests=len(tested), releases=installed_releases(),
        seconds=seconds, accept_better=terms.accept_better,
    )  # fmt: skip


def check_case(
    case: Case, before: Measured, now: Measured, bounds: BoundsRecord, terms: CheckTerms = USUAL_TERMS
) -> CaseVerdicts:
    collected = CaseVerdicts()
    if wrong := now.unreadable or _other_measurements(case, before, now):
        collected.verdicts.append(_missing(case, "", "sequence", wrong))
        return collected
    if before.hashes != now.hashes:
        collected.notes.append(
            f"{case.source}: the same measurements except for their last bits, which this processor rounds differently"
        )
    for estimator, was in before.runs.items():
        is_ = None if estimator in now.absent else now.runs.get(estimator)
        if is_ is None:
            why = now.absent.get(estimator, "it was not run")
            collected.verdicts.append(_missing(case, estimator, "estimator", why))
        elif (runs := min(len(is_.status), len(is_.speed))) != len(was.status):
            fewer = f"it has {runs} runs, the baseline has {len(was.status)}"
            collected.verdicts.append(_missing(case, estimator, "seeds", fewer))
        else:
            sides = _Sides(case, estimator, was, is_, bounds, terms, collected)
            sides.check_ends(now.why.get(estimator, ""))
            sides.check_metrics()
            if terms.speed:
                sides.check_speed()
    few = [name for name, was in before.runs.items() if _timed(was).size < FEWEST_TIMED]
    if terms.speed and few:
        of = f"{case.source}: the time of {', '.join(few)}"
        collected.notes.append(f"{of} is not checked: fewer than {FEWEST_TIMED} timed runs in the baseline")
    return collected


def _other_measurements(case: Case, before: Measured, now: Measured) -> str:
    """Say under which seeds the estimators read other measurements than for the baseline; empty where there are none.

    A seed without a hash had no completed run; its statuses fail the check.
    """
    if len(now.fingerprints) != len(before.fingerprints):
        return f"{len(now.fingerprints)} runs, the baseline has {len(before.fingerprints)}"
    sides = zip(case.seeds, before.fingerprints, now.fingerprints, strict=True)
    others = [str(seed) for seed, was, is_ in sides if was and is_ and was != is_]
    if not others:
        return ""
    which = f" under seed {', '.join(others)}" if case.simulated else ""
    return f"other measurements than the baseline's{which}: the two cannot be compared, make a new baseline"


def _missing(case: Case, estimator: str, what: str, why: str, output: str = "") -> Verdict:
    return verdict_on(Where(case.source, estimator, output, what), "missing", " ".join(why.split()))


@dataclass(frozen=True)
class _Sides:
    """One estimator on a case in the baseline and now, as many runs on both sides; what is found is ``collected``."""

    case: Case
    estimator: str
    before: SeriesRecord
    now: SeriesRecord
    bounds: BoundsRecord
    terms: CheckTerms
    collected: CaseVerdicts

    def check_ends(self, why: str) -> None:
        """Fail where runs end differently than before; where that is accepted, note those that end well now."""
        pairs = list(zip(self.case.seeds, self.before.status, self.now.status, strict=True))
        worse = [(seed, is_) for seed, was, is_ in pairs if _SEVERITY[is_] > _SEVERITY[was]]
        if worse:
            runs = f"under seed {', '.join(str(seed) for seed, _ in worse)}" if self.case.simulated else ""
            self._tell("status", "regressed", f"{worse[0][1]} {runs}".strip() + (f": {why}" if why else ""))
        better = [seed for seed, was, is_ in pairs if _SEVERITY[is_] < _SEVERITY[was]]
        words = f"ends better in {len(better)} runs than before"
        if better and (worse or self.terms.accept_better):
            self._note(f"{self.estimator} {words}")
        elif better:
            self._tell("status", "moved", words)

    def check_metrics(self) -> None:
        ends = zip(self.before.status, self.now.status, strict=True)
        usable = [i for i, (was, is_) in enumerate(ends) if was == is_ == "ok"]
        if not usable:
            self._note(f"{self.estimator} has no run that ended well on both sides, nothing is compared")
            return
        criteria = self.bounds.simulated if self.case.simulated else self.bounds.recorded
        for output, metrics in self.before.outputs.items():
            given = self.now.outputs.get(output, {})
            lost = {key: why for key, values in metrics.items() if (why := _lost(values, given.get(key), usable))}
            self.collected.verdicts += [
                _missing(self.case, self.estimator, key, why, output) for key, why in lost.items()
            ]
            shared = {key: _shared(values, given[key], usable) for key, values in metrics.items() if key not in lost}
            changed = changed_metrics(shared)
            for key in criteria:
                if key in changed:
                    self._tell_changed(output, key, shared[key], changed[key])
                elif key in shared and shared[key][0].size:
                    where = Where(self.case.source, self.estimator, output, key)
                    self._check_metric(Pairs(where, criteria[key], *shared[key]))
            self._check_coverage(output, metrics.get(COVERAGE, ()), given.get(COVERAGE, ()))

    def _check_metric(self, pairs: Pairs) -> None:
        """Put a metric among the tests, or hold it to its bound: of one run no test can tell chance."""
        now = pairs.after
        if self.case.simulated and now.size > 1:
            self.collected.tests.append(pairs)
            return
        if self.case.simulated:
            self._note(
                f"{self.estimator} has one seed to compare, too few to test; it is held to the margins as bounds"
            )
        if np.ptp(now) > SHOWN * np.abs(now).max():
            self._note(f"{self.estimator}'s {pairs.where.metric} has changed in every run")
        medians = float(np.median(pairs.before)), float(np.median(now))
        accept_better = self.terms.accept_better
        verdict = check_recorded(pairs.where, pairs.criterion, *medians, accept_better=accept_better)
        self.collected.verdicts.append(verdict)

    def _tell_changed(self, output: str, key: str, values: Sides, unchanged: str) -> None:
        was, is_ = (float(np.median(side)) for side in values)
        words = (
            f"{was:.7g} became {is_:.7g} while {unchanged} is the same in every run: the poses did not change, "
            "but how this is computed from them; make a new baseline if that is meant"
        )
        self._tell(key, "changed metric", words, was, is_, 100.0 * (is_ / was - 1.0) if was else None, output=output)

    def _check_coverage(self, output: str, before: Values, now: Values) -> None:
        """Fail where any seed lost more of its frames than allowed: scores over fewer frames are not comparable."""
        both = zip(before, now, strict=False)  # a lost one has a verdict of its own
        pairs = [(was, is_) for was, is_ in both if was is not None and is_ is not None]
        if not pairs:
            return
        lost, allowed = max(was - is_ for was, is_ in pairs), self.bounds.coverage_points
        words = f"a run lost {lost:.1f} percent of its frames, {allowed:g} are allowed" if lost > allowed else ""
        was, is_ = (float(np.mean(side)) for side in zip(*pairs, strict=True))
        self._tell(COVERAGE, "regressed" if words else "same", words, was, is_, output=output)

    def check_speed(self) -> None:
        """Check the median over the runs of the time over the reference workload's; few runs are not checked."""
        was, is_ = _timed(self.before), _timed(self.now)
        if was.size < FEWEST_TIMED:
            return
        if lost := sum(a is not None and b is None for a, b in zip(self.before.speed, self.now.speed, strict=True)):
            words = f"{lost} of {was.size} runs have no time any more"
            self.collected.verdicts.append(_missing(self.case, self.estimator, SPEED, words))
        if is_.size < FEWEST_TIMED:
            return
        old, new, most = float(np.median(was)), float(np.median(is_)), self.bounds.speed_ratio
        finding: Finding = "regressed" if new > most * old else "better" if old > most * new else "same"
        words = {
            "regressed": f"{new / old:.2f} times the time, over the reference's; {most:g} is allowed",
            "better": f"{old / new:.2f} times as fast",
        }.get(finding, "")
        self._tell(SPEED, finding, words, old, new, 100.0 * (new / old - 1.0), 100.0 * (most - 1.0))

    def _tell(self, metric: str, finding: Finding, words: str, *numbers: float | None, output: str = "") -> None:
        where = Where(self.case.source, self.estimator, output, metric)
        self.collected.verdicts.append(verdict_on(where, finding, words, *numbers))

    def _note(self, words: str) -> None:
        self.collected.notes.append(f"{self.case.source}: {words}")


def _lost(before: Values, now: Values | None, usable: list[int]) -> str:
    if now is None:
        return "it has no value any more"
    if len(now) != len(before):
        return f"it has {len(now)} values, the baseline has {len(before)}"
    gone = [i for i in usable if before[i] is not None and now[i] is None]
    return f"it has no value any more in {len(gone)} of {len(usable)} runs" if gone else ""


def _shared(before: Values, now: Values, usable: list[int]) -> Sides:
    both = [(was, is_) for i in usable if (was := before[i]) is not None and (is_ := now[i]) is not None]
    table = np.array(both, dtype=float).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _timed(series: SeriesRecord) -> Array:
    return np.array([x for x in series.speed if x is not None])


def check_recorded(
    where: Where, criterion: Criterion, before: float, after: float, *, accept_better: bool = False
) -> Verdict:
    """Judge one value of a recorded sequence; a move by more than the bound fails either way, unless accepted."""
    worse = _worsening(criterion, before, after)
    bound = criterion.percent / 100.0
    finding: Finding = "same"
    if not math.isclose(after, before, rel_tol=SHOWN, abs_tol=0.0):
        finding = "worse" if worse > 0.0 else "better"
        if worse > bound:
            finding = "regressed"
        elif _distance(before, after) > bound and not accept_better:
            finding = "moved"
    message = "" if finding == "same" else f"{before:.7g} became {after:.7g}"
    if finding in FAILURES:
        moved = f"{100.0 * _distance(before, after):.3g} % of the smaller"
        by = f"{100.0 * worse:.3g} % worse" if finding == "regressed" else moved
        message += f", {by}, and {criterion.percent:g} % is allowed"
    change = 100.0 * (after / before - 1.0) if before else None
    return verdict_on(where, finding, message, before, after, change, criterion.percent)


def _worsening(criterion: Criterion, before: float, after: float) -> float:
    """Return how much worse a value is, as a fraction; how much farther from 1, of that ratio, where 1 is ideal."""
    if criterion.worse == "larger":
        return after / before - 1.0 if before > 0.0 else math.inf * (after > before)
    if min(before, after) <= 0.0:
        return math.inf * (after != before)
    return math.expm1(abs(math.log(after)) - abs(math.log(before)))


def _distance(before: float, after: float) -> float:
    if min(before, after) <= 0.0:
        return math.inf * (after != before)
    return math.expm1(abs(math.log(after / before)))


def changed_metrics(values: Mapping[str, Sides]) -> dict[str, str]:
    """Return the metrics of one output whose formula changed, each with the metric that proves it.

    ``values`` are those before and now (n,) of each metric, under the seeds that both sides have.
    """
    found = {}
    for key, sides in values.items():
        families = next((given for family, given in _SAME_POSES_BY.items() if key.startswith(family)), ())
        unchanged = [other for other in values if other.startswith(families) and _is_still(values[other])]
        if families and unchanged and _has_moved(sides):
            found[key] = unchanged[0]
    return found


def _is_still(sides: Sides) -> bool:
    before, after = sides
    return bool(before.size) and bool(np.all(np.abs(after - before) <= _STILL * np.abs(before)))


def _has_moved(sides: Sides) -> bool:
    before, after = sides
    return bool(before.size) and float(np.median(np.abs(after - before) - _MOVED * np.abs(before))) > 0.0
