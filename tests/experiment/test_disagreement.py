"""Estimators of one comparison that are too far from the measured motion are reported."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.answers import Run
from toolkit.estimate import Landmarks, Trajectory
from toolkit.experiment.comparison import Row
from toolkit.experiment.contests import FARTHEST, FarthestPose, farthest, too_far
from toolkit.experiment.recording import Prepared, Recording, prepare
from toolkit.experiment.units import Outcome, Scored, Unit, outcome_of, run_estimator
from toolkit.geometry import Array, se3_exp
from toolkit.metrics import Scores
from toolkit.metrics.correction_trend import LIMIT, NOTHING_CORRECTED, TREND
from toolkit.progress import SILENT
from toolkit.sequence import Sequence
from toolkit.settings import Noise
from toolkit.simulation import DRIVE, faults, simulate

NAMES = ("dead-reckoning", "seed-ekf", "ekf-slam", "msckf")
STAMPS_NS = np.arange(40) * 100_000_000
SIGMA = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])


def row(name: str, poses: Array | None = None, cov: Array | None = None, trend: float | None = None) -> Row:
    """Return a row that rests on the motion where it has no trend, else one whose trend has a limit of 4."""
    values, notes = {TREND: trend, LIMIT: None if trend is None else 4.0}, {TREND: NOTHING_CORRECTED}
    scored = Scored(Scores(values, notes if trend is None else {}), np.empty(0), np.empty(0))
    reported = None if poses is None else Trajectory(STAMPS_NS[: len(poses)], poses, cov=cov)
    run = Run(name, "ok", reported, reported, Landmarks.none(), None)
    return Row("causal", (Outcome(0, name, "ok", {"causal": scored}, final_is_causal=True, run=run),))


def drawn(seed: int, sigma: Array = SIGMA) -> Array:
    """Return poses (40, 4, 4) whose errors have standard deviations (6,)."""
    return se3_exp(sigma * np.random.default_rng(seed).standard_normal((40, 6)))


def apart(mine: Array, other: Array, cov: Array) -> FarthestPose:
    return farthest(row("other", other, cov, trend=1.0), Trajectory(STAMPS_NS, mine, cov=cov))


def test_poses_drawn_from_what_is_stated_never_part_and_a_shift_of_ten_sigmas_does():
    cov = np.tile(np.diag(SIGMA**2), (40, 1, 1))
    squared = [apart(drawn(seed), drawn(1000 + seed), cov).squared for seed in range(200)]
    assert 1.5 < np.median(squared) < max(squared) < FARTHEST
    shifted = drawn(3)
    shifted[25, :3, 3] += np.array([0.0, 2.0, 0.0])
    messages = apart(drawn(4), shifted, cov)
    assert (messages.t_s, messages.squared > FARTHEST) == (2.5, True)
    assert messages.distance_m == pytest.approx(2.0, abs=4.0 * SIGMA[5])


def test_where_the_pose_is_known_for_certain_rounding_parts_nobody():
    same = drawn(0)
    assert apart(same, same @ se3_exp(np.full(6, 1e-9)), np.zeros((40, 6, 6))).squared < 1e-3


def test_without_a_covariance_or_over_seeds_nobody_parts():
    poses, cov = drawn(0), np.tile(np.diag(SIGMA**2), (40, 1, 1))
    far = poses @ se3_exp(np.array([0.0, 0.0, 0.0, 50.0, 0.0, 0.0]))
    motion = row("dead-reckoning", poses, cov)
    assert too_far([motion, row("a", far, cov, 1.0)])
    assert not too_far([motion, row("a", far, None, 1.0)])
    outcome = motion.outcomes[0]
    assert not too_far([Row("causal", (outcome, replace(outcome, seed=1))), row("a", far, cov, 1.0)])


def rows_of(sequence: Sequence, noise: Noise) -> list[Row]:
    prepared = prepare(Recording(replace(sequence, truth=None), noise=noise))
    return [_row_of(name, prepared) for name in NAMES]


def _row_of(name: str, prepared: Prepared) -> Row:
    run = run_estimator(Unit(prepared, 0, name), prepared, SILENT)
    return Row("causal", (outcome_of(run, prepared.sequence, 0),))


def test_an_odometer_that_slips_parts_from_estimators_that_see_it_and_a_sound_one_from_nobody():
    sound, as_stated = simulate(replace(DRIVE, duration_s=8.0), 5), Noise(motion_scale=1.0)
    assert not any(too_far(rows_of(sound, noise)) for noise in (Noise(), as_stated))
    slipping = rows_of(faults.disturbed_motion(sound, 0.8, 5), as_stated)
    assert "seed-ekf" in {one.row.estimator for one in too_far(slipping)}
