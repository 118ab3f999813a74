"""A simulated week of a project whose runs scatter: how many regressions its gate of trajectories finds, and invents.

Not part of the test run. Thirty commits are checked against the baseline of the week's beginning, each by the gate's
own code on scores drawn anew: every run's errors are those of its sequence times a factor that scatters by 8 % (its
position, rotation and drift alike but for a third of the variance). Four commits of the thirty, drawn at random, make
every error 5 to 15 % larger, and are taken back before the next one. The bound is 1 %.

    python tests/benchmarks/gate_week.py [WEEKS [RUNS ...]]
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from toolkit.evaluation.against_baseline import (
    CHANGES_PERCENT,
    ScoredSequence,
    SequenceRecord,
    check_trajectories,
    new_trajectory_baseline,
    planned,
)
from toolkit.evaluation.against_baseline import scored_metrics as scored
from toolkit.evaluation.scoring import TIME_COVERAGE

SEQUENCES, COMMITS, PLANTED = 8, 30, 4
SCATTER, SHARED, BOUND_PERCENT = 0.08, 2.0 / 3.0, 1.0
LEAST, MOST = 0.05, 0.15


@dataclass(frozen=True, eq=False)
class Drawn:
    """The scores of as many runs of each sequence, drawn from a generator, all errors ``grown`` by a factor."""

    runs: int
    grown: float
    rng: np.random.Generator
    sequences: tuple[str, ...] = tuple(f"sequence-{i}" for i in range(SEQUENCES))

    def scored(self, sequence: str, align: str, gap_s: float, before: SequenceRecord | None) -> ScoredSequence:
        keys = scored(align)
        shared, own = self.rng.standard_normal(self.runs), self.rng.standard_normal((len(keys), self.runs))
        factors = self.grown * np.exp(SCATTER * (np.sqrt(SHARED) * shared + np.sqrt(1.0 - SHARED) * own))
        scores = {key: tuple(row.tolist()) for key, row in zip(keys, factors, strict=True)}
        scores[TIME_COVERAGE] = (100.0,) * self.runs
        files = tuple(f"{sequence}/{run}.tum" for run in range(self.runs))
        return SequenceRecord(sequence=sequence, truth="truth.tum", truth_hash="", files=files, scores=scores), {}


def week(runs: int, seed: int) -> tuple[int, int]:
    """Return how many of the four regressions are found in a week, and how many other commits fail."""
    rng = np.random.default_rng([seed, runs])
    baseline = new_trajectory_baseline(Drawn(runs, 1.0, rng), "se3", 5.0, {}, BOUND_PERCENT)  # type: ignore[arg-type]
    planted = set(rng.choice(COMMITS, PLANTED, replace=False).tolist())
    failed = {commit for commit in range(COMMITS) if not _passes(baseline, runs, commit in planted, rng)}
    return len(failed & planted), len(failed - planted)


def _passes(baseline, runs: int, is_planted: bool, rng: np.random.Generator) -> bool:
    grown = 1.0 + rng.uniform(LEAST, MOST) if is_planted else 1.0
    return check_trajectories(baseline, "", Drawn(runs, grown, rng)).passed  # type: ignore[arg-type]


def rows(weeks: int, of_runs: list[int]) -> Iterator[str]:
    yield "| runs a sequence | planned for 5 % | found | weeks with all four | with at most one false alarm |"
    yield "|--:|--:|--:|--:|--:|"
    for runs in of_runs:
        results = np.array([week(runs, seed) for seed in range(weeks)])
        baseline = new_trajectory_baseline(Drawn(runs, 1.0, np.random.default_rng(0)), "se3", 5.0, {}, BOUND_PERCENT)
        chance = max(one.seen[CHANGES_PERCENT.index(5.0)] for one in planned(baseline))
        found, alarms = results.T
        yield (
            f"| {runs} | {100 * chance:.0f} % | {100 * found.mean() / PLANTED:.0f} % | "
            f"{100 * (found == PLANTED).mean():.0f} % | {100 * (alarms <= 1).mean():.0f} % |"
        )


if __name__ == "__main__":
    arguments = [int(word) for word in sys.argv[1:]]
    for line in rows(arguments[0] if arguments else 100, arguments[1:] or [5, 10, 15, 20]):
        print(line, flush=True)
