"""Where wanted values stand among others."""

import numpy as np
import pytest

from toolkit.arrays import is_among, rows_of


@pytest.mark.parametrize("count", [0, 1, 40])
def test_rows_are_found_by_value_and_what_is_not_there_is_reported(count: int) -> None:
    rng = np.random.default_rng(count)
    ascending = np.sort(rng.choice(100, count, replace=False)).astype(np.int64)
    wanted = rng.integers(-5, 110, 60)
    rows, there = rows_of(wanted, ascending)
    np.testing.assert_array_equal(there, np.isin(wanted, ascending))
    np.testing.assert_array_equal(ascending[rows[there]], wanted[there])
    np.testing.assert_array_equal(is_among(wanted, rng.permutation(ascending)), np.isin(wanted, ascending))
