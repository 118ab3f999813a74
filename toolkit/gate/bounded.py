"""Judged against a bound instead of by a test: recorded sequences, coverage, speed, and whether anything is there.

A recording is the same every time and so is what is computed from it, up to rounding: any change is real. It is shown
from one part in a million on, and fails beyond its bound in either direction.
"""

import math
from collections.abc import Iterator

import numpy as np

from toolkit.gate.baseline import COVERAGE, Bounds, Case, Criterion, Series, Values
from toolkit.gate.paired import Where
from toolkit.gate.verdict import FAILURES, Finding, Verdict

SHOWN = 1e-6
# Fewer timed runs than this scatter too much to be judged (docs/gate.md).
FEWEST_TIMED = 16
_SPEED = "speed"


def judge_recorded(
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
    words = "" if finding == "same" else f"{before:.7g} became {after:.7g}"
    if finding in FAILURES:
        by = f"{100.0 * worse:.3g} % worse" if finding == "regressed" else f"{100.0 * _distance(before, after):.3g} %"
        words += f", {by}, and {criterion.percent:g} % is allowed"
    return Verdict(
        where.sequence, where.estimator, where.output, where.metric, finding, words,
        before, after, 100.0 * (after / before - 1.0) if before else None, criterion.percent,
    )  # fmt: skip


def _worsening(criterion: Criterion, before: float, after: float) -> float:
    """Return how much worse a value is, as a fraction; how much farther from 1, of that ratio, where 1 is ideal."""
    if criterion.worse == "larger":
        return after / before - 1.0 if before > 0.0 else math.inf * (after > before)
    if min(before, after) <= 0.0:
        return math.inf * (after != before)
    return math.expm1(abs(math.log(after)) - abs(math.log(before)))


def _distance(before: float, after: float) -> float:
    """Return how far a value moved, up or down, as a fraction."""
    if min(before, after) <= 0.0:
        return math.inf * (after != before)
    return math.expm1(abs(math.log(after / before)))


def judge_coverage(case: Case, estimator: str, before: Series, now: Series, bounds: Bounds) -> Iterator[Verdict]:
    """Fail where any seed lost more of its frames than allowed; a good score over fewer frames is no good score."""
    for output, metrics in before.outputs.items():
        pairs = _both(metrics.get(COVERAGE, ()), now.outputs.get(output, {}).get(COVERAGE, ()))
        if not pairs:
            continue
        lost = max(was - is_ for was, is_ in pairs)
        was, is_ = (float(np.mean([pair[side] for pair in pairs])) for side in (0, 1))
        too_much = lost > bounds.coverage_points
        words = f"a run lost {lost:.1f} percent of its frames, {bounds.coverage_points:g} are allowed"
        finding: Finding = "regressed" if too_much else "same"
        yield Verdict(case.source, estimator, output, COVERAGE, finding, words if too_much else "", was, is_)


def _both(before: Values, now: Values) -> list[tuple[float, float]]:
    """Return the values before and now of the runs that have both; a lost one has a verdict of its own."""
    return [(was, is_) for was, is_ in zip(before, now, strict=False) if was is not None and is_ is not None]


def judge_speed(case: Case, estimator: str, before: Series, now: Series, bounds: Bounds) -> Iterator[Verdict]:
    """Judge the median over the runs of the time over the reference workload's; few runs are not judged."""
    was, is_ = (np.array([x for x in series.speed if x is not None]) for series in (before, now))
    if min(was.size, is_.size) < FEWEST_TIMED:
        return
    old, new = float(np.median(was)), float(np.median(is_))
    finding: Finding = "same"
    if new > bounds.speed_ratio * old:
        finding = "regressed"
    elif old > bounds.speed_ratio * new:
        finding = "better"
    words = {
        "regressed": f"{new / old:.2f} times the time, over the reference's; {bounds.speed_ratio:g} is allowed",
        "better": f"{old / new:.2f} times as fast",
    }.get(finding, "")
    allowed = 100.0 * (bounds.speed_ratio - 1.0)
    yield Verdict(case.source, estimator, "", _SPEED, finding, words, old, new, 100.0 * (new / old - 1.0), allowed)
