"""The geometry against three independent oracles: GTSAM, scipy's matrix exponential, and differences."""

import gtsam
import numpy as np
import pytest
from scipy.linalg import expm

from tests.models.conftest import numerical_jacobian
from toolkit import geometry
from toolkit.geometry import Array

# The series end at angle 0.5; a small-angle threshold set too low or too high shows between 1e-9 and 1e-3.
ANGLES = [0.0, 1e-12, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 0.1, 0.4999, 0.5, 0.5001, 1.0, 3.0, np.pi - 1e-6, np.pi]
# A few hundred roundings of numbers of order one.
ROUNDING = 1e-14
DIRECTIONS = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [2.0, -1.0, 0.5], [-0.3, 0.2, 0.9]])


def unit_directions() -> Array:
    return np.asarray(DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True))


def twists(angle: float) -> Array:
    translations = np.random.default_rng(3).normal(scale=2.0, size=DIRECTIONS.shape)
    return np.hstack([angle * unit_directions(), translations])


def random_twists(count: int, longest_angle: float = 3.0) -> Array:
    rng = np.random.default_rng(7)
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return np.hstack([axis * rng.uniform(0.0, longest_angle, (count, 1)), rng.normal(scale=3.0, size=(count, 3))])


def hat(xi: Array) -> Array:
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = geometry.skew(xi[:3]), xi[3:]
    return matrix


@pytest.mark.parametrize("angle", ANGLES)
def test_se3_exp_equals_the_matrix_exponential(angle: float) -> None:
    for xi in twists(angle):
        np.testing.assert_allclose(geometry.se3_exp(xi), expm(hat(xi)), atol=5 * ROUNDING)


@pytest.mark.parametrize("angle", ANGLES[:-1])
def test_log_undoes_exp_below_pi(angle: float) -> None:
    for xi in twists(angle):
        np.testing.assert_allclose(geometry.so3_log(geometry.so3_exp(xi[:3])), xi[:3], atol=ROUNDING * angle)
        np.testing.assert_allclose(geometry.se3_log(geometry.se3_exp(xi)), xi, atol=10 * ROUNDING)


