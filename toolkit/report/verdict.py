"""The verdict: one paragraph that says who is most accurate, how certain that is, whose covariance holds, at what cost.

Only differences that a paired test supports are called differences (:mod:`toolkit.experiment.contests`).
"""

import math
from typing import Annotated

from msgspec import Meta, Struct

from toolkit.answers import Output
from toolkit.experiment.comparison import NEES, Comparison, Row
from toolkit.experiment.contests import CONFIDENCE, COST, HELD_OUT, Contest, Question, cheaper_near
from toolkit.files.documents import rounded
from toolkit.metrics import metrics_called
from toolkit.registry import discover
from toolkit.report.text import listed, number

# An estimator is named as nearly as good where its error is within this factor, and it saves this share of the time.
_NEAR, _SAVES = 1.25, 0.2


class Rival(Struct, frozen=True, kw_only=True):
    """A row of a contest; of the first one, its advantage is null."""

    estimator: str
    output: Output
    value: Annotated[float, Meta(description="of the metric; over seeds the mean")]
    ratio: Annotated[float | None, Meta(description="how many times as much it drifts, or errs, as the first")]
    interval: Annotated[tuple[float, float] | None, Meta(description="99 % of the ratio; null with too few data")]


class ContestRecord(Struct, frozen=True, kw_only=True):
    """Rows ranked by an error, and whether any is better than all others by more than chance."""

    question: Question
    metric: Annotated[str, Meta(description="key of the error they are ranked by")]
    by: Annotated[str, Meta(description="what the test is over: stretches of the path or of time, or seeds")]
    rivals: Annotated[tuple[Rival, ...], Meta(description="from the least error up")]
    leaders: Annotated[tuple[str, ...], Meta(description="estimators that may be the best; one where it is decided")]
    winner: Annotated[
        str | None, Meta(description="the only leader, unless its stated uncertainty is marked; else null")
    ]


def verdict(comparison: Comparison) -> str:
    """Return the verdict on a comparison in a few sentences."""
    contest = main_contest(comparison)
    if contest is None:
        return _of_few(comparison)
    runs = f"{len(comparison.seeds)} seeds" if comparison.over_seeds else "one run"
    best = contest_text(contest_record(contest), runs, contest.rows[0].mark)
    limits = "Withheld tracks show errors over a few frames, not the distance from the true path."
    sentences = (
        *(best, limits if contest.metric == HELD_OUT else ""),
        *(_trust(comparison), _cost(contest), why_sentence(contest)),
    )
    return " ".join(filter(None, sentences))


def main_contest(comparison: Comparison) -> Contest | None:
    """Return the contest that the verdict is about: the accuracy in the end, else by the withheld tracks; or None."""
    by_question = {contest.question: contest for contest in comparison.contests}
    wanted = ("accuracy in the end", "accuracy at each frame", "withheld tracks")
    return next((by_question[question] for question in wanted if question in by_question), None)


def _of_few(comparison: Comparison) -> str:
    ended = [row.estimator for row in comparison.lines if row.answered and row.counts["ok"] == len(row.outcomes)]
    if not ended:
        return "No run ended well: there is nothing to compare."
    return f"Nothing to compare: only {listed(ended)} can be scored here. {_trust(comparison)}".strip()


def contest_record(contest: Contest) -> ContestRecord:
    """Return a contest as report.json has it."""
    found = (None, *contest.advantages)
    return ContestRecord(
        question=contest.question,
        metric=contest.metric,
        by=next((one.parts for one in contest.advantages if one is not None), "nothing: too few data"),
        rivals=tuple(
            Rival(
                estimator=row.estimator,
                output=row.output,
                value=row.value(contest.metric) or 0.0,
                ratio=None if one is None else rounded(one.ratio),
                interval=None if one is None else (rounded(one.low), rounded(one.high)),
            )
            for row, one in zip(contest.rows, found, strict=True)
        ),
        leaders=tuple(row.estimator for row in contest.leaders),
        winner=None if contest.winner is None else contest.winner.estimator,
    )


def contest_text(contest: ContestRecord, runs: str, mark: str) -> str:
    """Say who is best, or that nobody is by more than chance, and how much worse the next one is.

    ``runs`` says over how many runs the contest is, as in "one run", and ``mark`` what the first row is marked as.
    """
    first, *others = contest.rivals
    metric = metrics_called((contest.metric,))[0]
    leaders = [one for one in contest.rivals if one.estimator in contest.leaders]

    def value_of(one: Rival) -> str:
        return f"{number(one.value)} {metric.unit}"

    if len(leaders) == 1 and mark:
        return f"No winner: {first.estimator} leads ({metric.column} {value_of(first)}) but is {mark}."
    if len(leaders) == 1:
        claim = "predicts withheld tracks best" if contest.metric == HELD_OUT else "is most accurate"
        text = f"{first.estimator} {claim} ({metric.column} {value_of(first)}, {runs})"
    else:
        given = f"{number(first.value)} to {value_of(leaders[-1])}"
        text = f"No clear winner between {listed(contest.leaders)} ({metric.column} {given}, {runs})"
    # The next one that is worse by more than chance, if possible one that is not nearly as good.
    worse = [one for one in others if one not in leaders]
    next_one = next((one for one in worse if one.value > _NEAR * first.value), worse[0] if worse else None)
    if next_one is None or next_one.ratio is None or next_one.interval is None:
        return f"{text}."
    does = "errs" if contest.metric == HELD_OUT or contest.by == "seeds" else "drifts"
    low, high = map(number, next_one.interval)
    factor = f"{number(next_one.ratio)} times ({100 * CONFIDENCE:.0f} %: {low} to {high})"
    return f"{text}; {next_one.estimator} ({value_of(next_one)}) {does} {factor} as much."


def why_sentence(contest: Contest) -> str:
    """Name the command that says why the first is better than the worst of the others; nothing where none can."""
    explained = {name for name, entry in discover().items() if entry.ingredients()}  # that say what they have
    rows = (contest.rows[0], *(row for row, _ in contest.worse))
    able = [row.estimator for row in rows if row.estimator in explained]
    if len(able) < 2 or able[0] != contest.rows[0].estimator:
        return ""
    return f"Why: vislam explain with --from {able[-1]} --to {able[0]}."


def _trust(comparison: Comparison) -> str:
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
