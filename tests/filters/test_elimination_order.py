"""A smoother eliminates in the order of fewer operations."""

from dataclasses import replace

import gtsam
import pytest

from filters.smoothing import elimination_order
from filters.smoothing.elimination_order import by_colamd, cheaper_order, in_time
from toolkit.measurements import StereoFrame
from toolkit.models.factors import StereoFactors
from toolkit.models.motion import motion_model
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, FLIGHT, simulate
from toolkit.simulation.faults import standstill

Problem = tuple[gtsam.NonlinearFactorGraph, list[StereoFrame]]


def _problem(sequence: Sequence) -> Problem:
    """Return what ties the states of a recording to one another, the prior included, and the frames."""
    model, packets = motion_model(sequence.noise, sequence.gravity_world), list(sequence.packets())
    graph = model.hold(model.initial_belief(sequence.prior), 0)
    for packet in packets[1:]:
        graph.push_back(model.integrate(packet.motion, sequence.prior.bias).factors(packet.index))
    return graph, [packet.frame for packet in packets]


def _standing(pause_s: float) -> Sequence:
    return standstill(simulate(replace(DRIVE, duration_s=3.0), 1), pause_s)


def test_along_a_standstill_the_order_is_that_of_time():
    assert cheaper_order(*_problem(_standing(20.0))) is in_time


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=lambda scenario: scenario.name)
def test_where_the_order_of_time_takes_more_operations_it_is_colamds(scenario, monkeypatch):
    monkeypatch.setattr(elimination_order, "_FEWEST_STANDING", 0)  # so that they are counted
    assert cheaper_order(*_problem(simulate(replace(scenario, duration_s=10.0), 1))) is by_colamd


def test_both_orders_have_every_variable_once():
    graph, frames = _problem(_standing(8.0))
    maker = StereoFactors(DRIVE.rig)
    for k, frame in enumerate(frames):
        for factor in maker.of(frame, k):
            graph.add(factor)
    orders = [by_colamd(graph, frames), in_time(graph, frames)]
    keys = [[order.at(i) for i in range(order.size())] for order in orders]
    assert keys[0] != keys[1]
    assert sorted(keys[0]) == sorted(keys[1]) == sorted(graph.keyVector())
