"""``vislam baseline --plan``: the chance with which a check of trajectories finds a growth, said beforehand."""

import numpy as np
import pytest

from toolkit.evaluation.against_baseline import (
    CHANGES_PERCENT,
    SequenceRecord,
    check_trajectories,
    new_trajectory_baseline,
    planned,
)
from toolkit.evaluation.scoring import TIME_COVERAGE


class Runs:
    """Runs of a system whose errors scatter by 8 % and are ``grown``, on as many sequences as are named."""

    def __init__(self, runs: int, rng: np.random.Generator, grown: float = 1.0, sequences: int = 4) -> None:
        self.runs, self.rng, self.grown = runs, rng, grown
        self.sequences = tuple(f"S{i}" for i in range(sequences))

    def scored(self, sequence, align, gap_s, before) -> SequenceRecord:
        values = {key: 100.0 * np.ones(self.runs) for key in ("ate_se3_deg", "rpe_100m_percent", TIME_COVERAGE)}
        values["ate_se3_m"] = self.grown * np.exp(0.08 * self.rng.standard_normal(self.runs))
        files = tuple(f"{sequence}/{i}.tum" for i in range(self.runs))
        scores = {key: tuple(one.tolist()) for key, one in values.items()}
        return SequenceRecord(sequence=sequence, truth="t", truth_hash="", files=files, scores=scores)


def baseline(given: Runs):
    return new_trajectory_baseline(given, "se3", 5.0, {}, bound_percent=1.0)


def position(plan, sequence: str):
    return next(one for one in plan if one.where.metric == "ate_se3_m" and one.where.sequence == sequence)


def test_a_growth_is_found_as_often_as_was_planned():
    runs = 8
    rng = np.random.default_rng(runs)
    made = [baseline(Runs(runs, rng)) for _ in range(30)]
    expected = np.mean([position(planned(one), "all sequences").seen for one in made[:8]], axis=0)
    for change, chance in zip(CHANGES_PERCENT, expected, strict=True):
        found = np.mean([
            any(v.sequence == "all sequences" and v.finding == "regressed" for v in check.verdicts)
            for one in made
            for check in [check_trajectories(one, "", Runs(runs, rng, 1.0 + change / 100.0))]
        ])  # fmt: skip
        # Nearly three standard errors of 30 checks; Holm leaves later tests more of the rate than is planned with.
        assert chance - 0.2 <= found <= chance + 0.25


def test_all_sequences_together_need_fewer_runs_than_one():
    plan = planned(baseline(Runs(10, np.random.default_rng(1), sequences=9)))
    together, alone = position(plan, "all sequences"), position(plan, "S0")
    assert together.scatter_percent == pytest.approx(8.0 / 3.0, rel=0.3)
    assert together.needed[1] is not None
    assert alone.needed[2] is not None
    assert together.needed[2] < alone.needed[2]
    assert together.seen[1] > 0.9


def test_what_is_within_the_bound_is_never_found_and_no_scatter_finds_all_else():
    still = new_trajectory_baseline(Runs(3, np.random.default_rng(2)), "se3", 5.0, {}, bound_percent=7.0)
    angle = next(one for one in planned(still) if one.where.metric == "ate_se3_deg")
    assert angle.seen == (0.0, 1.0, 1.0)
    assert angle.needed == (None, 3, 3)
    assert angle.is_allowed(0)
