"""A digest tells values apart by shape, place and content, and rounded ones only by the digits asked for."""

from dataclasses import dataclass

import numpy as np
import pytest

from toolkit.files import content_digest


@dataclass(frozen=True)
class Part:
    """A value with another inside."""

    name: str
    values: np.ndarray
    inner: object = None


ONE = Part("a", np.array([1.0, -2.5, 0.0]), Part("b", np.array([3]), 0.125))


@pytest.mark.parametrize(
    "other",
    [
        Part("z", ONE.values, ONE.inner),
        Part("a", ONE.values[None], ONE.inner),
        Part("a", ONE.values, None),
        Part("a", ONE.values, Part("b", np.array([4]), 0.125)),
        Part("a", ONE.values, Part("b", np.array([3]), 0.1251)),
        Part("a", ONE.values + 1e-4, ONE.inner),
    ],
)
@pytest.mark.parametrize("digits", [None, 6])
def test_any_part_counts(other: Part, digits: int | None) -> None:
    assert content_digest([other], digits) != content_digest([ONE], digits)


def test_last_bits_count_only_where_nothing_is_rounded() -> None:
    nearly = Part("a", ONE.values * (1.0 + 1e-15), Part("b", np.array([3]), 0.125 * (1.0 + 1e-15)))
    assert content_digest([nearly]) != content_digest([ONE])
    assert content_digest([nearly], 6) == content_digest([ONE], 6)


def test_zero_has_no_sign_where_it_is_rounded() -> None:
    for array in (np.array([0.0, 1.0]), np.array([0.0])):
        assert content_digest([-0.0 * array], 6) == content_digest([0.0 * array], 6)


def test_an_array_that_is_not_finite_everywhere_is_rounded_by_what_is() -> None:
    array = np.array([np.nan, np.inf, 1.0])
    assert content_digest([array * (1.0 + 1e-12)], 6) == content_digest([array], 6)
