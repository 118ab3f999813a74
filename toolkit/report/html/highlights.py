"""The answers a reader looks for first: the most accurate estimator, the most consistent one, the fastest one."""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

# Rows that answered less than the best by more than this are left out: their errors are of a part of the recording.
_COVERAGE_MARGIN_PERCENT = 5.0

Row = dict[str, Any]


class _Question(NamedTuple):
    """A question: its text, the outputs it is about, its metric (the first that any row has), unit, and answer.

    A ``contest`` has no answer where only one estimator has the metric.
    """

    question_text: str
    outputs: tuple[str, ...]
    keys: tuple[str, ...]
    unit: str
    answer_text: Callable[[str, float], str]
    distance: Callable[[float], float] = abs
    contest: bool = False


def _from_one(value: float) -> float:
    return abs(math.log(value)) if value > 0.0 else math.inf


def _short(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1e3 else f"{value:.0f}" if abs(value) < 1e6 else f"{value:.0e}"


def _error(key: str, value: float) -> str:
    return f"{_short(value)} m ATE, {'yaw and position' if key == 'ate_yaw_m' else 'SE(3)'} aligned"


def _held_out(_: str, value: float) -> str:
    return f"{_short(value)} px off the median withheld sighting"


def _consistency(_: str, value: float) -> str:
    return f"mean pose NEES {_short(value)}; 1 is consistent, more is overconfident"


def _time(_: str, value: float) -> str:
    return f"{_short(value)} s for the whole recording"


def highlights(rows: list[Row], motion: str) -> list[dict[str, str]]:
    """Return question, answer (the estimator), its figure and the runner-up, for what the rows have figures for.

    Only runs that ended well and answered for as much of the recording as the best one can be an answer.
    """
    ate = ("ate_yaw_m",) if motion == "imu" else ("ate_se3_m",)
    everyone = ("causal", "both", "final")
    questions = (
        _Question("Most accurate at each frame (causal)", ("causal", "both"), ate, " m", _error),
        _Question("Most accurate in the end (final)", ("final", "both"), ate, " m", _error),
        _Question("Best on withheld tracks", everyone, ("heldout_reproj_median_px",), " px", _held_out),
        _Question("Best stated uncertainty", everyone, ("nees_pose_mean",), "", _consistency, _from_one, contest=True),
        _Question("Fastest", everyone, ("total_s",), " s", _time),
    )
    eligible = list(_eligible(rows))
    return [answer for question in questions if (answer := _answer(question, eligible)) is not None]


def _eligible(rows: list[Row]) -> Iterator[Row]:
    good = [row for row in rows if row["status"] == "ok"]
    most = max((row["metrics"].get("coverage_percent") or 0.0 for row in good), default=0.0)
    for row in good:
        if (row["metrics"].get("coverage_percent") or 0.0) >= most - _COVERAGE_MARGIN_PERCENT:
            yield row


def _answer(question: _Question, rows: list[Row]) -> dict[str, str] | None:
    scored = [row for row in rows if row["output"] in question.outputs]
    for key in question.keys:
        given = [(row, row["metrics"][key]) for row in scored if row["metrics"].get(key) is not None]
        ranked = sorted(given, key=lambda pair: question.distance(pair[1]))
        if ranked:
            (best, value), *others = ranked
            if question.contest and len({row["estimator"] for row, _ in given}) < 2:
                return None
            after = next(((row, v) for row, v in others if row["estimator"] != best["estimator"]), None)
            return {
                "question": question.question_text,
                "answer": best["estimator"],
                "row": best["id"],
                "detail": question.answer_text(key, value),
                "next": "" if after is None else f"next: {after[0]['estimator']}, {_short(after[1])}{question.unit}",
            }
    return None
