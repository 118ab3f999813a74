"""The checked Levenberg-Marquardt: the minimum is GTSAM's, and every way a solve can go wrong is reported."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from filters.smoothing.levenberg_marquardt import Stopping, solve
from tests.filters.conftest import Problem
from toolkit.errors import EstimatorError
from toolkit.models.factors import L, StereoFactors, X
from toolkit.simulation import DRIVE, FLIGHT

EXACT, ONE = Stopping(relative_decrease=1e-12, max_iterations=100), Stopping(1e-12, 1)


@pytest.fixture(params=[DRIVE, FLIGHT], ids=["drive", "flight"])
def problem(request) -> Problem:
    return Problem(request.param)


def test_it_reaches_the_minimum_of_gtsams_own_optimizer(problem):
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setAbsoluteErrorTol(1e-12)
    reference = gtsam.LevenbergMarquardtOptimizer(problem.graph, problem.start, params)
    reference.optimize()
    solution = solve(problem.graph, problem.start, EXACT)
    assert solution.converged
    assert solution.error == pytest.approx(problem.graph.error(solution.values), rel=1e-12)
    # Both stop on a relative decrease of 1e-12; a millionth is far below what any state could feel.
    assert solution.error == pytest.approx(reference.error(), rel=1e-6)
    at_once, early = solve(problem.graph, solution.values, Stopping()), solve(problem.graph, problem.start, ONE)
    assert (at_once.iterations, at_once.converged) == (1, True)
    assert (early.iterations, early.converged) == (1, False)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_start_that_is_not_a_number_is_refused(problem, bad):
    some_landmark = int(problem.packets[0].frame.track_ids[0])
    problem.start.update(L(some_landmark), np.array([bad, 0.0, 5.0]))
    with pytest.raises(EstimatorError, match="not a number"):
        solve(problem.graph, problem.start, Stopping())


def behind(problem: Problem) -> np.ndarray:
    T_world_cam = problem.start.atPose3(X(0)).matrix() @ problem.rig.T_imu_cam
    return T_world_cam[:3, 3] - 5.0 * T_world_cam[:3, 2]


def test_a_landmark_behind_the_camera_does_not_stop_the_rest(problem):
    """GTSAM gives it a constant error without a Jacobian: its block of the system is zero but for the damping."""
    without = solve(problem.graph, problem.start, EXACT)
    constant = gtsam.NonlinearFactorGraph()
    frame = problem.packets[0].frame
    lost = replace(frame, track_ids=np.array([10**6]), uvs_px=frame.uvs_px[:1])
    for factor in StereoFactors(problem.rig).of(lost, 0):
        problem.graph.add(factor)
        constant.add(factor)
    problem.start.insert(L(10**6), behind(problem))
    solution = solve(problem.graph, problem.start, EXACT)
    assert solution.error - constant.error(solution.values) == pytest.approx(without.error, rel=1e-6)
    assert np.isfinite(solution.values.atPoint3(L(10**6))).all()


def test_a_direction_nothing_measures_is_left_alone():
    """Two poses and the step between them, and nothing that holds the first: the gauge stays where it started."""
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    step = gtsam.Pose3(gtsam.Rot3(), np.array([1.0, 0.0, 0.0]))
    graph.add(gtsam.BetweenFactorPose3(X(0), X(1), step, gtsam.noiseModel.Isotropic.Sigma(6, 0.1)))
    start.insert(X(0), gtsam.Pose3())
    start.insert(X(1), gtsam.Pose3(gtsam.Rot3.Yaw(0.1), np.array([1.2, 0.3, 0.0])))
    solution = solve(graph, start, EXACT)
    assert solution.converged
    assert solution.error == pytest.approx(0.0, abs=1e-12)
    assert np.abs(solution.values.atPose3(X(0)).matrix() - np.eye(4)).max() < 0.5
