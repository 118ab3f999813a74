"""Smart factors: eliminating landmarks loses nothing, and the window goes on whatever happens in it."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from toolkit.geometry import se3_exp, transform
from toolkit.measurements import StereoFrame
from toolkit.models import stereo
from toolkit.models.factors import L, StereoFactors, X, ordering_of
from toolkit.models.stereo_adjustment import (
    Ending,
    Evaluated,
    RobustCamera,
    Sightings,
    StereoWindow,
    Vision,
    solve_window,
)
from toolkit.settings import DEFAULTS
from toolkit.simulation import FLIGHT

RIG, HUBER = FLIGHT.rig, DEFAULTS.outliers.smoother_huber
CAMERA = RobustCamera(RIG, HUBER)
POSES, POINTS = 4, 7


@pytest.fixture(scope="module")
def scene():
    """Return poses, points and what each pose sees of each point, half a pixel off."""
    rng = np.random.default_rng(0)
    poses = se3_exp(0.05 * rng.standard_normal((POSES, 6)))
    points_cam = np.column_stack([rng.uniform(-1.0, 1.0, (POINTS, 2)), rng.uniform(3.0, 6.0, POINTS)])
    points = transform(RIG.T_imu_cam, points_cam)
    pose, point = (a.ravel() for a in np.meshgrid(np.arange(POSES), np.arange(POINTS), indexing="ij"))
    exact = stereo.predict(points[point], poses[pose], RIG).uv_px
    return poses, points, Sightings(pose, point, exact + 0.5 * rng.standard_normal(exact.shape))


def gtsam_values(poses, points):
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(X(k), gtsam.Pose3(pose))
    for i, point in enumerate(points):
        values.insert(L(i), point)
    return values


def projection_factors(seen):
    graph, maker = gtsam.NonlinearFactorGraph(), StereoFactors(RIG, HUBER)
    for k in range(POSES):
        rows = seen.pose == k
        for factor in maker.of(StereoFrame(0, seen.point[rows], seen.uv_px[rows]), k):
            graph.add(factor)
    return graph


def test_it_says_of_the_poses_what_gtsam_projection_factors_say_once_their_landmarks_are_eliminated(scene):
    """In its loss, in information and vector, and in the steps of the points that complete a step of the poses."""
    poses, points, seen = scene
    outlying = replace(seen, uv_px=seen.uv_px + np.where(np.arange(len(seen.pose)) == 3, 8.0, 0.0)[:, None])
    factors, values = projection_factors(outlying), gtsam_values(poses, points)
    vision = Vision.at(poses, points, outlying, CAMERA)
    assert vision.losses.sum() == pytest.approx(factors.error(values), rel=1e-9)
    information, vector = factors.linearize(values).hessian(
        ordering_of([*map(X, range(POSES)), *map(L, range(POINTS))])
    )
    n, reduced = 6 * POSES, vision.reduced()
    across = information[:n, n:] @ np.linalg.inv(information[n:, n:])
    # Rounding, relative to the largest entry.
    scale = np.abs(reduced.information).max()
    expected = information[:n, :n] - across @ information[n:, :n]
    np.testing.assert_allclose(reduced.information, expected, atol=1e-9 * scale)
    np.testing.assert_allclose(reduced.vector, vector[:n].ravel() - across @ vector[n:].ravel(), atol=1e-9 * scale)
    held = information + np.diag(np.repeat([1.0, 0.0], [n, 3 * POINTS]))
    step = np.linalg.solve(held, vector.ravel())
    np.testing.assert_allclose(reduced.point_steps(step[:n]).ravel(), step[n:], atol=1e-9)


def test_a_landmark_that_overshoots_behind_a_camera_does_not_keep_a_window_from_its_minimum(scene):
    """It starts three times as far as it is: its step to there is longer than it is away."""
    poses, points, seen = scene
    centre = transform(RIG.T_imu_cam, np.zeros((1, 3)))[0]
    start = points.copy()
    start[0] = centre + 3.0 * (points[0] - centre)
    values, motion = gtsam_values(poses, []), gtsam.NonlinearFactorGraph()
    for k, pose in enumerate(poses):
        motion.add(gtsam.PriorFactorPose3(X(k), gtsam.Pose3(pose), gtsam.noiseModel.Isotropic.Sigma(6, 1e-2)))
    keys, empty = tuple((X(k),) for k in range(POSES)), StereoWindow.empty()
    ends = []
    for begin in (start, points):
        window = replace(empty, keys=keys, values=values, motion=(motion,), sightings=seen, points=begin)
        first_step = Evaluated.of(window, CAMERA).linearised().vision.point_steps(np.zeros(6 * POSES))
        for _ in range(6):
            window = solve_window(window, CAMERA, Ending()).window
        ends.append((first_step, window))
    (step, far), (_, near) = ends
    assert transform(np.linalg.inv(poses[0] @ RIG.T_imu_cam), (start + step)[:1])[0, 2] < 0.0
    np.testing.assert_allclose(far.points, near.points, atol=1e-4)
    np.testing.assert_allclose(far.poses, near.poses, atol=1e-5)


def test_a_sighting_from_behind_says_nothing_but_costs(scene):
    poses, points, seen = scene
    behind = points.copy()
    behind[0] = transform(RIG.T_imu_cam, np.array([0.0, 0.0, -4.0]))
    others = Sightings(*(part[seen.point != 0] for part in (seen.pose, seen.point, seen.uv_px)))
    one, other = (Vision.at(poses, behind, s, CAMERA).reduced() for s in (seen, others))
    np.testing.assert_allclose(one.information, other.information, atol=1e-9)
    assert Vision.at(poses, behind, seen, CAMERA).losses.sum() > Vision.at(poses, behind, others, CAMERA).losses.sum()
