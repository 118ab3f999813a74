"""Steps of landmarks in the image that saw them first: solves along tracks that crept under Levenberg's damping."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from filters.smoothing.robust_loss import Squares
from filters.smoothing.track_chain import ChainedFactors, ChainedSightings

from filters.smoothing import levenberg_marquardt
from filters.smoothing.landmark_steps import FirstImages
from filters.smoothing.levenberg_marquardt import Solution, Stopping, solve
from filters.smoothing.mixed_graph import MixedGraph
from toolkit.geometry import Array, se3_exp, transform
from toolkit.models import stereo
from toolkit.models.factors import L, StereoFactors, X
from toolkit.sequence import StereoFrame
from toolkit.simulation import DRIVE
from toolkit.simulation.track_noise import TrackNoise

NOISE = TrackNoise(np.array([0.03, 0.06, 0.03]), np.full(3, 0.13), np.array([0.0, 0.7, 0.0]))
RIG = replace(DRIVE.rig, track_noise=NOISE)
FRAMES, TRACKS, SEEN, FAR, FAR_M = 40, 20, 6, 2, 150.0
SEEDS = [0, 2, 4]
EXACT = Stopping(0.0, 40, decrease=1e-9)


def errors_px(rng: np.random.Generator, offset_px: float) -> Array:
    """Return the errors (SEEN, 3) px of a track in (uL, uR, v): a walk, and an offset of its disparity."""
    walk_px = rng.normal(0.0, 0.13, (SEEN, 3)).cumsum(axis=0)
    return walk_px + np.array([0.5 * offset_px, -0.5 * offset_px, 0.0])


def drive(seed: int) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, ChainedFactors]:
    """Return a drive of 1 m a frame straight ahead, its start 2 % too long: motion, start and sightings.

    Two of twenty landmarks are 150 m away, where disparities are 2.5 px, and those of their tracks are 4 px less.
    """
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, 3] = np.arange(FRAMES)[:, None] * RIG.T_imu_cam[:3, 2]
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    rows: list[list[tuple[int, Array, int]]] = [[] for _ in poses]
    for i in range(TRACKS):
        begins, depth_m = rng.integers(0, FRAMES - SEEN), rng.uniform(12.0, 40.0)
        across_m = rng.uniform(-1.0, 1.0, 2) * [6.0, 2.0]
        in_camera = np.array([*across_m, depth_m]) * (FAR_M / depth_m if i < FAR else 1.0)
        point = transform(poses[begins] @ RIG.T_imu_cam, in_camera[None])[0]
        off_px = errors_px(rng, -4.0 if i < FAR else rng.normal(0.0, 0.7))
        for age in range(SEEN):
            seen_px = stereo.predict(point[None], poses[begins + age], RIG).uv_px[0] + off_px[age]
            rows[begins + age].append((i, seen_px, age))
        start.insert(L(i), 1.02 * point)
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    twist = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.05, 0.5], 3))
    for k, pose in enumerate(poses):
        start.insert(X(k), gtsam.Pose3(gtsam.Rot3(), 1.02 * pose[:3, 3]))
        if k:
            step = gtsam.Pose3(np.linalg.inv(poses[k - 1]) @ pose)
            graph.add(gtsam.BetweenFactorPose3(X(k - 1), X(k), step, twist))
    frames = [frame_of(k, row) for k, row in enumerate(rows)]
    return graph, start, ChainedFactors(ChainedSightings.of(frames, RIG), RIG, Squares())


def frame_of(k: int, rows: list[tuple[int, Array, int]]) -> StereoFrame:
    ids, seen_px, ages = zip(*rows, strict=True) if rows else ((), (), ())
    uvs_px = np.array(seen_px).reshape(-1, 3)
    return StereoFrame(k, np.array(ids, dtype=np.int64), uvs_px, np.array(ages, dtype=np.int64))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_solve_with_landmarks_beyond_infinity_comes_to_its_end_in_few_iterations(seed):
    """With all damped alike, in metres, these took 55, 36 and 33, and ended 3, 4 and 15 units higher."""
    graph, start, sightings = drive(seed)
    solution = solve(graph, start, Stopping(0.0, 12, decrease=0.01), landmarks=sightings)
    assert solution.converged
    longer = solve(graph, start, EXACT, landmarks=sightings)
    # A tenth of a unit of chi-square is nothing to any state.
    assert solution.error - longer.error < 0.1
    assert solution.error == pytest.approx(graph.error(solution.values) + sightings.error(solution.values), rel=1e-12)


def test_landmarks_measured_beyond_infinity_stay_in_front_of_the_cameras_that_saw_them_first():
    graph, start, sightings = drive(2)
    solution = solve(graph, start, EXACT, landmarks=sightings)
    predicted = sightings.predicted(solution.values)
    assert (predicted.depth_m > 0.0).all()
    assert np.isfinite(predicted.uv_px).all()
    assert predicted.depth_m.max() > 10.0 * FAR_M


def test_the_end_of_a_solve_has_no_gradient():
    graph, start, sightings = drive(2)
    end = solve(graph, start, EXACT, landmarks=sightings).values
    steepest = []
    for values in (start, end):
        whole = gtsam.NonlinearFactorGraph(graph)
        whole.push_back(sightings.linearised(values))
        gradient = whole.linearize(values).gradientAtZero()
        steepest.append(max(np.abs(gradient.at(key)).max() for key in values.keys()))  # noqa: SIM118 - not a mapping
    # Of the start's. The rest is what a decrease of 1e-9 leaves.
    assert steepest[1] < 1e-5 * steepest[0]


def test_the_values_move_to_first_order_by_the_step_that_is_solved_for():
    _, start, sightings = drive(2)
    steps = sightings.landmark_steps(start)
    rng, step = np.random.default_rng(0), gtsam.VectorValues()
    for key, size in start.dims().items():
        step.insert(key, rng.standard_normal(size))
    slope = steps.sightings.gradientAtZero()
    seen = [key for key in start.keys() if slope.exists(key)]  # noqa: SIM118 - not a mapping
    of_sightings = sum(slope.at(key) @ step.at(key) for key in seen)
    length = 1e-6
    ahead, behind = (sightings.error(steps.taken(step.scale(sign * length))) for sign in (1.0, -1.0))
    # The third derivative is what is left of a difference to both sides.
    assert (ahead - behind) / (2.0 * length) == pytest.approx(of_sightings, rel=1e-5)


def test_stopped_before_its_end_it_has_not_converged():
    graph, start, sightings = drive(2)
    solution = solve(graph, start, Stopping(0.0, 2, decrease=0.01), landmarks=sightings)
    assert not solution.converged
    assert solution.iterations == 2


def test_a_solve_whose_last_iteration_gained_little_enough_has_converged_without_an_end():
    graph, start, sightings = drive(2)
    for enough, converged in ((1e-3, False), (10.0, True)):
        solution = solve(graph, start, Stopping(0.0, 2, enough=enough), landmarks=sightings)
        assert solution.iterations == 2
        assert solution.converged == converged


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
    rows: list[list[tuple[int, Array, int]]] = [[] for _ in poses]
    for i in range(5 * count // SEEN):
        begins = rng.integers(0, count - SEEN) if i >= count // 3 else min(3 * i, count - SEEN)
        in_camera = np.array([*(rng.uniform(-1.0, 1.0, 2) * [6.0, 2.0]), rng.uniform(12.0, 40.0)])
        point, start_point = (transform(path[begins] @ RIG.T_imu_cam, in_camera[None])[0] for path in (poses, bent))
        for age in range(SEEN):
            seen_px = stereo.predict(point[None], poses[begins + age], DRIVE.rig).uv_px[0] + rng.normal(0.0, 0.5, 3)
            rows[begins + age].append((i, seen_px, age))
        start.insert(L(i), start_point)
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    twist, frames = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.05, 0.5], 3)), list[StereoFrame]()
    for k, row in enumerate(rows):
        start.insert(X(k), gtsam.Pose3(bent[k]))
        if k:
            graph.add(gtsam.BetweenFactorPose3(X(k - 1), X(k), gtsam.Pose3(step), twist))
        frames.append(frame_of(k, row))
        for factor in StereoFactors(DRIVE.rig).of(frames[k], k):
            graph.add(factor)
    return graph, start, FirstImages.of(frames, DRIVE.rig)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_start_that_drifts_comes_to_the_minimum_in_few_iterations(seed):
    """With landmarks that move in metres, these took 60 (the most allowed) and 30, and ended 10 and 6 m off."""
    graph, start, images = bent_drive(seed)
    solution = solve(graph, start, Stopping(1e-4, 10), landmarks=images)
    assert solution.converged
    longer = solve(graph, start, EXACT, landmarks=images)
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
    assert solve(graph, start, any_gain_is_little, landmarks=images).iterations == 1


def test_as_long_as_no_step_raises_the_error_all_is_gtsams_own(monkeypatch):
    monkeypatch.setattr(levenberg_marquardt, "_FIRST_DAMPING", 100.0)
    graph, start, images = bent_drive(0)
    alone, with_images = (solve(graph, start, Stopping(0.0, 2), landmarks=it) for it in (None, images))
    assert alone.error == with_images.error
    assert alone.values.equals(with_images.values, 0.0)


def test_a_solve_says_whether_a_step_in_metres_raised_the_error(monkeypatch):
    graph, start, images = bent_drive(0)
    assert solve(graph, start, Stopping(1e-4, 10), landmarks=images).overshot
    # The same without images to move in, as Huber's solve is.
    assert solve(graph, start, Stopping(1e-4, 10)).overshot
    monkeypatch.setattr(levenberg_marquardt, "_FIRST_DAMPING", 100.0)
    assert not solve(graph, start, Stopping(0.0, 2), landmarks=images).overshot


def test_landmarks_that_move_in_images_at_once_take_no_step_in_metres_to_the_same_minimum():
    graph, start, images = bent_drive(0)
    late, early = (solve(graph, start, EXACT, landmarks=it) for it in (images, replace(images, at_once=True)))
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
    in_camera = np.array([[1.0, 1.0, DRIVE.rig.fx_px * DRIVE.rig.baseline_m / 0.5]])
    start.update(far, transform(start.atPose3(first).matrix() @ RIG.T_imu_cam, in_camera)[0])
    step, turn = start.zeroVectors(), gtsam.VectorValues()
    turn.insert(first, np.array([0.01, 0.02, 0.2, 0.0, 0.0, 0.0]))
    step.update(turn)
    there = images.taken(start, step)
    before, after = (
        stereo.predict(it.atPoint3(far)[None], it.atPose3(first).matrix(), DRIVE.rig) for it in (start, there)
    )
    np.testing.assert_allclose(after.uv_px[0], before.uv_px[0] + before.d_uv_d_pose[0] @ step.at(first), rtol=1e-9)


def test_a_landmark_of_which_sightings_say_nothing_is_held_all_the_same():
    _, start, sightings = drive(2)
    steps = sightings.landmark_steps(start)
    unknown = replace(steps, information=np.zeros_like(steps.information))
    for factor in map(unknown.damping(1.0).at, range(TRACKS)):
        information = np.diag(factor.information())[:3]
        assert (information > 0.0).all()
        assert np.isfinite(information).all()


def test_a_step_damped_by_far_more_than_it_should_be_is_not_the_last(monkeypatch):
    graph, start, sightings = drive(2)
    any_gain_is_little = Stopping(1e9, 12)
    assert solve(graph, start, any_gain_is_little, landmarks=sightings).iterations == 1
    monkeypatch.setattr(levenberg_marquardt, "_FIRST_SHARE", 1e-2)
    assert solve(graph, start, any_gain_is_little, landmarks=sightings).iterations > 1


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
    found = FirstImages.in_graph(graph, DRIVE.rig)
    np.testing.assert_array_equal(found.track_ids, images.track_ids)
    np.testing.assert_array_equal(found.first, images.first)


def errors_tried(stopping, monkeypatch) -> tuple[list[float], Solution]:
    """Return the errors a solve of the bent drive with a Python factor looks at, and its answer."""
    graph, start, _ = bent_drive(0)
    here = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
    graph.add(gtsam.CustomFactor(here, [X(0)], pose_error))
    tried, error = list[float](), MixedGraph.error
    monkeypatch.setattr(MixedGraph, "error", lambda self, values: tried.append(error(self, values)) or tried[-1])
    return tried, solve(graph, start, stopping)


def pose_error(_factor: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
    """Return how far the first pose is from the origin, (6,), with its derivative at the origin."""
    if H is not None:
        H[0] = np.eye(6)
    return np.asarray(gtsam.Pose3.Logmap(values.atPose3(X(0))))


def test_a_solve_that_needs_no_end_ends_at_the_first_step_that_raises_the_error_after_one_that_lowered_it(monkeypatch):
    # Held back from the first, it lowers the error until damping has become small.
    monkeypatch.setattr(levenberg_marquardt, "_FIRST_DAMPING", 100.0)
    with monkeypatch.context() as counting:
        tried, solution = errors_tried(Stopping(1e-4, 60, at_overshoot=True), counting)
    with monkeypatch.context() as counting:
        longer, patient = errors_tried(Stopping(1e-4, 60), counting)
    assert min(tried) == solution.error == tried[-2] < tried[-1]
    assert tried[:-1] == sorted(tried[:-1], reverse=True)
    assert longer[: len(tried)] == tried
    assert patient.error < solution.error
    assert solution.overshot
