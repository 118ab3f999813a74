"""A sighting by the left image alone: one whose uR has an infinite variance, and GTSAM's factor of one camera."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from toolkit.geometry import se3_exp, transform
from toolkit.measurements import StereoFrame
from toolkit.models import stereo
from toolkit.models.factors import L, StereoFactors, X
from toolkit.simulation import DRIVE

# Correlated, with a v that errs like uL: where v is the mean of two rows the left one alone errs more.
COV_PX2 = np.array([[1.0, 0.4, 0.1], [0.4, 1.2, 0.2], [0.1, 0.2, 1.0]])
RIG = replace(DRIVE.rig, cov_uv_px2=COV_PX2)
LEFT = np.array([True, False, True, False])


@pytest.fixture(scope="module")
def scene():
    """Return a pose, points in the world, and their images half a pixel off, half of them by the left image alone."""
    rng = np.random.default_rng(3)
    pose = se3_exp(0.2 * rng.standard_normal(6))
    points = transform(pose @ RIG.T_imu_cam, np.column_stack([rng.uniform(-2, 2, (4, 2)), rng.uniform(4, 9, 4)]))
    uvs_px = stereo.predict(points, pose, RIG).uv_px + 0.5 * rng.standard_normal((4, 3))
    uvs_px[LEFT, 1] = np.nan
    return pose, points, uvs_px


def test_it_is_the_limit_of_a_right_image_without_any_precision(scene):
    """Information and score of a pose by a uR of a variance of 1e10 px^2, to the 1e-10 that it still says."""
    pose, points, uvs_px = scene
    seen = stereo.predict(points, pose, RIG)
    whitener = stereo.whitener(uvs_px, RIG)
    H = whitener @ seen.d_uv_d_pose
    residuals = stereo.whitened_residuals(uvs_px, seen.uv_px, RIG)
    for i in np.flatnonzero(LEFT):
        cov_px2 = np.array([[1.0, 0.0, 0.1], [0.0, 1e10, 0.0], [0.1, 0.0, 1.0]])
        precision = np.linalg.inv(cov_px2)
        off_px = np.nan_to_num(uvs_px[i] - seen.uv_px[i], nan=7.0)
        of_pose = seen.d_uv_d_pose[i]
        np.testing.assert_allclose(H[i].T @ H[i], of_pose.T @ precision @ of_pose, rtol=1e-7)
        np.testing.assert_allclose(H[i].T @ residuals[i], of_pose.T @ precision @ off_px, rtol=1e-6)


def test_unwhitened_its_rows_and_noise_say_the_same(scene):
    pose, points, uvs_px = scene
    seen = stereo.predict(points, pose, RIG)
    H, residuals = stereo.seen_rows(uvs_px, seen.d_uv_d_pose), stereo.residuals_px(uvs_px, seen.uv_px)
    precision = np.linalg.inv(stereo.noise_px2(uvs_px, RIG))
    whitened = stereo.whitener(uvs_px, RIG) @ seen.d_uv_d_pose
    np.testing.assert_allclose(np.swapaxes(H, 1, 2) @ precision @ H, np.swapaxes(whitened, 1, 2) @ whitened, rtol=1e-9)
    of_residuals = np.square(stereo.whitened_residuals(uvs_px, seen.uv_px, RIG)).sum(axis=1)
    np.testing.assert_allclose(np.einsum("ni,nij,nj->n", residuals, precision, residuals), of_residuals, rtol=1e-9)
    np.testing.assert_array_equal(stereo.degrees_of_freedom(uvs_px), [2, 3, 2, 3])


def test_smoothers_have_gtsam_factors_of_the_left_camera_for_it(scene, numerical_jacobian):
    pose, points, uvs_px = scene
    frame = StereoFrame(0, np.arange(4), uvs_px)
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(pose))
    for i, point in enumerate(points):
        values.insert(L(i), point)
    seen = stereo.predict(points, pose, RIG)
    residuals = stereo.whitened_residuals(uvs_px, seen.uv_px, RIG)
    for i, factor in enumerate(StereoFactors(RIG).of(frame, 0)):
        assert factor.dim() == 3 - LEFT[i]
        assert factor.error(values) == pytest.approx(0.5 * residuals[i] @ residuals[i], rel=1e-9)
        H_gtsam, _ = factor.linearize(values).jacobian()
        H = np.concatenate([seen.d_uv_d_pose[i], seen.d_uv_d_point[i]], axis=1)
        H = stereo.whitener(uvs_px, RIG)[i] @ H
        np.testing.assert_allclose(H_gtsam.T @ H_gtsam, H.T @ H, atol=1e-9 * np.abs(H.T @ H).max())

    def residuals_at(xi):
        return stereo.whitened_residuals(uvs_px, stereo.predict(points, pose @ se3_exp(xi), RIG).uv_px, RIG)

    numerical = -numerical_jacobian(residuals_at, 6)
    H = stereo.whitener(uvs_px, RIG) @ seen.d_uv_d_pose
    np.testing.assert_allclose(H, numerical, atol=1e-7 * np.abs(H).max())


def test_where_v_is_the_mean_of_two_rows_the_left_row_errs_as_the_left_column_does():
    cov_px2 = stereo.left_cov_px2(replace(RIG, cov_uv_px2=np.diag([1.0, 1.0, 0.5])))
    np.testing.assert_array_equal(cov_px2, np.eye(2))


def test_where_no_right_image_is_missing_the_rig_has_one_noise(scene):
    uvs_px = np.nan_to_num(scene[2], nan=3.0)
    assert stereo.whitener(uvs_px, RIG) is RIG.whitener
    assert stereo.noise_px2(uvs_px, RIG) is RIG.cov_uv_px2
    assert stereo.degrees_of_freedom(uvs_px) == 3
