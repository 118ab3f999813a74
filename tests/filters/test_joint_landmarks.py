"""Which landmarks of a joint belief a frame may correct, whichever way the update is made."""

from dataclasses import replace

import numpy as np
import pytest

from filters import iekf
from filters.kalman import joint_landmarks
from filters.kalman.joint import AtLatestEstimates, JointBelief
from toolkit.geometry import Array, transform
from toolkit.measurements import StereoFrame
from toolkit.models import stereo
from toolkit.models.gating import FrameGate
from toolkit.models.motion import motion_model
from toolkit.simulation import FLIGHT, simulate

SEQUENCE = simulate(replace(FLIGHT, duration_s=1.0), 0)


def belief_with_a_landmark(depth_m: float) -> JointBelief:
    """Return a belief whose only landmark has that depth in the camera and is uncertain by 0.1 m."""
    model = motion_model(SEQUENCE.noise, SEQUENCE.gravity_world)
    joint = JointBelief(model.initial_belief(SEQUENCE.prior))
    joint.clone()
    point = transform(joint.clones[0] @ SEQUENCE.rig.T_imu_cam, np.array([[0.3, 0.2, depth_m]]))
    joint.add_landmarks(np.array([7]), point, np.zeros((3, joint.cov.shape[0])), 0.01 * np.eye(3))
    return joint


def frame_of(joint: JointBelief, off_px: Array) -> StereoFrame:
    """Return a frame that shows the landmark where the projection's formula puts it, but for ``off_px`` (3,)."""
    uv_px = stereo.predict(joint.points, joint.clones[0], SEQUENCE.rig).uv_px + off_px
    return StereoFrame(0, np.array([7]), uv_px)


@pytest.mark.parametrize("correct", [joint_landmarks.correct, iekf.correct], ids=["single", "iterated"])
@pytest.mark.parametrize(("depth_m", "accepted"), [(4.0, 1), (-4.0, 0)], ids=["in front", "behind"])
def test_a_landmark_behind_the_camera_corrects_nothing_however_small_its_residual(correct, depth_m, accepted):
    """A residual of half a pixel passes the gate on either side: what differs is the side alone."""
    joint, gate = belief_with_a_landmark(depth_m), FrameGate(0.95)
    cov, point = joint.cov.copy(), joint.points.copy()
    correct(joint, frame_of(joint, np.array([0.5, 0.0, 0.5])), AtLatestEstimates(), SEQUENCE.rig, gate)
    assert (gate.tested, gate.accepted) == (1, accepted)
    assert np.array_equal(joint.cov, cov) == (not accepted)
    assert np.array_equal(joint.points, point) == (not accepted)
