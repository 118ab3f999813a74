"""Gravity in the truth's world: set right where an IMU shows it, left alone where nothing tells it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from toolkit.audit import audit
from toolkit.geometry import se3, so3_exp
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, simulate


@cache
def recorded(scenario: str) -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=6.0, varied=True), 31)


@pytest.mark.parametrize("scenario", ["flight", "drive-imu"])
@pytest.mark.parametrize("gravity_world", [(0.0, 0.0, 9.81), (0.0, 9.81, 0.0), (-9.81, 0.0, 0.0)])
def test_gravity_that_points_elsewhere_is_set_right(scenario: str, gravity_world: tuple[float, ...]) -> None:
    sound = recorded(scenario)
    outcome = audit(replace(sound, gravity_world=np.array(gravity_world)))
    (finding,) = [finding for finding in outcome.findings if finding.repaired]
    assert (finding.fault, finding.blocking) == ("gravity-direction", False)
    np.testing.assert_allclose(outcome.sequence.gravity_world, sound.gravity_world, atol=1e-12)


@pytest.mark.parametrize("scenario", ["flight", "drive-imu", "drive"])
def test_gravity_that_is_right_is_left_alone(scenario: str) -> None:
    assert "gravity-direction" not in {finding.fault for finding in audit(recorded(scenario)).findings}


def test_in_a_world_whose_axes_are_all_far_from_gravity_it_blocks() -> None:
    sound = recorded("flight")
    assert sound.truth is not None
    tilt = so3_exp(np.array([0.25 * np.pi, 0.0, 0.0]))
    poses = se3(tilt, np.zeros(3)) @ sound.truth.T_world_imu
    tilted = replace(sound, truth=replace(sound.truth, T_world_imu=poses, v_world=None), prior=None)
    (finding,) = [finding for finding in audit(tilted).findings if finding.blocking]
    assert finding.fault == "gravity-direction"
    assert "no axis of the world is near" in finding.detail


def test_a_truth_that_rotates_differently_from_the_gyro_shows_nothing_of_gravity() -> None:
    """Its body axes are others: what they make of the samples falls anywhere."""
    sound = recorded("flight")
    assert sound.truth is not None
    poses = sound.truth.T_world_imu @ se3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    other = replace(sound, truth=replace(sound.truth, T_world_imu=poses), prior=None)
    assert "gravity-direction" not in {finding.fault for finding in audit(other).findings}
