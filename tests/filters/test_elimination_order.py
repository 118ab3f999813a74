"""A smoother eliminates in the order of fewer operations."""

import pytest

from filters.smoothing import elimination_order
from filters.smoothing.elimination_order import by_colamd, cheaper_order, in_time
from tests.filters.conftest import Problem, short
from toolkit.simulation import DRIVE, FLIGHT
from toolkit.simulation.faults import standstill


def test_along_a_standstill_the_order_is_that_of_time_and_has_every_variable_once():
    problem = Problem(standstill(short(DRIVE, 3.0, seed=1), 20.0))
    graph, frames = problem.graph, problem.frames
    assert cheaper_order(graph, frames) is in_time
    orders = [by_colamd(graph, frames), in_time(graph, frames)]
    keys = [[order.at(i) for i in range(order.size())] for order in orders]
    assert keys[0] != keys[1]
    assert sorted(keys[0]) == sorted(keys[1]) == sorted(graph.keyVector())


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=lambda scenario: scenario.name)
def test_where_the_order_of_time_takes_more_operations_it_is_colamds(scenario, monkeypatch):
    monkeypatch.setattr(elimination_order, "_FEWEST_STANDING", 0)  # so that they are counted
    problem = Problem(short(scenario, 10.0, seed=1))
    assert cheaper_order(problem.graph, problem.frames) is by_colamd
