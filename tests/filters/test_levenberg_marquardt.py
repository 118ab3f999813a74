"""The checked Levenberg-Marquardt: the minimum is GTSAM's, and every way a solve can go wrong is reported.

With Python factors a solver sees the same, together or one by one; and landmarks move in the image that saw them first.
"""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from filters.smoothing import levenberg_marquardt
from filters.smoothing.levenberg_marquardt import FirstImages, MixedGraph, Stopping, TwistFactors, solve
from tests.filters.conftest import Problem, short
from toolkit.errors import EstimatorError
from toolkit.geometry import Array, se3_exp, transform
from toolkit.measurements import StereoFrame, TwistMotion, TwistNoise
from toolkit.models import stereo
from toolkit.models.factors import B, L, StereoFactors, X
from toolkit.models.twist import TwistIncrement, TwistModel, twist_factor
from toolkit.simulation import DRIVE, FLIGHT

EXACT, ONE = Stopping(relative_decrease=1e-12, max_iterations=100), Stopping(1e-12, 1)


@pytest.fixture(params=[DRIVE, FLIGHT], ids=["drive", "flight"])
def problem(request) -> Problem:
    return Problem(short(request.param, 2.0, seed=2))


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


NOISE = TwistNoise(np.array([0.01, 0.02, 0.03]), np.array([0.1, 0.2, 0.3]), np.full(3, 1e-5))
STATES = 7


def test_errors_and_linearisations_are_the_graphs_own():
    problem = Problem(short(DRIVE, 2.0, seed=2))
    graph, start, increments = problem.graph, problem.start, problem.increments
    expected = graph.linearize(start)
    step = start.zeroVectors().scale(0.0)
    for together in ({}, increments):
        mixed = MixedGraph(graph, together)
        assert len(mixed._single) == len(increments) - len(together), "factors on arrays are never called"
        assert mixed.error(start) == pytest.approx(graph.error(start), rel=1e-10)
        linear = mixed.linear(start)
        assert linear.error(step) == pytest.approx(expected.error(step), rel=1e-10)
        found, own = linear.gradientAtZero(), expected.gradientAtZero()
        for key in start.keys():  # noqa: SIM118 - not a mapping
            np.testing.assert_allclose(found.at(key), own.at(key), atol=1e-8 * np.abs(own.at(X(0))).max())


@pytest.mark.parametrize("size", [0.0, 1e-6, 1e-2, 0.7])
def test_twists_together_have_the_errors_and_linearisations_of_their_factors(size):
    """At states that are off what the steps predict by about a size (rad, m)."""
    rng, model, steps = np.random.default_rng(3), TwistModel(NOISE), dict[int, TwistIncrement]()
    values, pose = gtsam.Values(), se3_exp(rng.standard_normal(6))
    for k in range(STATES):
        if k:
            motion = TwistMotion(np.array([0.04, 0.07]), 8.0 * rng.standard_normal((2, 3)), rng.standard_normal((2, 3)))
            steps[k] = model.integrate(motion, 0.1 * rng.standard_normal(6))
            pose = pose @ steps[k].T_start_end
        values.insert(X(k), gtsam.Pose3(pose @ se3_exp(size * rng.standard_normal(6))))
        values.insert(B(k), 0.1 * rng.standard_normal(3))
    single = [twist_factor(increment, k) for k, increment in steps.items()]
    together = TwistFactors.of(steps)
    assert together.keys == [tuple(factor.keys()) for factor in single]
    errors = 0.5 * np.square(together.residuals(values)).sum(axis=1)
    # Twelve digits of squares that the smallest sigma makes a million times the residuals'.
    np.testing.assert_allclose(errors, [factor.error(values) for factor in single], rtol=1e-9, atol=1e-16)
    for found, factor in zip(together.linear(values), single, strict=True):
        expected = factor.linearize(values).augmentedInformation()
        np.testing.assert_allclose(found.augmentedInformation(), expected, atol=1e-9 * np.abs(expected).max())


