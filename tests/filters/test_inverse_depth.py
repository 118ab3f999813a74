"""Landmarks that move along their inverse depth: to first order as in metres, and exactly as their camera sees them.

Anchored in a clone, they are the same Gaussian to first order, whose anchored errors a move leaves as they are.
"""

from copy import copy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from filters.kalman.coordinates import CloneAnchoredBelief, InverseDepthBelief
from filters.kalman.joint import AtFirstEstimates, AtLatestEstimates, JointBelief, Linearisation
from tests.filters.conftest import with_clones
from tests.models.conftest import numerical_jacobian
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


def anchored(T_imu_cam: Array, at: Linearisation) -> CloneAnchoredBelief:
    """Return a corrected belief of three clones, with a landmark anchored in the first and one in the last."""
    belief = partial(CloneAnchoredBelief, T_imu_cam=T_imu_cam, at=at)
    _, joint = with_clones(replace(DRIVE, duration_s=1.5), 2, 3, belief)
    assert isinstance(joint, CloneAnchoredBelief)
    rng = np.random.default_rng(1)
    for clone, track_id, point in zip((0, 2), IDS, POINTS_CAM, strict=True):
        in_world = transform(joint.clones[clone] @ T_imu_cam, point[None])
        joint.add_landmarks(np.array([track_id]), in_world, rng.normal(size=(3, 18)), 0.1 * np.eye(3)[None])
        joint.anchors[-1] = clone
    joint.move(0.1 * np.sqrt(np.diag(joint.cov)) * rng.normal(size=len(joint.cov)))
    return joint


every_linearisation = pytest.mark.parametrize("at", [AtFirstEstimates(), AtLatestEstimates()], ids=["first", "latest"])


def test_a_landmark_whose_anchor_leaves_the_window_is_anchored_in_the_newest_clone(sequence):
    joint = anchored(sequence.rig.T_imu_cam, AtLatestEstimates())
    joint.marginalise_clones(1)
    assert joint.anchors.tolist() == [1, 1]


@every_linearisation
def test_a_move_leaves_the_gaussian_of_anchored_errors(sequence, at):
    """By numerical Jacobians of the triples and the clones' errors, at the linearisation points before and after."""
    joint = anchored(sequence.rig.T_imu_cam, at)

    def of_anchored_errors() -> Array:
        there, plain = copy(joint), JointBelief(joint.core)
        plain.clones, plain.points, plain._cov = at.clones(joint), at.points(joint), joint.cov

        def triples(delta: Array) -> Array:
            moved = plain.displaced(delta)
            there.clones, there.points = moved.clones, moved.points
            return there.triples().ravel()

        jacobian = np.eye(len(joint.cov))
        jacobian[joint.landmark_columns] = numerical_jacobian(triples, len(joint.cov))
        return jacobian @ joint.cov @ jacobian.T

    before, points = of_anchored_errors(), joint.points
    joint.move(0.5 * np.sqrt(np.diag(joint.cov)) * np.random.default_rng(4).normal(size=len(joint.cov)))
    assert np.abs(joint.points - points).max() > 0.1, "there was something to carry"
    sigmas = np.sqrt(np.diag(before))
    np.testing.assert_allclose(
        of_anchored_errors() / np.outer(sigmas, sigmas), before / np.outer(sigmas, sigmas), atol=1e-6
    )
