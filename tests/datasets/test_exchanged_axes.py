"""Trajectories whose axes are exchanged or have the wrong sign: named where they are, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.datasets.trajectories.belonging import Exchange, exchanged, exchanges
from toolkit.geometry import Array, about_z, se3, se3_inverse, so3_exp
from toolkit.simulation import SCENARIOS, simulate

T_BODY_CAM = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.5, 0.1, 0.2]))


def of(scenario: str, duration_s: float) -> tuple[Array, Array]:
    """Return a truth and an estimate (n, 4, 4) of it, which drifts, in a world of its own heading."""
    sequence = simulate(replace(SCENARIOS[scenario], duration_s=duration_s), 0)
    assert sequence.truth is not None
    truth = sequence.truth.T_world_imu[::5]
    rng = np.random.default_rng(0)
    rotations = truth[:, :3, :3] @ so3_exp(rng.normal(0.0, 0.02, (len(truth), 3)))
    positions = truth[:, :3, 3] + np.cumsum(rng.normal(0.0, 0.006, (len(truth), 3)), axis=0)
    return truth, se3(about_z(0.7), np.array([3.0, -2.0, 1.0])) @ se3(rotations, positions)


@pytest.mark.parametrize("words", [
    "y and z exchanged (positions alone)",
    "y and z exchanged (positions and quaternions)",
    "y and z exchanged (the whole world)",
    "x and y exchanged (positions alone)",
    "the sign of z changed (positions alone)",
    "x, y and z read from the columns y, z, x (positions alone)",
])  # fmt: skip
def test_exchanged_axes_of_a_path_in_space_are_named(words: str) -> None:
    truth, estimate = of("flight", 8.0)
    (exchange,) = (one for one in exchanges() if one.description == words)
    file = Exchange(exchange.matrix.T, exchange.struck).reread(estimate)
    assert exchanged(truth, file) == words


@pytest.mark.parametrize(("scenario", "duration_s"), [("flight", 8.0), ("drive", 30.0)])
def test_sound_poses_of_any_body_and_world_are_not_accused(scenario: str, duration_s: float) -> None:
    truth, estimate = of(scenario, duration_s)
    assert exchanged(truth, estimate) is None
    assert exchanged(truth, estimate @ T_BODY_CAM) is None
    assert exchanged(truth, se3(np.tile(np.eye(3), (len(truth), 1, 1)), estimate[:, :3, 3])) is None


def test_positions_that_are_mirrored_beside_no_orientations_are_reported_to_be() -> None:
    truth, estimate = of("flight", 8.0)
    mirrored = se3(np.tile(np.eye(3), (len(truth), 1, 1)), estimate[:, [0, 2, 1], 3])
    assert exchanged(truth, mirrored) == "its positions mirrored"


def test_poses_that_are_inverted_are_not_reported_to_be_mirrored() -> None:
    """Where the body hardly turns, inverse positions are the true ones with every sign turned."""
    truth, estimate = of("flight", 8.0)
    facing = se3(so3_exp(0.002 * np.arange(len(truth))[:, None] * np.array([0.0, 0.1, 1.0])), truth[:, :3, 3])
    assert exchanged(facing, se3_inverse(facing)) == "each pose inverted"
    assert exchanged(truth, estimate) is None


def test_an_estimate_that_is_lost_is_not_reported_to_be_in_other_axes() -> None:
    truth, estimate = of("flight", 8.0)
    rng = np.random.default_rng(1)
    for seed in range(5):
        wandering = estimate.copy()
        wandering[:, :3, 3] += np.cumsum(np.random.default_rng(seed).normal(0.0, 0.5, (len(truth), 3)), axis=0)
        assert exchanged(truth, wandering) is None
    assert exchanged(truth, se3(estimate[:, :3, :3], rng.normal(0.0, 1.0, (len(truth), 3)))) is None


def test_an_exchange_undoes_what_its_inverse_did() -> None:
    _, estimate = of("flight", 3.0)
    for exchange in exchanges():
        undone = exchange.reread(Exchange(exchange.matrix.T, exchange.struck).reread(estimate))
        np.testing.assert_allclose(undone, estimate, atol=1e-12)
