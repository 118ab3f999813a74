"""The signed-rank test is exact, whatever ties there are, and infinite differences are the largest."""

from itertools import product

import numpy as np
import pytest

from toolkit.evaluation.standings import signed_rank_p


def by_enumeration(differences: np.ndarray) -> float:
    """Count all signs, one by one."""
    given = differences[differences != 0.0]
    sizes = np.abs(given)
    ranks = np.array([np.mean(np.flatnonzero(np.sort(sizes) == size) + 1.0) for size in sizes])
    sums = [float(ranks @ np.array(signs)) for signs in product((0.0, 1.0), repeat=given.size)]
    here = float(ranks[given > 0.0].sum())
    return min(1.0, 2.0 * min(np.mean([s <= here for s in sums]), np.mean([s >= here for s in sums])))


@pytest.mark.parametrize("seed", range(5))
def test_it_counts_every_sign_whatever_ties_and_failures_there_are(seed):
    rng = np.random.default_rng(seed)
    differences = rng.integers(-3, 4, 9).astype(float)
    differences[rng.integers(0, 9, 3)] = [np.inf, np.inf, -np.inf]
    assert signed_rank_p(differences) == pytest.approx(by_enumeration(differences))
    from scipy.stats import wilcoxon  # its import takes a sixth of what all tests take to be found

    apart = rng.normal(0.3, 1.0, 15)
    assert signed_rank_p(apart) == pytest.approx(wilcoxon(apart, method="exact").pvalue)


def test_no_difference_is_no_evidence():
    assert signed_rank_p(np.zeros(5)) == 1.0
    assert signed_rank_p(np.array([1.0])) == 1.0
    assert signed_rank_p(np.full(10, np.inf)) == pytest.approx(2.0 / 1024.0)
