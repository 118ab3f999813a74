"""Landmarks from several poses: exact where nothing has noise, the least-squares answer where it has."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from filters.kalman.triangulation import triangulate
from toolkit.geometry import se3, se3_inverse, so3_exp, transform
from toolkit.measurements import StereoRig
from toolkit.models import stereo

RIG = StereoRig(450.0, 455.0, 360.0, 240.0, 0.11, np.eye(4), np.diag([1.0, 1.0, 0.5]))


def scene(seed: int, tracks: int = 40, window: int = 6):
    """Return points (F, 3), poses (W, 4, 4), exact sightings (F, W, 3) px, and who saw what, two at least each."""
    rng = np.random.default_rng(seed)
    turns = so3_exp(0.05 * rng.standard_normal((window, 3)))
    poses = se3(turns, np.cumsum(0.2 * rng.standard_normal((window, 3)), axis=0))
    points = rng.uniform([-2.0, -1.5, 3.0], [2.0, 1.5, 8.0], size=(tracks, 3))
    uvs_px = np.stack([stereo.project(transform(se3_inverse(pose), points), RIG) for pose in poses], axis=1)
    seen = rng.uniform(size=(tracks, window)) < 0.6
    seen[:, :2] = True
    return points, poses, np.where(seen[..., None], uvs_px, 0.0), seen


@pytest.mark.parametrize("seed", range(3))
def test_exact_sightings_give_the_points(seed):
    points, poses, uvs_px, seen = scene(seed)
    found, reliable = triangulate(uvs_px, seen, poses, RIG)
    assert reliable.all()
    np.testing.assert_allclose(found, points, atol=1e-7)


def test_noisy_sightings_give_the_least_squares_points():
    _, poses, uvs_px, seen = scene(4)
    uvs_px = uvs_px + np.random.default_rng(0).standard_normal(uvs_px.shape) * [1.0, 1.0, np.sqrt(0.5)]
    found, reliable = triangulate(uvs_px, seen, poses, RIG)
    whitener = np.linalg.inv(np.linalg.cholesky(RIG.cov_uv_px2))

    def residuals(point, track):
        own = [transform(se3_inverse(pose), point[None]) for pose in poses[seen[track]]]
        predicted = stereo.project(np.concatenate(own), RIG)
        return ((uvs_px[track, seen[track]] - predicted) @ whitener.T).ravel()

    assert reliable.all()
    for track, point in enumerate(found):
        best = least_squares(residuals, point, args=(track,), xtol=1e-12, ftol=1e-12)
        # The search ends where it has nothing to gain: a hundredth of a standard deviation of the point.
        spread = np.linalg.inv(best.jac.T @ best.jac)
        assert (point - best.x) @ np.linalg.solve(spread, point - best.x) < 0.01**2


def by_the_left_image(uvs_px, rows=slice(None)):
    result = uvs_px.copy()
    result[rows, :, 1] = np.nan
    return result


def test_without_right_images_exact_sightings_from_several_poses_give_the_points():
    points, poses, uvs_px, seen = scene(0)
    found, reliable = triangulate(by_the_left_image(uvs_px, slice(0, None, 2)), seen, poses, RIG)
    assert reliable[1::2].all()
    assert reliable[::2].mean() > 0.8, "most are seen from far enough apart"
    np.testing.assert_allclose(found[reliable], points[reliable], atol=1e-6)


def test_without_right_images_nothing_is_known_of_what_poses_see_from_one_place():
    """Not the depth, by whatever rounding and half a pixel of noise leave of the rays' angle."""
    _, poses, uvs_px, seen = scene(0)
    one_place = np.broadcast_to(poses[0], poses.shape)
    again = by_the_left_image(np.where(seen[..., None], uvs_px[:, :1], 0.0))
    noise_px = 0.5 * np.random.default_rng(0).standard_normal(again.shape)
    for seen_px in (again, again + noise_px):
        assert not triangulate(seen_px, seen, one_place, RIG)[1].any()


def test_one_pair_is_enough_for_a_track_whose_other_right_images_are_missing():
    points, poses, uvs_px, seen = scene(1)
    uvs_px[:, 1:, 1] = np.nan
    found, reliable = triangulate(uvs_px, seen, poses, RIG)
    assert reliable.all()
    np.testing.assert_allclose(found, points, atol=1e-7)


def test_a_track_is_solved_as_if_alone_whatever_the_others_are():
    """A step that helps one track and harms another is taken by the one only."""
    _, poses, uvs_px, seen = scene(6)
    rng = np.random.default_rng(1)
    uvs_px[::2] += 60.0 * rng.standard_normal(uvs_px[::2].shape)  # mismatched: many a step is in vain

    def cost(track, point):
        own = [transform(se3_inverse(pose), point[None]) for pose in poses[seen[track]]]
        residuals = uvs_px[track, seen[track]] - stereo.project(np.concatenate(own), RIG)
        return float(np.einsum("ni,ij,nj->", residuals, np.linalg.inv(RIG.cov_uv_px2), residuals))

    together, _ = triangulate(uvs_px, seen, poses, RIG)
    for track, point in enumerate(together):
        alone, _ = triangulate(uvs_px[[track]], seen[[track]], poses, RIG)
        # Together it may go on while others are unsettled, and end lower.
        assert cost(track, point) <= cost(track, alone[0]) * (1.0 + 1e-9)


def test_a_point_behind_a_pose_or_without_disparity_is_not_relied_on():
    _, poses, uvs_px, seen = scene(5)
    behind = poses.copy()
    behind[1, :3, :3] = so3_exp(np.array([0.0, np.pi, 0.0]))  # no point is in front of both
    assert not triangulate(uvs_px, seen, behind, RIG)[1].any()
    flat = uvs_px.copy()
    flat[0, :, 1] = flat[0, :, 0]
    found, reliable = triangulate(flat, seen, poses, RIG)
    assert not reliable[0]
    assert reliable[1:].all()
    assert np.isfinite(found).all()


def test_no_track_gives_no_point():
    found, reliable = triangulate(np.empty((0, 3, 3)), np.empty((0, 3), dtype=bool), np.tile(np.eye(4), (3, 1, 1)), RIG)
    assert found.shape == (0, 3)
    assert reliable.shape == (0,)
