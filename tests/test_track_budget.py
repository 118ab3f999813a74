"""Which tracks a budget gives to estimators: no more than it says, spread over the view, chosen from the past alone."""

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest

from toolkit.sequence import Observations, Sequence
from toolkit.simulation import DRIVE, simulate
from toolkit.track_budget import parts_of_view, within_budget

BUDGET = 30


@lru_cache(maxsize=1)
def drive() -> Sequence:
    """Return a drive with about 90 visible tracks a frame."""
    return simulate(replace(DRIVE, duration_s=4.0), 0)


def budgeted(budget: int = BUDGET) -> Sequence:
    return replace(drive(), track_budget=budget)


def tracks_of(seen: Observations, frame: int) -> set[int]:
    return set(seen.track_id[seen.frame == frame].tolist())


def chosen(budget: int, ages: list[int], parts: list[tuple[int, int, int]]) -> list[int]:
    """Return the tracks, numbered from 0, that are given of a single frame."""
    rows = len(ages)
    given = within_budget(budget, np.array([0, rows]), np.arange(rows), np.array(ages), np.array(parts))
    return np.flatnonzero(given).tolist()


def test_no_frame_gives_more_tracks_than_the_budget_and_none_fewer_than_there_are():
    given = np.bincount(budgeted().visible.frame, minlength=drive().frame_count)
    there = np.bincount(drive().visible.frame, minlength=drive().frame_count)
    np.testing.assert_array_equal(given, np.minimum(there, BUDGET))
    assert (there > BUDGET).any()


def test_a_chosen_track_stays_until_it_is_lost():
    given, there = budgeted().visible, drive().visible
    for before, now in pairwise(range(drive().frame_count)):
        assert tracks_of(given, before) & tracks_of(there, now) <= tracks_of(given, now)


def test_what_is_given_at_a_frame_does_not_depend_on_later_ones():
    short, long = budgeted().truncated(11).visible, budgeted().visible
    np.testing.assert_array_equal(short.track_id, long.track_id[long.frame < 11])


CROWD, ALONE = (0, 0, 3), (5, 2, 1)


@pytest.mark.parametrize(
    ("budget", "ages", "parts", "given"),
    [
        (2, [9, 9, 9, 0], [CROWD, CROWD, CROWD, ALONE], [0, 3]),  # every part has one track before any has two
        (2, [1, 7, 0, 4], [CROWD] * 4, [1, 3]),  # within a part the one that has lived longest comes first
        (3, [9, 0, 0, 0], [(4, 4, -1), (0, 0, 2), (0, 0, 2), (0, 0, 2)], [1, 2, 3]),  # one without depth comes last
    ],
)
def test_which_tracks_of_a_frame_are_given(budget, ages, parts, given):
    assert chosen(budget, ages, parts) == given


def test_parts_are_cells_of_the_image_and_octaves_of_disparity():
    """With a budget of 16 there are four cells, a quarter of the image each."""
    uvs_px = np.array(
        [[90.0, 86.1, 10.0], [90.0, 85.9, 10.0], [10.0, 7.9, 90.0], [10.0, 9.5, 90.0], [10.0, 10.5, 90.0]]
    )
    parts = parts_of_view(uvs_px, (50.0, 50.0), 16)
    np.testing.assert_array_equal(parts, [[0, -1, 1], [0, -1, 2], [-1, 0, 1], [-1, 0, -1], [-1, 0, -1]])
