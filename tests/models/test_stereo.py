"""The stereo model: its Jacobians, its inverse, and that it is GTSAM's projection factor on every real sighting.

Ours is measured - predicted; GTSAM's unwhitenedError is predicted - measured. Its Jacobians are therefore those of
the prediction, as ours are, and only the residual changes its sign.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import gtsam
import numpy as np
import pytest

from toolkit.answers import Run
from toolkit.datasets import load_sequence
from toolkit.geometry import Array, se3_exp
from toolkit.initialization import start_from_measurements
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.camera_motion import triangulation_jacobian
from toolkit.models.factors import L, StereoFactors, X
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, FLIGHT

# Pixels are of the order of 1e3 and Jacobian entries of 1e4 (px / rad at 40 m): 1e-9 of the largest entry of a
# sighting is a thousand times what double precision costs and a millionth of what any modelling slip would show.
TOLERANCE = 1e-9

every_rig = pytest.mark.parametrize("rig", [DRIVE.rig, FLIGHT.rig], ids=["drive", "flight"])


@pytest.fixture
def pose() -> Array:
    return se3_exp(np.array([0.4, -0.8, 1.1, 3.0, -2.0, 5.0]))


@pytest.fixture
def points_cam() -> Array:
    """Forty points in the field of view, 2 to 30 m away."""
    rng = np.random.default_rng(1)
    depth_m = rng.uniform(2.0, 30.0, 40)
    return np.stack([rng.uniform(-0.5, 0.5, 40) * depth_m, rng.uniform(-0.3, 0.3, 40) * depth_m, depth_m], axis=1)


def in_world(points_cam: Array, pose: Array, rig: StereoRig) -> Array:
    T_world_cam = pose @ rig.T_imu_cam
    return points_cam @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]


@every_rig
def test_projection_jacobian_is_the_derivative(rig, points_cam, numerical_jacobian):
    numerical = numerical_jacobian(lambda d: stereo.project(points_cam + d, rig), 3)
    # 1e-7 of entries up to 350 px / m: the points are 2 m away at least, where the step's own error is 1e-9.
    np.testing.assert_allclose(stereo.projection_jacobian(points_cam, rig), numerical, atol=1e-7 * 350.0)


@every_rig
def test_pose_jacobian_is_the_derivative_on_the_right(rig, pose, points_cam, numerical_jacobian):
    points = in_world(points_cam, pose, rig)
    predicted = stereo.predict(points, pose, rig)
    numerical = numerical_jacobian(lambda xi: stereo.predict(points, pose @ se3_exp(xi), rig).uv_px, 6)
    np.testing.assert_allclose(predicted.d_uv_d_pose, numerical, atol=1e-7 * np.abs(numerical).max())


@every_rig
def test_point_jacobian_is_the_derivative(rig, pose, points_cam, numerical_jacobian):
    points = in_world(points_cam, pose, rig)
    numerical = numerical_jacobian(lambda d: stereo.predict(points + d, pose, rig).uv_px, 3)
    predicted = stereo.predict(points, pose, rig)
    np.testing.assert_allclose(predicted.d_uv_d_point, numerical, atol=1e-7 * np.abs(numerical).max())


@every_rig
def test_many_poses_at_once_give_what_each_gives_alone(rig, pose, points_cam):
    points = in_world(points_cam, pose, rig)
    poses = pose @ se3_exp(0.01 * np.random.default_rng(2).standard_normal((len(points), 6)))
    together = stereo.predict(points, poses, rig)
    for i in range(len(points)):
        alone = stereo.predict(points[i : i + 1], poses[i], rig)
        for one, all_ in zip(alone, together, strict=True):
            # The same products in another order: a few units in the last place of numbers up to 1e4.
            np.testing.assert_allclose(one[0], all_[i], rtol=1e-11, atol=1e-10)


@every_rig
def test_triangulation_inverts_the_projection(rig, pose, points_cam):
    points = in_world(points_cam, pose, rig)
    uvs_px = stereo.predict(points, pose, rig).uv_px
    # A disparity of 2 px at 30 m leaves eleven digits of the depth.
    np.testing.assert_allclose(stereo.triangulate_world(uvs_px, pose, rig), points, atol=1e-9)


@every_rig
def test_a_triangulations_jacobian_is_the_inverse_of_the_projections(rig, points_cam):
    of_triangulation = np.moveaxis(triangulation_jacobian(points_cam.T, rig), -1, 0)
    product = stereo.projection_jacobian(points_cam, rig) @ of_triangulation
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-12)


def test_depth_is_negative_behind_the_camera(pose):
    behind = in_world(np.array([[0.5, 0.2, -4.0]]), pose, DRIVE.rig)
    assert stereo.predict(behind, pose, DRIVE.rig).depth_m == pytest.approx([-4.0])


def test_a_point_in_the_plane_of_the_camera_has_an_image_and_keeps_its_depth(pose):
    """What nothing can see must not spoil the rows beside it with numbers that are none."""
    beside = in_world(np.array([[0.5, 0.2, 0.0], [0.5, 0.2, 4.0]]), pose, DRIVE.rig)
    predicted = stereo.predict(beside, pose, DRIVE.rig)
    assert all(np.isfinite(part).all() for part in predicted)
    np.testing.assert_allclose(predicted.depth_m, [0.0, 4.0], atol=1e-12)


class Sighted(NamedTuple):
    """A frame with the pose and the points (N, 3) its factors are evaluated at."""

    frame: StereoFrame
    T_world_imu: Array
    points: Array


def disturbed_sightings(sequence: Sequence, run: Run) -> Iterator[Sighted]:
    """Yield every frame at the filter's pose, with each point half a metre off where stereo sees it.

    GTSAM gives a point behind the camera a residual of its own making; a sighting without disparity is therefore
    evaluated at 20 m.
    """
    rng = np.random.default_rng(3)
    for packet, T_world_imu in zip(sequence.packets(), run.causal.T_world_imu, strict=True):
        frame, rig = packet.frame, sequence.rig
        least_px = rig.fx_px * rig.baseline_m / 20.0
        seen_px = frame.uvs_px.copy()
        seen_px[:, 1] = np.where(stereo.disparity_px(seen_px) > 2.0, seen_px[:, 1], seen_px[:, 0] - least_px)
        points_cam = stereo.triangulate(seen_px, rig)
        points_cam += 0.5 * rng.uniform(-1.0, 1.0, points_cam.shape) * np.minimum(1.0, 0.2 * points_cam[:, 2:])
        yield Sighted(frame, T_world_imu, in_world(points_cam, T_world_imu, rig))


def gtsam_says(sighted: Sighted, maker: StereoFactors) -> tuple[Array, Array]:
    """Return GTSAM's residuals (N, 3) and Jacobians (N, 3, 9) of pose and point, both unwhitened."""
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(sighted.T_world_imu))
    for track_id, point in zip(sighted.frame.track_ids.tolist(), sighted.points, strict=True):
        values.insert(L(track_id), point)
    errors, jacobians = [], []
    for factor in maker.of(sighted.frame, 0):
        jacobian, right_hand_side = factor.linearize(values).jacobian()
        errors.append(-right_hand_side)
        jacobians.append(jacobian)
    return np.array(errors), np.array(jacobians)