RIG, SEEN = DRIVE.rig, 6
TO_THE_END = Stopping(1e-12, 40)


def bent_drive(seed: int) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, FirstImages]:
    """Return 200 m straight ahead, told by five tracks a frame and a vague twist, and a start that turns by 0.4 rad."""
    rng, count = np.random.default_rng(seed), 200
    ahead, up = RIG.T_imu_cam[:3, 2], RIG.T_imu_cam[:3, 1]
    step, turn = se3_exp(np.concatenate([np.zeros(3), ahead])), se3_exp(np.concatenate([0.002 * up, np.zeros(3)]))
    poses, bent = [np.eye(4)], [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step)
        bent.append(bent[-1] @ step @ turn)
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    rows: list[list[tuple[int, Array]]] = [[] for _ in poses]
    for i in range(5 * count // SEEN):
        begins = rng.integers(0, count - SEEN) if i >= count // 3 else min(3 * i, count - SEEN)
        in_camera = np.array([*(rng.uniform(-1.0, 1.0, 2) * [6.0, 2.0]), rng.uniform(12.0, 40.0)])
        point, start_point = (transform(path[begins] @ RIG.T_imu_cam, in_camera[None])[0] for path in (poses, bent))
        for age in range(SEEN):
            seen_px = stereo.predict(point[None], poses[begins + age], RIG).uv_px[0] + rng.normal(0.0, 0.5, 3)
            rows[begins + age].append((i, seen_px))
        start.insert(L(i), start_point)
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    twist, frames = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.05, 0.5], 3)), list[StereoFrame]()
    for k, row in enumerate(rows):
        start.insert(X(k), gtsam.Pose3(bent[k]))
        if k:
            graph.add(gtsam.BetweenFactorPose3(X(k - 1), X(k), gtsam.Pose3(step), twist))
        ids, seen_px = [i for i, _ in row], [seen_px for _, seen_px in row]
        frames.append(StereoFrame(k, np.array(ids, dtype=np.int64), np.array(seen_px).reshape(-1, 3)))
        for factor in StereoFactors(RIG).of(frames[k], k):
            graph.add(factor)
    return graph, start, FirstImages.of(frames, RIG)


def test_a_solve_whose_last_iteration_gained_little_enough_has_converged_without_an_end():
    graph, start, images = bent_drive(0)
    for enough, converged in ((1e-3, False), (10.0, True)):
        solution = solve(graph, start, Stopping(0.0, 3, enough=enough), landmarks=images)
        assert solution.iterations == 3
        assert solution.converged == converged


def test_a_start_that_drifts_comes_to_the_minimum_in_few_iterations():
    """With landmarks that move in metres, this took 60 (the most allowed), and ended 10 m off."""
    graph, start, images = bent_drive(0)
    solution = solve(graph, start, Stopping(1e-4, 10), landmarks=images)
    assert solution.converged
    assert solution.overshot
    longer = solve(graph, start, TO_THE_END, landmarks=images)
    ends = [it.values.atPose3(X(199)).translation() for it in (solution, longer)]
    # A thousandth of what it drifts by at the start: that the error falls by less than 1e-4 of it leaves some.
    assert np.linalg.norm(ends[0] - ends[1]) < 0.1
    assert solution.error == pytest.approx(graph.error(solution.values), rel=1e-12)


def test_a_step_that_was_damped_because_it_raised_the_error_is_not_the_last(monkeypatch):
    graph, start, images = bent_drive(0)
    any_gain_is_little = Stopping(1e9, 10)
    assert solve(graph, start, any_gain_is_little, landmarks=images).iterations == 2
    # Held back from the first, it does not overshoot.
    monkeypatch.setattr(levenberg_marquardt, "_FIRST_DAMPING", 100.0)
    held_back = solve(graph, start, any_gain_is_little, landmarks=images)
    assert (held_back.iterations, held_back.overshot) == (1, False)


