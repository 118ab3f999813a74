"""One run names the more accurate estimator only where the drift of another is larger by more than chance."""

import numpy as np
import pytest

from toolkit.experiment.contests import Advantage, degrees_of_freedom, less_drift, less_median, less_over_seeds
from toolkit.geometry import Array, about_z, se3
from toolkit.metrics.parts.evaluation import Matched

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
    twice, equal = less_median(errors, 2.0 * errors, "tracks"), less_median(errors, errors, "tracks")
    assert (twice.low, is_clear(equal)) == (pytest.approx(2.0), False)
    assert less_median(errors[:50], errors[:50], "tracks") is None
    of_seeds = np.random.default_rng(0).gamma(50.0, 1.0, 10)
    better = less_over_seeds(of_seeds, 1.5 * of_seeds + np.linspace(-0.1, 0.1, 10))
    assert better.low > 1.4
    assert all(less_over_seeds(of_seeds[:n], of_seeds[:n]) is None for n in (0, 1, 2))
    assert better.low < better.ratio < better.high
