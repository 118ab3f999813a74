"""Units of work that are quick, and outcomes made up for the tests of what is done with them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from toolkit.datasets import load_sequence
from toolkit.experiment.comparison import Comparison, in_order
from toolkit.experiment.pipeline import Plan
from toolkit.experiment.recording import Recording
from toolkit.experiment.units import Outcome, Scored, Unit
from toolkit.geometry import Array
from toolkit.metrics import Scores, describe

FRAMES = 50
SEEDS = (3, 4, 5, 6)
Units = Callable[..., list[Unit]]


@pytest.fixture
def units() -> Units:
    """Return a function that makes short runs of the drive, seed by seed."""

    def make(seeds: tuple[int, ...] = (0, 1, 2), estimators: tuple[str, ...] = ("dead-reckoning", "ekf")) -> list[Unit]:
        recordings = [Recording("drive", seed, duration_s=2.9) for seed in seeds]  # 30 frames
        return [Unit(one, one.seed, name, keep_run=True) for one in recordings for name in estimators]

    return make


@pytest.fixture
def two_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let recordings of plans last two seconds, which are drawn and audited at once, as a minute is not."""
    whole = Plan.recording
    monkeypatch.setattr(Plan, "recording", lambda *requested: replace(whole(*requested), duration_s=2.0))


def scored(seed: int, nees: Array) -> Scored:
    values = dict.fromkeys(describe()) | {"ate_none_m": float(seed), "nees_pose_mean": float(nees.mean())}
    notes = {key: "not now" for key, value in values.items() if value is None}
    return Scored(Scores(values, notes), nees, np.full(FRAMES, 0.1 * seed))


@pytest.fixture
def over() -> Comparison:
    """Four seeds of three estimators: one that is consistent, one that diverges under a seed, one that always fails."""
    rng = np.random.default_rng(2)
    outcomes = []
    for seed in reversed(SEEDS):
        honest, sure = (scored(seed, scale * rng.chisquare(6, FRAMES) / 6) for scale in (1.0, 30.0))
        outcomes += [
            Outcome(seed, "broken", "failed", log=("failed after 0 estimates: no gauge",)),
            Outcome(
                seed, "astray", "diverged" if seed == 4 else "ok", {"causal": sure}, ("left the road",), f"hash{seed}"
            ),
            Outcome(seed, "honest", "ok", {"causal": honest, "final": honest}, sequence_hash=f"hash{seed}"),
        ]
    sequence = load_sequence("drive").truncated(FRAMES)
    ordered = in_order(outcomes, ("honest", "astray", "broken"), SEEDS)
    return Comparison("drive", sequence, (), sequence.prior, SEEDS, ordered, workers=2)
