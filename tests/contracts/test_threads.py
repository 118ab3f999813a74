"""Every estimator gives the same bits at one thread and at two: what a report shows can be repeated anywhere.

The number of threads is settled when the numeric libraries are loaded, so each number has a process of its own.
"""

from collections.abc import Callable

import pytest

from toolkit.registry import discover
from toolkit.verify.threads import UNAVAILABLE, digests_at


@pytest.fixture(scope="module")
def digests(made_once: Callable[[str, Callable[[], list[dict[str, str]]]], list[dict[str, str]]]):
    return made_once("digests", lambda: [digests_at(threads, tuple(discover())) for threads in (1, 2)])


@pytest.mark.parametrize("scenario", ["drive", "flight"])
@pytest.mark.parametrize("name", sorted(discover()))
def test_one_thread_and_two_say_the_same_bits(name, scenario, digests) -> None:
    one, two = (reported[f"{name} on {scenario}"] for reported in digests)
    if one == two == UNAVAILABLE:
        pytest.skip(f"{name} is unavailable")
    assert one == two
