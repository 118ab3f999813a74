"""The stereo model: its Jacobians, its inverse, and that it is GTSAM's projection factor on every real sighting.

Ours is measured - predicted; GTSAM's unwhitenedError is predicted - measured. Its Jacobians are therefore those of
the prediction, as ours are, and only the residual changes its sign.
"""

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from tests.models.conftest import numerical_jacobian
from toolkit.answers import Run
from toolkit.datasets import load_sequence
from toolkit.geometry import Array, se3_exp, transform
from toolkit.initialization import start_from_measurements
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.camera_motion import triangulation_jacobian
from toolkit.models.factors import L, StereoFactors, X
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
def test_jacobians_are_derivatives_that_of_the_pose_on_the_right(rig, pose, points_cam):
    points = in_world(points_cam, pose, rig)
    predicted = stereo.predict(points, pose, rig)
    of_pose = numerical_jacobian(lambda xi: stereo.predict(points, pose @ se3_exp(xi), rig).uv_px, 6)
    of_point = numerical_jacobian(lambda d: stereo.predict(points + d, pose, rig).uv_px, 3)
    for found, expected in ((predicted.d_uv_d_pose, of_pose), (predicted.d_uv_d_point, of_point)):
        np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


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


def test_a_point_in_the_plane_of_the_camera_has_an_image_and_every_point_its_depth(pose):
    """What nothing can see must not spoil the rows beside it with numbers that are none."""
    beside = in_world(np.array([[0.5, 0.2, 0.0], [0.5, 0.2, 4.0], [0.5, 0.2, -4.0]]), pose, DRIVE.rig)
    predicted = stereo.predict(beside, pose, DRIVE.rig)
    assert all(np.isfinite(part).all() for part in predicted)
    np.testing.assert_allclose(predicted.depth_m, [0.0, 4.0, -4.0], atol=1e-12)


def test_model_equals_gtsams_factor_on_every_sighting_of_kitti00(run_estimator: Callable[..., Run]):
    """From every frame at the filter's pose, each point half a metre off where stereo sees it.

    GTSAM gives a point behind the camera a residual of its own making; a sighting without disparity is therefore
    evaluated at 20 m.
    """
    sequence = load_sequence("kitti00")
    run, rig = run_estimator("dead-reckoning", sequence, start_from_measurements(sequence)), sequence.rig
    # GTSAM linearises whitened: with the rig's own noise that would be R r and R H, R^T R = cov^-1.
    whitening = np.linalg.cholesky(np.linalg.inv(rig.cov_uv_px2)).T
    maker, compared, rng = StereoFactors(rig), 0, np.random.default_rng(3)
    for packet, T_world_imu in zip(sequence.packets(), run.causal.T_world_imu, strict=True):
        frame, seen_px = packet.frame, packet.frame.uvs_px.copy()
        least_px = rig.fx_px * rig.baseline_m / 20.0
        seen_px[:, 1] = np.where(stereo.disparity_px(seen_px) > 2.0, seen_px[:, 1], seen_px[:, 0] - least_px)
        points_cam = stereo.triangulate(seen_px, rig)
        points_cam += 0.5 * rng.uniform(-1.0, 1.0, points_cam.shape) * np.minimum(1.0, 0.2 * points_cam[:, 2:])
        points = in_world(points_cam, T_world_imu, rig)
        if not len(points):
            continue
        predicted, values = stereo.predict(points, T_world_imu, rig), gtsam.Values()
        assert (predicted.depth_m > 0.0).all()
        values.insert(X(0), gtsam.Pose3(T_world_imu))
        for track_id, point in zip(frame.track_ids.tolist(), points, strict=True):
            values.insert(L(track_id), point)
        linear = [factor.linearize(values).jacobian() for factor in maker.of(frame, 0)]
        jacobians, negative_errors = (np.array(parts) for parts in zip(*linear, strict=True))
        residuals = whitening @ (frame.uvs_px - predicted.uv_px)[..., None]
        ours = whitening @ np.concatenate([predicted.d_uv_d_pose, predicted.d_uv_d_point], axis=2)
        np.testing.assert_allclose(residuals[..., 0], negative_errors, rtol=0.0, atol=TOLERANCE * 1e3)
        largest = np.abs(jacobians).max(axis=(1, 2))
        assert (np.abs(ours - jacobians).max(axis=(1, 2)) / largest).max() < TOLERANCE
        compared += len(points)
    assert compared == len(sequence.visible)