def test_landmarks_that_move_in_images_at_once_take_no_step_in_metres_to_the_same_minimum():
    graph, start, images = bent_drive(0)
    late, early = (solve(graph, start, TO_THE_END, landmarks=it) for it in (images, replace(images, at_once=True)))
    assert early.converged
    assert late.overshot
    assert not early.overshot
    assert early.error == pytest.approx(late.error, rel=1e-9)


def test_landmarks_move_to_first_order_by_the_graphs_own_step():
    _, start, images = bent_drive(0)
    rng, step, length = np.random.default_rng(0), gtsam.VectorValues(), 1e-6
    for key, size in start.dims().items():
        step.insert(key, rng.standard_normal(size))
    there = images.taken(start, step.scale(length))
    moved = start.localCoordinates(there)
    for key in start.keys():  # noqa: SIM118 - not a mapping
        # A landmark's second derivative by a step is below 300.
        np.testing.assert_allclose(moved.at(key) / length, step.at(key), atol=1e-3)


def test_a_landmark_whose_disparity_is_below_a_pixel_moves_in_its_image_all_the_same():
    _, start, images = bent_drive(0)
    far, first = L(int(images.track_ids[0])), X(int(images.first[0]))
    in_camera = np.array([[1.0, 1.0, RIG.fx_px * RIG.baseline_m / 0.5]])
    start.update(far, transform(start.atPose3(first).matrix() @ RIG.T_imu_cam, in_camera)[0])
    step, turn = start.zeroVectors(), gtsam.VectorValues()
    turn.insert(first, np.array([0.01, 0.02, 0.2, 0.0, 0.0, 0.0]))
    step.update(turn)
    there = images.taken(start, step)
    before, after = (stereo.predict(it.atPoint3(far)[None], it.atPose3(first).matrix(), RIG) for it in (start, there))
    np.testing.assert_allclose(after.uv_px[0], before.uv_px[0] + before.d_uv_d_pose[0] @ step.at(first), rtol=1e-9)


def test_a_landmark_behind_its_camera_takes_its_metres():
    _, start, images = bent_drive(0)
    behind = L(int(images.track_ids[0]))
    start.update(behind, -start.atPoint3(behind) - 100.0 * RIG.T_imu_cam[:3, 2])
    by_m, own, step = np.array([1.0, 2.0, 3.0]), gtsam.VectorValues(), start.zeroVectors()
    own.insert(behind, by_m)
    step.update(own)
    moved = images.taken(start, step).atPoint3(behind)
    np.testing.assert_allclose(moved, start.atPoint3(behind) + by_m, rtol=1e-12)


def test_the_images_of_a_graph_are_those_of_its_frames():
    graph, _, images = bent_drive(0)
    found = FirstImages.in_graph(graph, RIG)
    np.testing.assert_array_equal(found.track_ids, images.track_ids)
    np.testing.assert_array_equal(found.first, images.first)


def test_a_solve_that_needs_no_end_ends_at_the_first_step_that_raises_the_error_after_one_that_lowered_it(monkeypatch):
    # Held back from the first, it lowers the error until damping has become small.
    monkeypatch.setattr(levenberg_marquardt, "_FIRST_DAMPING", 100.0)
    tried, error = list[float](), MixedGraph.error
    monkeypatch.setattr(MixedGraph, "error", lambda self, values: tried.append(error(self, values)) or tried[-1])
    graph, start, _ = bent_drive(0)
    solution = solve(graph, start, Stopping(1e-4, 60, at_overshoot=True))
    until_overshot = tried.copy()
    tried.clear()
    patient = solve(graph, start, Stopping(1e-4, 60))
    assert min(until_overshot) == solution.error == until_overshot[-2] < until_overshot[-1]
    assert until_overshot[:-1] == sorted(until_overshot[:-1], reverse=True)
    assert tried[: len(until_overshot)] == until_overshot
    assert patient.error < solution.error
    assert solution.overshot
