"""A scale of disparities is a baseline that is off about the middle of the pair."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.geometry import se3_exp, transform
from toolkit.models import stereo
from toolkit.models.disparity_scale import d_uv_d_scale, scaled_rig
from toolkit.simulation import DRIVE, simulate
from toolkit.simulation.track_faults import disparity_scale
from toolkit.track_noise import CHANNELS

RIG = replace(DRIVE.rig, cx_px=DRIVE.rig.cx_px + 3.0)


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(2)
    points_cam = np.column_stack([rng.uniform(-4.0, 4.0, (20, 2)), rng.uniform(5.0, 40.0, 20)])
    return transform(RIG.T_imu_cam, points_cam)


POSE = se3_exp(np.array([0.02, -0.01, 0.03, 0.1, 0.2, -0.1]))


def test_a_scaled_rig_sees_longer_disparities_and_nothing_else_changed(points):
    plain, scaled = (stereo.predict(points, POSE, rig).uv_px @ CHANNELS.T for rig in (RIG, scaled_rig(RIG, 0.03)))
    np.testing.assert_allclose(scaled, plain * np.array([1.0, 1.03, 1.0]), atol=1e-10)


def test_it_is_the_fault_that_is_planted():
    sequence = simulate(replace(DRIVE, duration_s=0.5), 0)
    planted = disparity_scale(sequence, 0.02).observations.uv_px
    by_rig = stereo.project(stereo.triangulate(sequence.observations.uv_px, sequence.rig), sequence.rig)
    # The shift of the left camera, given in the camera's own axes.
    scaled = scaled_rig(replace(sequence.rig, T_imu_cam=np.eye(4)), 0.02)
    moved = stereo.triangulate(sequence.observations.uv_px, sequence.rig) - scaled.T_imu_cam[:3, 3]
    np.testing.assert_allclose(by_rig, sequence.observations.uv_px, atol=1e-9)
    np.testing.assert_allclose(stereo.project(moved, scaled), planted, atol=1e-9)


def test_the_derivative_is_that_of_the_prediction(points):
    scale, step = 0.02, 1e-5
    ahead, behind = (stereo.predict(points, POSE, scaled_rig(RIG, scale + s)).uv_px for s in (step, -step))
    at = stereo.predict(points, POSE, scaled_rig(RIG, scale)).uv_px
    # Predictions are linear in the scale; 1e3 px are good to 1e-13.
    np.testing.assert_allclose(d_uv_d_scale(at, scale), (ahead - behind) / (2.0 * step), atol=1e-6)
