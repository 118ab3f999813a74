"""The verdict: one paragraph that says who is most accurate, how certain that is, whose covariance holds, at what cost.

Only differences that a paired test supports are called differences (:mod:`toolkit.experiment.contests`).
"""

import math
from collections.abc import Iterable, Iterator

from toolkit.experiment.comparison import NEES, Comparison, Row
from toolkit.experiment.contests import COST, HELD_OUT, Contest, cheaper_near
from toolkit.experiment.drift_test import CONFIDENCE, Advantage
from toolkit.metrics import metrics_called

# An estimator is named as nearly as good where its error is within this factor, and it saves this share of the time.
_NEAR, _SAVES = 1.25, 0.2
# More names than these are counted, not listed.
_MOST_NAMES = 4


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


def listed(names: Iterable[str]) -> str:
    """Return names as in a sentence: "a", "a and b", "a, b and c", "a, b, c and 4 more"."""
    given = list(dict.fromkeys(names))
    if len(given) > _MOST_NAMES:
        given = [*given[: _MOST_NAMES - 1], f"{len(given) - _MOST_NAMES + 1} more"]
    return " and ".join(filter(None, (", ".join(given[:-1]), given[-1])))


def short(value: float) -> str:
    """Return a number with three significant digits, without powers of ten up to a million."""
    if value and abs(value) < 1e6:
        decimals = max(0, 2 - math.floor(math.log10(abs(value))))
        return f"{value:.{decimals}f}" if decimals <= 6 else f"{value:.2g}"
    return f"{value:.3g}"


def advantage_text(found: Advantage) -> str:
    """Return a factor with its interval, as in "2.2 times (99 %: 1.4 to 3.7)"."""
    return f"{found.ratio:.3g} times ({CONFIDENCE:.0%}: {found.low:.3g} to {found.high:.3g})".replace("%", " %")


def figures(rows: Iterable[Row], metric: str) -> str:
    """Return the values of rows in a metric with its unit, as in "0.23 and 0.26 m"."""
    values = " and ".join(short(value) for row in rows if (value := row.value(metric)) is not None)
    return f"{values} {metrics_called((metric,))[0].unit}"


def _of_few(comparison: Comparison) -> str:
    """Return the verdict where fewer than two runs can be compared."""
    ended = [row.estimator for row in comparison.lines if row.answered and row.counts["ok"] == len(row.outcomes)]
    if not ended:
        return "No run ended well: there is nothing to compare."
    return f"Nothing to compare: only {listed(ended)} can be scored here. {_trust(comparison)}".strip()


def _accuracy(contest: Contest, over_seeds: bool) -> str:
    first, leaders = contest.rows[0], contest.leaders
    name = metrics_called((contest.metric,))[0].name
    how = "error" if over_seeds else "median error" if contest.metric == HELD_OUT else "drift"
    beaten = ""
    if contest.worse:
        row, found = contest.worse[0]
        beaten = f"{row.estimator}'s {how} is {advantage_text(found)} as large"
    if len(leaders) == 1 and beaten:
        row = contest.worse[0][0]
        claim = "predicts withheld tracks best" if contest.metric == HELD_OUT else "is most accurate"
        return f"{first.estimator} {claim} ({name} {figures((first, row), contest.metric)}); {beaten}."
    apart = f"{name} {figures(leaders[:2], contest.metric)}" if len(leaders) == 2 else _range(leaders, contest.metric)
    seeds = f"{len(first.outcomes)} seeds" if over_seeds else "one run"
    return f"No clear winner between {listed(row.estimator for row in leaders)} ({apart}, {seeds})" + (
        f"; {beaten}." if beaten else "."
    )


def _range(rows: tuple[Row, ...], metric: str) -> str:
    """Return a metric of ranked rows from the least to the largest."""
    known = metrics_called((metric,))[0]
    return f"{known.name} {short(rows[0].value(metric) or 0.0)} to {short(rows[-1].value(metric) or 0.0)} {known.unit}"


def _limits(contest: Contest) -> str:
    if contest.metric != HELD_OUT:
        return ""
    return "Withheld tracks show errors over a few frames; the distance from the true path is unknown."


def _trust(comparison: Comparison) -> str:
    """Say whose stated uncertainty can be trusted, and by how much the worst other errs more than it states."""
    judged = [row for row in comparison.lines if row.consistency is not None and row.counts["ok"]]
    sound = [row.estimator for row in judged if not row.mark]
    if not judged:
        return ""
    rest = [row for row in judged if row.mark]
    parts = [f"Trust the stated uncertainty of {listed(sound)}" if sound else "Trust nobody's stated uncertainty"]
    worst = max(rest, key=_overconfidence, default=None)
    if worst is not None and _overconfidence(worst) > 1.0:
        parts.append(f"{worst.estimator} errs {_overconfidence(worst):.2g} times what it states")
    return "; ".join(parts) + "."


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
        share = (near.value(COST) or 0.0) / cost
        return f"{near.estimator} comes within {max(1, math.ceil(more))} % of it in {share:.2g} of the time."
    other = next((row for row, _ in contest.worse if row.value(COST)), None)
    if other is None:
        return ""
    return f"{first.estimator} takes {cost / (other.value(COST) or cost):.2g} times the time of {other.estimator}."


def verdict_paragraphs(comparison: Comparison) -> Iterator[str]:
    """Yield the verdict as a section of a report."""
    yield verdict(comparison)
