"""Landmarks that move along their inverse depth: to first order as in metres, and exactly as their camera sees them."""

import numpy as np
import pytest

from filters.kalman.coordinates import InverseDepthBelief
from filters.kalman.joint import AtFirstEstimates, JointBelief
from toolkit.geometry import Array, se3_inverse, transform
from toolkit.models import stereo
from toolkit.models.motion import motion_model
from toolkit.simulation import DRIVE, simulate

IDS = np.array([3, 5])
# In the camera: one landmark near, one far, whose depth no single sighting tells.
POINTS_CAM = np.array([[1.0, 0.5, 5.0], [-4.0, 2.0, 80.0]])


@pytest.fixture(scope="module")
def sequence():
    return simulate(DRIVE, 0)


@pytest.fixture
def belief(sequence) -> InverseDepthBelief:
    """Return a belief of one clone and two landmarks first seen from it."""
    core = motion_model(sequence.noise, sequence.gravity_world).initial_belief(sequence.prior)
    joint = InverseDepthBelief(core, sequence.rig.T_imu_cam, AtFirstEstimates())
    joint.clone()
    points = transform(core.T_world_imu @ sequence.rig.T_imu_cam, POINTS_CAM)
    joint.add_landmarks(IDS, points, np.zeros((6, 6)), np.tile(np.eye(3), (2, 1, 1)))
    return joint


def landmarks_moved(joint: JointBelief, by: Array) -> JointBelief:
    delta = np.zeros(joint.cov.shape[0])
    delta[joint.landmark_columns] = by.ravel()
    return joint.displaced(delta)


def seen(joint: JointBelief, sequence) -> Array:
    T_cam_world = se3_inverse(joint.clones[-1] @ sequence.rig.T_imu_cam)
    return stereo.project(transform(T_cam_world, joint.points), sequence.rig)


def test_a_small_move_is_one_in_metres(belief):
    by = 1e-6 * np.array([[1.0, -2.0, 3.0], [2.0, 1.0, -1.0]])
    # The second order is (1e-6)^2 over a depth of metres.
    np.testing.assert_allclose(landmarks_moved(belief, by).points, belief.points + by, atol=1e-11)


def test_a_large_move_is_linear_in_what_the_first_camera_sees(belief, sequence):
    T_world_cam = belief.clones[-1] @ sequence.rig.T_imu_cam
    by_cam = np.array([[0.3, -0.2, 2.0], [5.0, 3.0, 100.0]])
    moved = landmarks_moved(belief, by_cam @ T_world_cam[:3, :3].T)
    slope = stereo.projection_jacobian(POINTS_CAM, sequence.rig)
    expected = seen(belief, sequence) + (slope @ by_cam[..., None])[..., 0]
    np.testing.assert_allclose(seen(moved, sequence), expected, atol=1e-9)
    assert (transform(se3_inverse(T_world_cam), moved.points)[0, 2] > POINTS_CAM[0, 2] + 2.0).all()


def test_moves_add_up_in_inverse_depth_whatever_they_are_cut_into(belief):
    """The slope is that of the first estimate for the landmark's whole life."""
    by = np.array([[0.2, 0.1, 0.4], [3.0, -2.0, 9.0]])
    twice = landmarks_moved(landmarks_moved(belief, by), by)
    np.testing.assert_allclose(twice.points, landmarks_moved(belief, 2.0 * by).points, rtol=1e-12)


def test_landmarks_that_are_forgotten_take_their_anchors_with_them(belief):
    belief.forget_landmarks(np.array([True, False]))
    assert belief.landmark_ids.tolist() == [IDS[1]]
    assert belief.anchors.shape == (1, 4, 4)
    by = np.array([[0.0, 0.0, 1e-6]])
    np.testing.assert_allclose(landmarks_moved(belief, by).points, belief.points + by, atol=1e-11)