def test_log_of_a_half_turn_is_one_of_its_two_vectors() -> None:
    phi = np.pi * unit_directions()
    logarithm = geometry.so3_log(geometry.so3_exp(phi))
    sign = np.sign(np.einsum("ni,ni->n", logarithm, phi))[:, None]
    np.testing.assert_allclose(sign * logarithm, phi, atol=1e-14)
    np.testing.assert_array_less(np.linalg.norm(logarithm, axis=1), np.pi + 1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_so3_left_jacobian_equals_differences_and_gtsam(angle: float) -> None:
    for phi in angle * unit_directions():
        J_l, rotation = geometry.so3_left_jacobian(phi), geometry.so3_exp(phi)
        np.testing.assert_allclose(J_l, rotation @ gtsam.Rot3.ExpmapDerivative(phi), atol=1e-11)
        moved = numerical_jacobian(
            lambda x, at=phi: geometry.so3_log(geometry.so3_exp(at + x) @ geometry.so3_exp(-at)), 3
        )
        np.testing.assert_allclose(J_l, moved, atol=1e-9)
        np.testing.assert_allclose(J_l, rotation @ geometry.so3_left_jacobian(-phi), atol=ROUNDING)


@pytest.mark.parametrize("angle", ANGLES)
def test_se3_right_jacobian_equals_the_exponential_of_ad(angle: float) -> None:
    """J_r is the top right block of expm([[-ad, I], [0, 0]]), which knows no small angles at all."""
    for xi in twists(angle):
        ad = np.zeros((6, 6))
        ad[:3, :3] = ad[3:, 3:] = geometry.skew(xi[:3])
        ad[3:, :3] = geometry.skew(xi[3:])
        augmented = np.zeros((12, 12))
        augmented[:6, :6], augmented[:6, 6:] = -ad, np.eye(6)
        T, J_r = geometry.se3_exp_and_right_jacobian(xi)
        np.testing.assert_array_equal(T, geometry.se3_exp(xi))
        for computed in (J_r, geometry.se3_right_jacobian(xi)):
            np.testing.assert_allclose(computed, expm(augmented)[:6, 6:], atol=2e-13)


def test_adjoint_equals_gtsam_and_moves_a_twist_across_the_pose() -> None:
    for xi, eta in zip(random_twists(20), random_twists(20)[::-1], strict=True):
        T = geometry.se3_exp(xi)
        np.testing.assert_allclose(geometry.se3_adjoint(T), gtsam.Pose3(T).AdjointMap(), atol=1e-13)
        moved = geometry.se3_exp(geometry.se3_adjoint(T) @ eta)
        np.testing.assert_allclose(T @ geometry.se3_exp(eta) @ geometry.se3_inverse(T), moved, atol=1e-11)


def test_batches_equal_one_at_a_time() -> None:
    xi = random_twists(12).reshape(3, 4, 6)
    of_six, of_three = (geometry.se3_exp, geometry.se3_right_jacobian), (geometry.so3_exp, geometry.so3_left_jacobian)
    arguments = [(f, xi) for f in of_six] + [(f, xi[..., :3]) for f in of_three]
    for function, batch in (*arguments, (geometry.se3_log, geometry.se3_exp(xi))):
        single = np.array([[function(x) for x in row] for row in batch])
        np.testing.assert_allclose(function(batch), single, atol=10 * ROUNDING)


def test_transform_applies_the_pose_to_each_point() -> None:
    T, points = geometry.se3_exp(random_twists(10)), random_twists(10)[:, 3:]
    expected = [gtsam.Pose3(t).transformFrom(p) for t, p in zip(T, points, strict=True)]
    np.testing.assert_allclose(geometry.transform(T, points), expected, atol=1e-14)
    np.testing.assert_allclose(geometry.transform(geometry.se3_inverse(T[0]), geometry.transform(T[0], points)), points)


@pytest.mark.parametrize("angle", ANGLES)
def test_quaternions_go_round_and_equal_gtsam(angle: float) -> None:
    for rotation in geometry.so3_exp(angle * unit_directions()):
        q = geometry.quaternion_from_rotation(rotation)
        assert q[3] >= 0.0
        np.testing.assert_allclose(np.linalg.norm(q), 1.0, atol=1e-15)
        np.testing.assert_allclose(geometry.rotation_from_quaternion(q), rotation, atol=ROUNDING)
        np.testing.assert_allclose(gtsam.Rot3.Quaternion(q[3], *q[:3]).matrix(), rotation, atol=ROUNDING)
        np.testing.assert_allclose(geometry.rotation_from_quaternion(-2.5 * q), rotation, atol=ROUNDING)


def test_yaw_is_the_angle_about_z() -> None:
    yaw = np.linspace(-3.1, 3.1, 23)
    np.testing.assert_allclose(geometry.yaw_of(geometry.about_z(yaw)), yaw, atol=ROUNDING)
    np.testing.assert_allclose(geometry.about_z(0.3), gtsam.Rot3.Yaw(0.3).matrix(), atol=ROUNDING)


def test_interpolation_hits_the_knots_and_moves_on_the_geodesic() -> None:
    t_ns = np.array([1_600_000_000_000_000_000, 1_600_000_000_100_000_000, 1_600_000_000_350_000_000])
    # Steps of less than half a turn: the geodesic is the short one.
    poses = np.eye(4) @ geometry.se3_exp(np.cumsum(0.3 * random_twists(3), axis=0))
    np.testing.assert_allclose(geometry.interpolate_poses(t_ns, poses, t_ns), poses, atol=1e-13)
    step = geometry.se3_log(geometry.se3_inverse(poses[1]) @ poses[2])
    quarter = geometry.interpolate_poses(t_ns, poses, t_ns[1:2] + 62_500_000)
    np.testing.assert_allclose(quarter[0], poses[1] @ geometry.se3_exp(0.25 * step), atol=1e-13)


def test_the_nearest_rotation_turns_points_onto_each_other_and_never_mirrors() -> None:
    points, rotation = random_twists(9)[:, 3:], geometry.so3_exp(np.array([0.3, -1.2, 2.0]))
    found, overlaps = geometry.nearest_rotation((points @ rotation.T).T @ points)
    np.testing.assert_allclose(found, rotation, atol=10 * ROUNDING)
    assert overlaps.sum() == pytest.approx((points**2).sum())
    mirrored, overlaps = geometry.nearest_rotation((points * [1.0, 1.0, -1.0]).T @ points)
    assert np.linalg.det(mirrored) == pytest.approx(1.0) and overlaps[2] < 0.0
