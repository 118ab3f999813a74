"""The answers a reader looks for first, as cards: who is most accurate, whose uncertainty to trust, who is fastest.

A card names a winner only where the run directory's contests do; a row with a mark wins nothing.
"""

from collections.abc import Iterator, Sequence
from typing import Any

from toolkit.metrics import metrics_called
from toolkit.report.report_json import ContestRecord, Rival
from toolkit.report.text import listed, number

Row = dict[str, Any]
_TITLES = {
    "accuracy at each frame": "Most accurate at each frame (causal)",
    "accuracy in the end": "Most accurate in the end (final)",
    "withheld tracks": "Best on withheld tracks",
}
_UNDECIDED = "no clear winner"
_COST = "frame_cpu_ms_mean"
# The processor time of one run scatters: nobody is called faster by less than this factor.
_FASTER = 1.5


def highlights(contests: Sequence[ContestRecord], rows: Sequence[Row], runs: str) -> list[dict[str, str | None]]:
    """Return a card for each question: its text, the answer, the answer's row or None, the figures and the next.

    ``rows`` are those of the page's table; ``runs`` says over how many runs a contest is, as in "one run".
    """
    return [*(_of_contest(contest, rows, runs) for contest in contests), *_uncertainty(rows), *_fastest(rows)]


def _card(question: str, answer: str, detail: str, after: str = "", row: Row | None = None) -> dict[str, str | None]:
    return {
        "question": question,
        "answer": answer,
        "row": None if row is None else row["id"],
        "detail": detail,
        "next": after,
    }


def _of_contest(contest: ContestRecord, rows: Sequence[Row], runs: str) -> dict[str, str | None]:
    first, second = contest.rivals[:2]
    question, row = _TITLES[contest.question], _row_of(first, rows)
    after = f"{_figure(second, contest)}, {second.estimator}{_how_much(second, contest)}"
    if contest.winner is not None:
        return _card(question, first.estimator, _figure(first, contest), f"next: {after}", row)
    if len(contest.leaders) == 1:
        mark = "" if row is None else row["mark"]
        leads = f"{first.estimator} leads with {_figure(first, contest)}, but is {mark}"
        return _card(question, "no winner", leads, f"next: {after}")
    last = next(one for one in reversed(contest.rivals) if one.estimator in contest.leaders)
    apart = 100.0 * (last.value / first.value - 1.0) if first.value else 0.0
    return _card(question, _UNDECIDED, f"{listed(contest.leaders)}: {number(apart, 2)} % apart, {runs}", after)


def _figure(rival: Rival, contest: ContestRecord) -> str:
    known = metrics_called((contest.metric,))[0]
    return f"{number(rival.value)} {known.unit} {known.column}"


def _how_much(rival: Rival, contest: ContestRecord) -> str:
    if rival.ratio is None or rival.interval is None:
        return ""
    low, high = map(number, rival.interval)
    return f"; {number(rival.ratio)} times as much (99 %: {low} to {high}) over {contest.by}"


def _row_of(rival: Rival, rows: Sequence[Row]) -> Row | None:
    outputs = (rival.output, "both")
    return next((row for row in rows if row["estimator"] == rival.estimator and row["output"] in outputs), None)


def _uncertainty(rows: Sequence[Row]) -> Iterator[dict[str, str | None]]:
    """Yield whose stated uncertainty can be trusted, where any is tested; that is no contest."""
    tested = [row for row in rows if row["judged"]]
    if tested:
        sound = [row["estimator"] for row in tested if not row["mark"] and row["good"]]
        marked = [f"{row['estimator']} is {row['mark']}" for row in tested if row["mark"]]
        yield _card("Stated uncertainty to trust", listed(sound) if sound else "nobody's", listed(marked))


def _fastest(rows: Sequence[Row]) -> Iterator[dict[str, str | None]]:
    """Yield who takes the least processor time, of the rows that ended well without a mark."""
    able = [row for row in rows if row["good"] and not row["mark"] and row["metrics"].get(_COST) is not None]
    cost_of: dict[str, float] = {row["estimator"]: row["metrics"][_COST] for row in able}
    if len(cost_of) < 2:
        return
    (name, cost), (other, next_cost), *_ = sorted(cost_of.items(), key=lambda pair: pair[1])
    figures = f"{number(cost)} ms of processor time a frame", f"next: {other}, {number(next_cost)} ms"
    if next_cost >= _FASTER * cost:
        yield _card("Fastest", name, *figures, next(row for row in able if row["estimator"] == name))
    else:
        yield _card("Fastest", _UNDECIDED, f"{name} and {other}", figures[1])
