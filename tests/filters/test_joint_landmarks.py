"""Which landmarks of a joint belief a frame may correct, whichever way the update is made."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from filters import iekf
from filters.kalman import joint_landmarks
from filters.kalman.joint import AtFirstEstimates, AtLatestEstimates
from filters.kalman.tracks import correct_by_landmarks
from tests.filters.conftest import with_clones
from toolkit.geometry import transform
from toolkit.measurements import StereoFrame
from toolkit.models import stereo
from toolkit.models.gating import FrameGate
from toolkit.simulation import FLIGHT

CORRECT = {"single": joint_landmarks.correct, "compiled": correct_by_landmarks, "iterated": iekf.correct}


@pytest.mark.parametrize("correct", CORRECT.values(), ids=CORRECT)
@pytest.mark.parametrize(("depth_m", "accepted"), [(4.0, 1), (-4.0, 0)], ids=["in front", "behind"])
def test_a_landmark_behind_the_camera_corrects_nothing_however_small_its_residual(correct, depth_m, accepted):
    """A residual of half a pixel passes the gate on either side: what differs is the side alone."""
    sequence, joint = with_clones(replace(FLIGHT, duration_s=1.0), 0, 1)
    point, rig = transform(joint.clones[0] @ sequence.rig.T_imu_cam, np.array([[0.3, 0.2, depth_m]])), sequence.rig
    joint.add_landmarks(np.array([7]), point, np.zeros((3, 6)), 0.01 * np.eye(3)[None])
    uv_px = stereo.predict(point, joint.clones[0], rig).uv_px + np.array([0.5, 0.0, 0.5])
    cov, gate = joint.cov.copy(), FrameGate(0.95)
    correct(joint, StereoFrame(0, np.array([7]), uv_px), AtLatestEstimates(), rig, gate)
    assert (gate.tested, gate.accepted) == (1, accepted)
    assert np.array_equal(joint.cov, cov) == (not accepted)
    assert np.array_equal(joint.points, point) == (not accepted)


@pytest.mark.parametrize("at", [AtFirstEstimates(), AtLatestEstimates()], ids=["first", "latest"])
@pytest.mark.parametrize("left_only", [0.0, 0.3])
def test_the_compiled_correction_is_the_textbooks(at, left_only):
    """Of three clones and of landmarks that are mismatched, weighed down, left-only and behind the camera."""
    sequence, joint = with_clones(replace(FLIGHT, duration_s=1.0), 2, 3)
    rig, rng = replace(sequence.rig, track_weight=0.5), np.random.default_rng(3)
    points = (
        rng.uniform([-2.0, -1.5, 3.0], [2.0, 1.5, 9.0], size=(20, 3)) * np.where(np.arange(20) == 4, -1.0, 1.0)[:, None]
    )
    world = transform(joint.clones[-1] @ rig.T_imu_cam, points)
    joint.add_landmarks(np.arange(20), world, 0.1 * rng.normal(size=(60, 18)), np.tile(1e-3 * np.eye(3), (20, 1, 1)))
    joint.move(np.sqrt(np.diag(joint.cov)) * 0.3 * rng.normal(size=len(joint.cov)))
    uvs_px = stereo.predict(joint.points, joint.clones[-1], rig).uv_px + 4.0 * rng.normal(size=(20, 3))
    uvs_px[2] += 300.0
    uvs_px[rng.random(20) < left_only, 1] = np.nan
    frame, one, other = StereoFrame(0, np.arange(20)[::-1], uvs_px[::-1]), copy(joint), copy(joint)
    gates = FrameGate(0.999, 1.0, rig.track_weight), FrameGate(0.999, 1.0, rig.track_weight)
    joint_landmarks.correct(one, frame, at, rig, gates[0])
    correct_by_landmarks(other, frame, at, rig, gates[1])
    assert 0 < gates[0].accepted < gates[0].tested - 1
    assert gates[1].info() == pytest.approx(gates[0].info(), rel=1e-9)
    sigmas = np.sqrt(np.diag(joint.cov))
    np.testing.assert_allclose(other.cov / np.outer(sigmas, sigmas), one.cov / np.outer(sigmas, sigmas), atol=1e-9)
    np.testing.assert_allclose(other.clones, one.clones, atol=1e-9)
    np.testing.assert_allclose(other.points, one.points, atol=1e-9)
    assert np.abs(one.points - joint.points).max() > 1e-2, "there was something to agree on"
