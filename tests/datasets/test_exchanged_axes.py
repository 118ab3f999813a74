"""Trajectories whose axes are exchanged or have the wrong sign: named where they are, and nothing else is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toolkit.datasets.trajectories import PosesFile, tum
from toolkit.datasets.trajectories.belonging import Exchange, Reference, body_of, exchanges
from toolkit.errors import DataError
from toolkit.geometry import Array, about_z, se3, se3_inverse, so3_exp
from toolkit.simulation import SCENARIOS, simulate

FITS = "it fits the truth with "
T_BODY_CAM = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.5, 0.1, 0.2]))


def of(scenario: str, duration_s: float) -> tuple[Array, Array]:
    """Return a truth and an estimate (n, 4, 4) of it, which drifts, in a world of its own heading."""
    sequence = simulate(replace(SCENARIOS[scenario], duration_s=duration_s), 0)
    truth = sequence.truth.T_world_imu[::5]
    rng = np.random.default_rng(0)
    rotations = truth[:, :3, :3] @ so3_exp(rng.normal(0.0, 0.02, (len(truth), 3)))
    positions = truth[:, :3, 3] + np.cumsum(rng.normal(0.0, 0.006, (len(truth), 3)), axis=0)
    return truth, se3(about_z(0.7), np.array([3.0, -2.0, 1.0])) @ se3(rotations, positions)


def told(truth: Array, estimate: Array) -> str:
    """Return what is said of poses (n, 4, 4) beside a truth (n, 4, 4) of the same times."""
    t_ns = 100_000_000 * np.arange(len(truth))
    try:
        file = PosesFile(Path("s.tum"), "TUM", t_ns, estimate, tum.other_order)
        body_of(file, Reference.of_truth("made", t_ns, truth), t_ns, (truth, estimate))
    except DataError as error:
        return str(error)
    return ""


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
    assert f"{FITS}{words}" in told(truth, file)


@pytest.mark.parametrize(("scenario", "duration_s"), [("flight", 8.0), ("drive", 30.0)])
def test_sound_poses_of_any_body_and_world_are_not_accused(scenario: str, duration_s: float) -> None:
    truth, estimate = of(scenario, duration_s)
    assert told(truth, estimate) == ""
    assert told(truth, estimate @ T_BODY_CAM) == ""
    assert told(truth, se3(np.tile(np.eye(3), (len(truth), 1, 1)), estimate[:, :3, 3])) == ""


@pytest.mark.parametrize("axis", [0, 2])
def test_a_body_with_other_axes_is_not_said_to_be_misread_where_it_hardly_turns(axis: int) -> None:
    """Swings of some degrees of a body that is mounted as EuRoC's IMU: read w first, they resemble the truth's."""
    t_s = 0.1 * np.arange(200)[:, None]
    swings = 0.1 * np.sin(t_s) * np.eye(3)[axis] + 0.015 * np.sin([1.3, 0.7, 1.7] * t_s + [0.0, 1.0, 1.6])
    R_world_imu = so3_exp(swings) @ so3_exp(np.array([0.0, -np.pi / 2.0, 0.0]))
    truth = se3(R_world_imu, np.sin([0.5, 0.3, 0.8] * t_s + [0.0, 1.6, 0.0]))
    assert told(truth, truth @ T_BODY_CAM) == ""


def test_positions_that_are_mirrored_beside_no_orientations_are_reported_to_be() -> None:
    truth, estimate = of("flight", 8.0)
    mirrored = se3(np.tile(np.eye(3), (len(truth), 1, 1)), estimate[:, [0, 2, 1], 3])
    assert told(truth, mirrored).startswith(f"s.tum: {FITS}its positions mirrored")


def test_poses_that_are_inverted_are_not_reported_to_be_mirrored() -> None:
    """Where the body hardly turns, inverse positions are the true ones with every sign turned."""
    truth, estimate = of("flight", 8.0)
    facing = se3(so3_exp(0.002 * np.arange(len(truth))[:, None] * np.array([0.0, 0.1, 1.0])), truth[:, :3, 3])
    assert told(facing, se3_inverse(facing)).startswith(f"s.tum: {FITS}each pose inverted")
    assert told(truth, estimate) == ""


def test_an_estimate_that_is_lost_is_not_reported_to_be_in_other_axes() -> None:
    truth, estimate = of("flight", 8.0)
    rng = np.random.default_rng(1)
    for seed in range(5):
        wandering = estimate.copy()
        wandering[:, :3, 3] += np.cumsum(np.random.default_rng(seed).normal(0.0, 0.5, (len(truth), 3)), axis=0)
        assert told(truth, wandering) == ""
    assert told(truth, se3(estimate[:, :3, :3], rng.normal(0.0, 1.0, (len(truth), 3)))) == ""