def assert_equal_on_every_sighting(sequence: Sequence, run: Run) -> None:
    # GTSAM linearises whitened: with the rig's own noise that would be R r and R H, R^T R = cov^-1.
    whitening = np.linalg.cholesky(np.linalg.inv(sequence.rig.cov_uv_px2)).T
    maker, compared = StereoFactors(sequence.rig), 0
    for sighted in disturbed_sightings(sequence, run):
        if not len(sighted.points):
            continue
        predicted = stereo.predict(sighted.points, sighted.T_world_imu, sequence.rig)
        assert (predicted.depth_m > 0.0).all()
        residuals = whitening @ (sighted.frame.uvs_px - predicted.uv_px)[..., None]
        ours = whitening @ np.concatenate([predicted.d_uv_d_pose, predicted.d_uv_d_point], axis=2)
        errors, jacobians = gtsam_says(sighted, maker)
        np.testing.assert_allclose(residuals[..., 0], -errors, rtol=0.0, atol=TOLERANCE * 1e3)
        largest = np.abs(jacobians).max(axis=(1, 2))
        assert (np.abs(ours - jacobians).max(axis=(1, 2)) / largest).max() < TOLERANCE
        compared += len(errors)
    assert compared == len(sequence.visible)


def test_model_equals_gtsams_factor_on_every_sighting_of_kitti00(run_estimator: Callable[..., Run]):
    sequence = load_sequence("kitti00")
    run = run_estimator("dead-reckoning", sequence, start_from_measurements(sequence))
    assert_equal_on_every_sighting(sequence, run)
