"""Who wins: rows of a comparison ranked by an error, and whether the first is better by more than chance.

One recording is one draw of the noise, so a single run names a winner only where a paired test over stretches of the
path supports it (:mod:`toolkit.experiment.drift_test`); over seeds the test is over the seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from toolkit.experiment.drift_test import Advantage, less_drift, less_median, less_over_seeds
from toolkit.metrics import Evaluation
from toolkit.metrics.parts.scores import Unavailable

if TYPE_CHECKING:
    from toolkit.experiment.comparison import Row
    from toolkit.geometry import Array
    from toolkit.sequence import Sequence as Recorded

Question = Literal["accuracy at each frame", "accuracy in the end", "withheld tracks"]
Compared = Callable[["Row", "Row"], Advantage | None]
HELD_OUT, COST = "heldout_reproj_median_px", "frame_cpu_ms_mean"
COVERAGE = "coverage_percent"
_YAW, _SE3 = "ate_yaw_m", "ate_se3_m"
# Rows that answered less than the best by more than this are left out: their errors are of a part of the recording.
_COVERAGE_MARGIN_PERCENT = 5.0


@dataclass(frozen=True, eq=False)
class Contest:
    """Rows from the least of an error up; ``advantages`` of the first over each of the others, in their order.

    An advantage is None where there are too few data for a test.
    """

    question: Question
    metric: str
    rows: tuple[Row, ...]
    advantages: tuple[Advantage | None, ...]

    @property
    def worse(self) -> tuple[tuple[Row, Advantage], ...]:
        """Return the rows that are worse than the first by more than chance, in order, each with its advantage."""
        pairs = zip(self.rows[1:], self.advantages, strict=True)
        return tuple((row, one) for row, one in pairs if one is not None and one.low > 1.0)

    @property
    def leaders(self) -> tuple[Row, ...]:
        """Return the first row and those that may be as good."""
        worse = [row for row, _ in self.worse]
        return tuple(row for row in self.rows if row not in worse)

    @property
    def winner(self) -> Row | None:
        """Return the row that is better than every other by more than chance, unless a mark speaks against it."""
        alone = len(self.rows) > 1 and len(self.leaders) == 1
        return self.rows[0] if alone and not self.rows[0].mark else None


def contests_of(rows: Sequence[Row], sequence: Recorded) -> tuple[Contest, ...]:
    """Return what rows can be ranked by: the error against the truth, at each frame and in the end, withheld tracks.

    Only rows that ended well under every seed take part, and that answered for as much as the best one.
    """
    able = list(_able(rows))
    key = _accuracy(able)
    test_drift, test_tracks = (_over_seeds(key), _over_seeds(HELD_OUT)) if _many(able) else _of_one_run(sequence)
    wanted: tuple[tuple[Question, str, tuple[str, ...], Compared], ...] = (
        ("accuracy at each frame", key, ("causal", "both"), test_drift),
        ("accuracy in the end", key, ("final", "both"), test_drift),
        ("withheld tracks", HELD_OUT, ("causal", "final", "both"), test_tracks),
    )
    found = (_contest(question, metric, able, labels, test) for question, metric, labels, test in wanted)
    return tuple(contest for contest in found if contest is not None)


def cheaper_near(contest: Contest, within: float, saves: float) -> Row | None:
    """Return the cheapest row ``within`` a factor of the first's error, if it ``saves`` this share of the time."""
    first = contest.rows[0]
    limit, most = within * (first.value(contest.metric) or 0.0), (1.0 - saves) * (first.value(COST) or 0.0)
    near = [row for row in contest.rows[1:] if (row.value(contest.metric) or np.inf) <= limit and row.value(COST)]
    best = min(near, key=lambda row: row.value(COST) or np.inf, default=None)
    return best if best is not None and (best.value(COST) or np.inf) <= most else None


def _many(rows: Iterable[Row]) -> bool:
    return any(len(row.outcomes) > 1 for row in rows)


def _able(rows: Sequence[Row]) -> Iterator[Row]:
    good = [row for row in rows if row.answered and row.counts["ok"] == len(row.outcomes)]
    most = max((row.value(COVERAGE) or 0.0 for row in good), default=0.0)
    yield from (row for row in good if (row.value(COVERAGE) or 0.0) >= most - _COVERAGE_MARGIN_PERCENT)


def _accuracy(rows: Iterable[Row]) -> str:
    """Return the ATE to rank by: after a fit of heading and position, but where a world's tilt is most of that error.

    The remark on such a value says so.
    """
    tilted = any(
        _YAW in scored.scores.notes and _SE3 not in scored.scores.notes and scored.scores.values.get(_YAW) is not None
        for row in rows
        for scored in row.good
    )
    return _SE3 if tilted else _YAW


def _contest(
    question: Question, metric: str, rows: Iterable[Row], labels: tuple[str, ...], test: Compared
) -> Contest | None:
    """Return the contest of the rows with a label that have the metric, one an estimator; None of fewer than two."""
    scored = [row for row in rows if row.label in labels and row.value(metric) is not None]
    ranked = sorted(scored, key=lambda row: row.value(metric) or 0.0)
    best_of = {row.estimator: row for row in reversed(ranked)}
    ranked = [row for row in ranked if best_of[row.estimator] is row]
    if len(ranked) < 2:
        return None
    return Contest(question, metric, tuple(ranked), tuple(test(ranked[0], row) for row in ranked[1:]))


def _over_seeds(metric: str) -> Compared:
    def compared(one: Row, other: Row) -> Advantage | None:
        pairs = zip(one.good_values(metric), other.good_values(metric), strict=True)
        known = np.array([(a, b) for a, b in pairs if a is not None and b is not None]).reshape(-1, 2)
        return less_over_seeds(known[:, 0], known[:, 1])

    return compared


def _of_one_run(sequence: Recorded) -> tuple[Compared, Compared]:
    """Return the tests of the rows of one run: by drift against the truth, and by the withheld tracks both predict."""
    evaluations: dict[int, Evaluation] = {}

    def evaluation(row: Row) -> Evaluation:
        return evaluations.setdefault(id(row), Evaluation(row.run, row.output, sequence))

    def by_drift(one: Row, other: Row) -> Advantage | None:
        try:
            return less_drift(evaluation(one).compared, evaluation(other).compared)
        except Unavailable:
            return None

    def by_tracks(one: Row, other: Row) -> Advantage | None:
        (seen, mine), (also_seen, its) = evaluation(one).held_out_errors, evaluation(other).held_out_errors
        both, of_mine, of_its = np.intersect1d(seen, also_seen, assume_unique=True, return_indices=True)
        in_time = np.argsort(sequence.held_out.frame[both], kind="stable")
        errors: tuple[Array, Array] = (mine[of_mine][in_time], its[of_its][in_time])
        return less_median(*errors, "stretches of time")

    return by_drift, by_tracks