# Correlated, with a v that errs like uL: where v is the mean of two rows the left one alone errs more.
COV_PX2 = np.array([[1.0, 0.4, 0.1], [0.4, 1.2, 0.2], [0.1, 0.2, 1.0]])
LEFT_RIG = replace(DRIVE.rig, cov_uv_px2=COV_PX2)
BY_LEFT = np.array([True, False, True, False])


def test_a_sighting_by_the_left_image_is_gtsams_factor_of_the_left_camera_whitened_or_not():
    """Four points, half of them by the left image alone; its rows and noise say the same as whitened."""
    rng = np.random.default_rng(3)
    pose, values, frame_ids = se3_exp(0.2 * rng.standard_normal(6)), gtsam.Values(), np.arange(4)
    points = transform(pose @ LEFT_RIG.T_imu_cam, np.column_stack([rng.uniform(-2, 2, (4, 2)), rng.uniform(4, 9, 4)]))
    uvs_px = stereo.predict(points, pose, LEFT_RIG).uv_px + 0.5 * rng.standard_normal((4, 3))
    uvs_px[BY_LEFT, 1] = np.nan
    values.insert(X(0), gtsam.Pose3(pose))
    for i, point in enumerate(points):
        values.insert(L(i), point)
    seen, whitener = stereo.predict(points, pose, LEFT_RIG), stereo.whitener(uvs_px, LEFT_RIG)
    whitened = stereo.whitened_residuals(uvs_px, seen.uv_px, LEFT_RIG)
    H_whitened = whitener @ np.concatenate([seen.d_uv_d_pose, seen.d_uv_d_point], axis=2)
    for i, factor in enumerate(StereoFactors(LEFT_RIG).of(StereoFrame(0, frame_ids, uvs_px), 0)):
        assert factor.dim() == 3 - BY_LEFT[i]
        assert factor.error(values) == pytest.approx(0.5 * whitened[i] @ whitened[i], rel=1e-9)
        H_gtsam, expected = factor.linearize(values).jacobian()[0], H_whitened[i].T @ H_whitened[i]
        np.testing.assert_allclose(H_gtsam.T @ H_gtsam, expected, atol=1e-9 * np.abs(expected).max())
    H, residuals = stereo.seen_rows(uvs_px, seen.d_uv_d_pose), stereo.residuals_px(uvs_px, seen.uv_px)
    precision, of_pose = np.linalg.inv(stereo.noise_px2(uvs_px, LEFT_RIG)), H_whitened[..., :6]
    np.testing.assert_allclose(np.swapaxes(H, 1, 2) @ precision @ H, np.swapaxes(of_pose, 1, 2) @ of_pose, rtol=1e-9)
    squares = np.einsum("ni,nij,nj->n", residuals, precision, residuals)
    np.testing.assert_allclose(squares, np.square(whitened).sum(axis=1), rtol=1e-9)
    np.testing.assert_array_equal(stereo.degrees_of_freedom(uvs_px), [2, 3, 2, 3])


def test_where_v_is_the_mean_of_two_rows_the_left_row_errs_as_the_left_column_does():
    cov_px2 = stereo.left_cov_px2(replace(LEFT_RIG, cov_uv_px2=np.diag([1.0, 1.0, 0.5])))
    np.testing.assert_array_equal(cov_px2, np.eye(2))
