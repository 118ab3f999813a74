"""The splines' derivatives against differences, and what makes a road a road."""

import numpy as np
import pytest

from toolkit.geometry import Array, se3_inverse, se3_log, so3_log
from toolkit.simulation.scenes import SmoothTrajectory, blending_matrix, hall, road

STEP_S = 1e-4
TRAJECTORIES = {"road": road(20.0).trajectory, "hall": hall(20.0).trajectory}
AT_S = np.linspace(0.5, 19.5, 191)


@pytest.fixture(params=sorted(TRAJECTORIES))
def trajectory(request: pytest.FixtureRequest) -> SmoothTrajectory:
    return TRAJECTORIES[request.param]


def test_velocity_acceleration_and_turn_rate_in_the_body_are_derivatives(trajectory: SmoothTrajectory) -> None:
    before, at, after = (trajectory.at(AT_S + step_s) for step_s in (-STEP_S, 0.0, STEP_S))
    moved_m = after.T_world_imu[:, :3, 3] - before.T_world_imu[:, :3, 3]
    turned = so3_log(np.swapaxes(before.T_world_imu[:, :3, :3], 1, 2) @ after.T_world_imu[:, :3, :3])
    differences = ((at.v_world, moved_m), (at.a_world, after.v_world - before.v_world), (at.w_imu, turned))
    for found, difference in differences:
        # Central differences err by step^2 / 6 times the third derivative, about 1e-8, and by rounding / step.
        np.testing.assert_allclose(found, difference / (2.0 * STEP_S), atol=1e-7)


def test_blending_weights_sum_to_one_and_cubic_is_the_textbook_matrix() -> None:
    cubic = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6.0
    np.testing.assert_allclose(blending_matrix(4), cubic, atol=1e-15)
    for order in (4, 5, 6):
        np.testing.assert_allclose(blending_matrix(order).sum(axis=0), np.eye(order)[0], atol=1e-14)


def test_a_car_moves_where_it_points() -> None:
    motion = road(60.0).trajectory.at(np.linspace(0.0, 60.0, 601))
    v_imu = np.einsum("nji,nj->ni", motion.T_world_imu[:, :3, :3], motion.v_world)
    np.testing.assert_allclose(v_imu[:, 1:], 0.0, atol=1e-13)
    assert v_imu[:, 0].min() > 2.0
    assert 11.0 < v_imu[:, 0].max() < 13.0


def test_a_flight_turns_and_accelerates_about_every_axis() -> None:
    motion = hall(60.0).trajectory.at(np.linspace(0.0, 60.0, 1201))
    assert np.std(motion.w_imu, axis=0).min() > 0.1
    assert np.std(motion.a_world, axis=0).min() > 0.2
    assert 0.7 < np.linalg.norm(motion.v_world, axis=1).mean() < 1.3


@pytest.mark.parametrize("scene", [road, hall])
def test_a_longer_recording_begins_like_a_shorter_one(scene: object) -> None:
    t_s = np.linspace(0.0, 5.0, 51)
    short, long = scene(5.0).trajectory.at(t_s), scene(50.0).trajectory.at(t_s)
    drift: Array = se3_log(se3_inverse(short.T_world_imu) @ long.T_world_imu)
    np.testing.assert_allclose(drift, 0.0, atol=1e-9)
