"""The verdict: one paragraph that says who is most accurate, how certain that is, whose covariance holds, at what cost.

Only differences that a paired test supports are called differences (:mod:`toolkit.experiment.contests`).
"""

import math

from toolkit.experiment.comparison import NEES, Comparison, Row
from toolkit.experiment.contests import COST, HELD_OUT, Contest, cheaper_near
from toolkit.experiment.drift_test import CONFIDENCE, Advantage
from toolkit.metrics import metrics_called
from toolkit.report.text import listed, number

# An estimator is named as nearly as good where its error is within this factor, and it saves this share of the time.
_NEAR, _SAVES = 1.25, 0.2


def verdict(comparison: Comparison) -> str:
    """Return the verdict on a comparison in a few sentences."""
    contest = main_contest(comparison)
    if contest is None:
        return _of_few(comparison)
    sentences = (_accuracy(contest, comparison.over_seeds), _limits(contest), _trust(comparison), _cost(contest))
    return " ".join(filter(None, sentences))


def main_contest(comparison: Comparison) -> Contest | None:
    """Return the contest that the verdict is about: the accuracy in the end, else by the withheld tracks; or None."""
    by_question = {contest.question: contest for contest in comparison.contests}
    wanted = ("accuracy in the end", "accuracy at each frame", "withheld tracks")
    return next((by_question[question] for question in wanted if question in by_question), None)


def advantage_text(found: Advantage) -> str:
    """Return a factor with its interval, as in "2.2 times (99 %: 1.4 to 3.7)"."""
    return f"{number(found.ratio)} times ({100 * CONFIDENCE:.0f} %: {number(found.low)} to {number(found.high)})"


def _of_few(comparison: Comparison) -> str:
    """Return the verdict where fewer than two runs can be compared."""
    ended = [row.estimator for row in comparison.lines if row.answered and row.counts["ok"] == len(row.outcomes)]
    if not ended:
        return "No run ended well: there is nothing to compare."
    return f"Nothing to compare: only {listed(ended)} can be scored here. {_trust(comparison)}".strip()


def _accuracy(contest: Contest, over_seeds: bool) -> str:
    """Say who is most accurate, or that nobody is by more than chance, and how much worse another is."""
    first, leaders = contest.rows[0], contest.leaders
    name = metrics_called((contest.metric,))[0].column
    if len(leaders) == 1 and first.mark:
        return f"No winner: {first.estimator} leads ({name} {_with_unit(contest, first)}) but is {first.mark}."
    if len(leaders) == 1:
        claim = "predicts withheld tracks best" if contest.metric == HELD_OUT else "is most accurate"
        opening = f"{first.estimator} {claim} ({name} {_with_unit(contest, first)}"
    else:
        least = number(first.value(contest.metric) or 0.0)
        given = f"{least} to {_with_unit(contest, leaders[-1])}"
        opening = f"No clear winner between {listed(row.estimator for row in leaders)} ({name} {given}"
    runs = f"{len(first.outcomes)} seeds" if over_seeds else "one run"
    return f"{opening}, {runs}){_beaten(contest, over_seeds)}."


def _beaten(contest: Contest, over_seeds: bool) -> str:
    """Say how much worse the next row is that is worse by more than chance, and not nearly as good; or nothing."""
    if not contest.worse:
        return ""
    far = _NEAR * (contest.rows[0].value(contest.metric) or 0.0)
    worse = [(row, found) for row, found in contest.worse if (row.value(contest.metric) or 0.0) > far]
    row, found = (worse or contest.worse)[0]
    does = "errs" if over_seeds or contest.metric == HELD_OUT else "drifts"
    return f"; {row.estimator} ({_with_unit(contest, row)}) {does} {advantage_text(found)} as much"


def _with_unit(contest: Contest, row: Row) -> str:
    return f"{number(row.value(contest.metric) or 0.0)} {metrics_called((contest.metric,))[0].unit}"


def _limits(contest: Contest) -> str:
    if contest.metric != HELD_OUT:
        return ""
    return "Withheld tracks show errors over a few frames, not the distance from the true path."


def _trust(comparison: Comparison) -> str:
    """Say whose stated uncertainty can be trusted, and by how much the worst other errs more than it states."""
    ended = [row for row in comparison.lines if row.counts["ok"]]
    judged = [row for row in ended if row.consistency is not None]
    if not judged:
        return ""
    sound = [row.estimator for row in judged if not row.mark]
    untested = listed(row.estimator for row in ended if row.consistency is None)
    if sound:
        trusted = f"Trust the stated uncertainty of {listed(sound)}"
    elif untested:
        trusted = f"Trust nobody's stated uncertainty (untested: {untested})"
    else:
        trusted = "Trust nobody's stated uncertainty"
    worst = max(judged, key=_overconfidence)
    errs = _overconfidence(worst)
    return trusted + (f"; {worst.estimator} errs {number(errs, 2)} times what it states." if errs else ".")


def _overconfidence(row: Row) -> float:
    """Return how many times as large errors are as a row states, by its NEES; 0 where there is none."""
    found = row.consistency
    return math.sqrt(found.mean) if found is not None and found.metric == NEES and found.mean > found.high else 0.0


def _cost(contest: Contest) -> str:
    first, near = contest.rows[0], cheaper_near(contest, _NEAR, _SAVES)
    cost = first.value(COST)
    if not cost:
        return ""
    if near is not None:
        more = 100.0 * ((near.value(contest.metric) or 0.0) / (first.value(contest.metric) or 1.0) - 1.0)
        share = number((near.value(COST) or 0.0) / cost, 2)
        return f"{near.estimator} comes within {max(1, math.ceil(more))} % of {first.estimator} in {share} of its time."
    other = contest.worse[0][0] if contest.worse else first
    times = cost / (other.value(COST) or cost)
    return f"{first.estimator} takes {number(times, 2)} times the time of {other.estimator}." if times > 1.0 else ""
