"""Which landmarks of a joint belief a frame may correct, whichever way the update is made."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from filters import iekf
from filters.kalman.coordinates import AnchoredBelief
from filters.kalman.joint import AtFirstEstimates, AtLatestEstimates, correct_by_landmarks
from tests.filters.conftest import with_clones
from toolkit.geometry import transform
from toolkit.measurements import StereoFrame
from toolkit.models import stereo
from toolkit.models.gating import FrameGate
from toolkit.simulation import FLIGHT

CORRECT = {"single": correct_by_landmarks, "iterated": iekf.correct}


@pytest.mark.parametrize("correct", CORRECT.values(), ids=CORRECT)
@pytest.mark.parametrize(("depth_m", "accepted"), [(4.0, 1), (-4.0, 0)], ids=["in front", "behind"])
def test_a_landmark_behind_the_camera_corrects_nothing_however_small_its_residual(correct, depth_m, accepted):
    """A residual of half a pixel passes the gate on either side: what differs is the side alone."""
    anchored = partial(AnchoredBelief, T_imu_cam=FLIGHT.rig.T_imu_cam)
    sequence, joint = with_clones(replace(FLIGHT, duration_s=1.0), 0, 1, anchored)
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
def test_the_correction_is_the_kalman_update_by_all_sightings_that_count(at, left_only):
    """Of three clones and of landmarks that are mismatched, weighed down, left-only and behind the camera."""
    sequence, joint = with_clones(replace(FLIGHT, duration_s=1.0), 2, 3)
    rig, rng, count = replace(sequence.rig, track_weight=0.5), np.random.default_rng(3), 20
    points = rng.uniform([-2.0, -1.5, 3.0], [2.0, 1.5, 9.0], size=(count, 3))
    points[4] *= -1.0
    world = transform(joint.clones[-1] @ rig.T_imu_cam, points)
    covs = np.tile(1e-3 * np.eye(3), (count, 1, 1))
    joint.add_landmarks(np.arange(count), world, 0.1 * rng.normal(size=(3 * count, 18)), covs)
    joint.move(np.sqrt(np.diag(joint.cov)) * 0.3 * rng.normal(size=len(joint.cov)))
    uvs_px = stereo.predict(joint.points, joint.clones[-1], rig).uv_px + 4.0 * rng.normal(size=(count, 3))
    uvs_px[2] += 300.0
    uvs_px[rng.random(count) < left_only, 1] = np.nan
    first, (P, n), rows, residuals = joint.landmark_columns.start, (joint.cov, len(joint.cov)), [], []
    gate = FrameGate(0.999, 1.0, rig.track_weight)
    for i, uv_px in enumerate(uvs_px):
        now = stereo.predict(joint.points[i : i + 1], joint.clones[-1], rig)
        there = stereo.predict(at.points(joint)[i : i + 1], at.clones(joint)[-1], rig)
        whitener, H = stereo.whitener(uv_px, rig), np.zeros((3, n))
        H[:, first + 3 * i :][:, :3], H[:, -6:] = whitener @ there.d_uv_d_point[0], whitener @ there.d_uv_d_pose[0]
        residual = whitener @ stereo.residuals_px(uv_px, now.uv_px[0])
        nis, dof = residual @ np.linalg.solve(H @ P @ H.T + np.eye(3), residual), stereo.degrees_of_freedom(uv_px)
        weight = gate.weights(
            np.array([nis]), int(dof), np.array([nis < gate.bound(int(dof)) and now.depth_m[0] > 0.0])
        )
        rows.append(np.sqrt(weight[0]) * H)
        residuals.append(np.sqrt(weight[0]) * residual)
    H, sigmas = np.vstack(rows), np.sqrt(np.diag(P))
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(len(H)))
    expected, moved = P - gain @ H @ P, joint.displaced(gain @ np.concatenate(residuals))
    correct_by_landmarks(joint, StereoFrame(0, np.arange(count)[::-1], uvs_px[::-1]), at, rig, gate)
    assert 0 < gate.accepted < gate.tested - 1
    np.testing.assert_allclose(joint.cov / np.outer(sigmas, sigmas), expected / np.outer(sigmas, sigmas), atol=1e-9)
    np.testing.assert_allclose(joint.clones, moved.clones, atol=1e-9)
    np.testing.assert_allclose(joint.points, moved.points, atol=1e-9)
