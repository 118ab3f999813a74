"""Trials that are quick, and outcomes made up for the tests of what is done with them."""

import numpy as np
import pytest

from toolkit.experiment.monte_carlo import OverSeeds, in_order
from toolkit.experiment.trial import Outcome, Scored, Trial
from toolkit.initialization import start_from_measurements
from toolkit.metrics import Scores, describe

FRAMES = 50
SEEDS = (3, 4, 5, 6)


@pytest.fixture
def trials():
    """Return a function that makes short trials of the drive over seeds."""

    def make(seeds=(0, 1, 2), estimators=("dead-reckoning", "ekf")):
        return [Trial("drive", seed, tuple(estimators), start_from_measurements, max_frames=30) for seed in seeds]

    return make


def scored(seed, nees):
    values = dict.fromkeys(describe()) | {"ate_none_m": float(seed), "nees_pose_mean": float(nees.mean())}
    notes = {key: "not now" for key, value in values.items() if value is None}
    return Scored(Scores(values, notes), nees, np.full(FRAMES, 0.1 * seed))


@pytest.fixture
def over():
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
    names = ("honest", "astray", "broken")
    frames_s = 0.1 * np.arange(FRAMES)
    ordered = in_order(outcomes, names, SEEDS)
    return OverSeeds("drive", "drive", "twist", SEEDS, "the start", frames_s, names, ordered, 2, {})
