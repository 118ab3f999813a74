"""Who is more accurate by more than chance in one run, and who contradicts the measured motion."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.answers import Run
from toolkit.estimate import Landmarks, Trajectory
from toolkit.experiment.comparison import Row
from toolkit.experiment.contests import (
    FARTHEST,
    Advantage,
    FarthestPose,
    degrees_of_freedom,
    farthest,
    less_drift,
    less_median,
    less_over_seeds,
    too_far,
)
from toolkit.experiment.recording import Recording, prepare
from toolkit.experiment.units import Outcome, Scored, Unit, outcome_of, run_estimator
from toolkit.geometry import Array, about_z, se3, se3_exp
from toolkit.metrics import Scores
from toolkit.metrics.correction_trend import LIMIT, NOTHING_CORRECTED, TREND
from toolkit.metrics.parts.evaluation import Matched
from toolkit.progress import SILENT
from toolkit.sequence import Sequence
from toolkit.settings import Noise
from toolkit.simulation import DRIVE, faults, simulate

FRAMES = 400


def path() -> Array:
    """Return poses (FRAMES, 4, 4) along a winding road, a metre a frame."""
    heading = 0.8 * np.sin(np.arange(FRAMES) / 40.0)
    steps = np.stack([np.cos(heading), np.sin(heading), np.zeros(FRAMES)], axis=1)
    return se3(about_z(heading), np.cumsum(steps, axis=0))


def matched(error_m: Array) -> Matched:
    """Return the road with errors (FRAMES, 3) m of position."""
    truth = path()
    estimate = se3(truth[:, :3, :3], truth[:, :3, 3] + error_m)
    return Matched(np.arange(FRAMES) * 100_000_000, truth, estimate, np.arange(FRAMES, dtype=float))


def drifting(seed: int, sigma_m: float = 0.01) -> Array:
    """Return errors (FRAMES, 3) m that walk at random: neighbours are nearly equal."""
    return np.cumsum(np.random.default_rng(seed).normal(0.0, sigma_m, (FRAMES, 3)), axis=0)


def is_clear(one: Advantage) -> bool:
    """Say whether the interval excludes that both are equal."""
    return not one.low <= 1.0 <= one.high


def advantage(one: Array, other: Array) -> Advantage:
    return less_drift(matched(one), matched(other))


def steady(seed: int) -> Array:
    """Return errors (FRAMES, 3) m of a wrong first velocity: the drift is the same in every stretch."""
    return np.arange(FRAMES)[:, None] * np.random.default_rng(seed).normal(0.0, 0.01, 3)


@pytest.mark.parametrize("errors", [drifting, steady])
def test_of_runs_that_differ_by_noise_or_one_draw_alone_at_most_one_in_twenty_is_clear(errors):
    found = [advantage(errors(seed), errors(seed + 1)) for seed in range(0, 200, 2)]
    assert sum(is_clear(one) for one in found) <= 5


def test_twice_the_error_is_clear_in_nineteen_of_twenty_runs():
    found = [advantage(drifting(seed), drifting(seed + 1, 0.02)) for seed in range(0, 200, 2)]
    assert sum(one.low > 1.0 for one in found) >= 95
    assert np.median([one.ratio for one in found]) == pytest.approx(2.0, rel=0.05)
    scaled = advantage(drifting(0), 2.0 * drifting(0))  # the same noise: nothing is left to chance
    assert (scaled.low, scaled.ratio, scaled.high) == pytest.approx((2.0, 2.0, 2.0), rel=1e-3)


def test_errors_that_are_common_to_both_narrow_the_interval():
    common, own, others = drifting(0), drifting(1, 0.002), drifting(2, 0.002)
    paired, apart = advantage(common + own, common + others), advantage(common + own, drifting(3) + others)
    assert np.log(paired.high / paired.low) < 0.5 * np.log(apart.high / apart.low)


def test_with_few_stretches_nothing_is_tested():
    few = matched(drifting(0))
    cut = Matched(few.t_ns[:10], few.truth[:10], few.estimate[:10], few.path_m[:10])
    assert less_drift(cut, few) is None
    assert less_drift(matched(np.zeros((FRAMES, 3))), few) is None


def test_white_vectors_have_a_degree_of_freedom_a_number_and_correlated_ones_fewer():
    white = [degrees_of_freedom(np.random.default_rng(seed).standard_normal((40, 3))) for seed in range(50)]
    assert np.mean(white) == pytest.approx(120.0, rel=0.3)
    alike = [np.repeat(np.random.default_rng(seed).standard_normal((10, 3)), 4, axis=0) for seed in range(50)]
    assert np.mean([degrees_of_freedom(vectors) for vectors in alike]) == pytest.approx(30.0, rel=0.5)


def test_medians_and_seeds_are_compared_in_pairs():
    errors = np.random.default_rng(0).gamma(2.0, 1.0, 1000)
    twice, equal = less_median(errors, 2.0 * errors), less_median(errors, errors)
    assert (twice.low, is_clear(equal)) == (pytest.approx(2.0), False)
    assert less_median(errors[:50], errors[:50]) is None
    of_seeds = np.random.default_rng(0).gamma(50.0, 1.0, 10)
    better = less_over_seeds(of_seeds, 1.5 * of_seeds + np.linspace(-0.1, 0.1, 10))
    assert better.low > 1.4
    assert all(less_over_seeds(of_seeds[:n], of_seeds[:n]) is None for n in (0, 1, 2))
    assert better.low < better.ratio < better.high


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
    runs = (run_estimator(Unit(prepared, 0, name), prepared, SILENT) for name in NAMES)
    return [Row("causal", (outcome_of(run, prepared.sequence, 0),)) for run in runs]


def test_an_odometer_that_slips_parts_from_estimators_that_see_it_and_a_sound_one_from_nobody():
    sound, as_stated = simulate(replace(DRIVE, duration_s=8.0), 5), Noise(motion_scale=1.0)
    assert not any(too_far(rows_of(sound, noise)) for noise in (Noise(), as_stated))
    slipping = rows_of(faults.disturbed_motion(sound, 0.8, 5), as_stated)
    assert "seed-ekf" in {one.row.estimator for one in too_far(slipping)}
