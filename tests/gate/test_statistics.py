"""The statistics of the gate are those of the books: Student's, Holm's, and the rates they promise."""

from itertools import combinations

import numpy as np
import pytest

from toolkit.experiment.statistics import holm, mean_interval, paired_p
from toolkit.gate.significance import POWER, smallest_detectable


@pytest.mark.parametrize("n", [2, 5, 24, 400])
@pytest.mark.parametrize("shift", [-0.3, 0.0, 0.2])
@pytest.mark.parametrize("margin", [0.0, 0.02])
def test_the_paired_test_is_scipys(n, shift, margin):
    from scipy import stats  # its import takes a tenth of what all tests take to be found

    rng = np.random.default_rng(n)
    before, after = rng.standard_normal(n), rng.standard_normal(n) + shift
    expected = stats.ttest_1samp(after - before, margin, alternative="greater").pvalue
    assert float(paired_p(after - before, margin)) == pytest.approx(expected, rel=1e-9)
    of_mean = stats.t.interval(0.95, n - 1, (after - before).mean(), stats.sem(after - before))
    assert mean_interval(after - before)[1:] == pytest.approx(of_mean, rel=1e-9)


@pytest.mark.parametrize(("value", "p"), [(0.0, 1.0), (-0.1, 1.0), (0.005, 1.0), (0.1, 0.0)])
def test_differences_without_spread_are_certain(value, p):
    assert float(paired_p(np.full(24, value), 0.005)) == p


def test_holm_is_the_closed_test_of_bonferroni():
    """By definition: a hypothesis falls when every set of hypotheses that holds it falls by Bonferroni's test."""
    rng = np.random.default_rng(3)
    for _ in range(200):
        p = rng.uniform(0.0, 1.0, 5) ** 3
        sets = [s for size in range(1, 6) for s in combinations(range(5), size)]
        closed = [max(min(len(s) * p[list(s)].min(), 1.0) for s in sets if i in s) for i in range(5)]
        np.testing.assert_allclose(holm(p), closed, rtol=1e-12)


def test_the_smallest_change_seen_is_seen_as_often_as_promised():
    rng = np.random.default_rng(6)
    spread, seeds, rate = 0.04, 24, 0.001
    # From the true spread, of which every set of seeds has an estimate only.
    exact = spread * rng.standard_normal(200_000)
    n_over = np.sqrt(exact.size / seeds)
    shift = smallest_detectable(exact, rate) * n_over
    caught = paired_p(rng.normal(shift, spread, (4000, seeds))) <= rate
    # Large samples have normal quantiles where 24 seeds have Student's: a little less power than promised.
    assert 0.80 < caught.mean() < 0.97
    few = rng.normal(0.0, spread, (300, seeds))
    shifts = np.array([smallest_detectable(one, rate) for one in few])
    caught = paired_p(rng.normal(np.median(shifts), spread, (4000, seeds))) <= rate
    assert caught.mean() == pytest.approx(POWER, abs=0.03)
