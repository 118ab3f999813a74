"""The steps that a trajectory is compared with, predicted from averaged samples, are those of all samples."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.estimate import Trajectory
from toolkit.geometry import se3_inverse, se3_log
from toolkit.measurements import ImuMotion
from toolkit.models.corrections import _averaged, predicted_steps
from toolkit.motion_samples import Bridges
from toolkit.simulation import FLIGHT, simulate


def test_averaged_samples_predict_the_same_poses_and_noise():
    """To far less than a test of divergence allows a step: 0.02 rad/s and 0.2 m/s, at 20 frames a second."""
    sound = simulate(replace(FLIGHT, duration_s=2.0), 3)
    bridged = replace(sound, bridges=Bridges(sound.frames_t_ns[5:6], sound.frames_t_ns[9:10], np.full((1, 2), 30.0)))
    truth = sound.truth
    at_frames = np.searchsorted(truth.t_ns, sound.frames_t_ns)
    rows = at_frames[truth.t_ns[np.minimum(at_frames, truth.t_ns.size - 1)] == sound.frames_t_ns]
    trajectory = Trajectory(truth.t_ns[rows], truth.T_world_imu[rows], v_world=truth.v_world[rows])
    exact, averaged = (predicted_steps(trajectory, bridged, longest_s) for longest_s in (0.0, 0.02))
    np.testing.assert_allclose(averaged.dt_s, exact.dt_s, rtol=1e-12)
    off = se3_log(se3_inverse(exact.predictions.T_world_imu) @ averaged.predictions.T_world_imu)
    assert 0.0 < np.abs(off[:, :3]).max() < 1e-5
    assert np.abs(off[:, 3:]).max() < 1e-4
    noise = [np.diagonal(each.predictions.noise, axis1=1, axis2=2) for each in (exact, averaged)]
    np.testing.assert_allclose(noise[1], noise[0], rtol=0.2)


@pytest.mark.parametrize("rate_hz", [50, 200])
def test_no_average_is_longer_than_said_where_durations_divide_it(rate_hz):
    """Over many frames, whose durations add up with rounding; the integrals over each stay."""
    rng, count = np.random.default_rng(1), rate_hz // 10
    dt_s = np.full(count, 1.0 / rate_hz)
    samples = [rng.normal(size=(2, count, 3)) for _ in range(300)]
    averaged = _averaged([ImuMotion(dt_s, accel, gyro) for accel, gyro in samples], 0.02)
    assert {motion.dt_s.size for motion in averaged} == {5}
    for motion, (accel, gyro) in zip(averaged, samples, strict=True):
        np.testing.assert_allclose(motion.dt_s @ motion.accel_mps2, dt_s @ accel, atol=1e-12)
        np.testing.assert_allclose(motion.dt_s @ motion.gyro_radps, dt_s @ gyro, atol=1e-12)
