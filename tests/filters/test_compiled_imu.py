"""The compiled prediction by an IMU is that of GTSAM's preintegration."""

from dataclasses import replace

import numpy as np
import pytest

from filters.kalman.compiled_imu import CompiledImu
from toolkit.datasets import load_sequence
from toolkit.initialization import start_from_measurements
from toolkit.measurements import ImuNoise
from toolkit.models.imu import ImuModel
from toolkit.models.state import IMU_LAYOUT, Belief


@pytest.mark.parametrize("faster", [1.0, 10.0, 40.0])
def test_a_prediction_is_that_of_the_model_that_smoothers_share(faster):
    sequence = load_sequence("kitti00")
    prior = start_from_measurements(sequence)
    noise = ImuNoise(1e-2, 2e-2, 3e-2, 4e-2)  # of one order, so that every term counts
    model = ImuModel(noise, sequence.gravity_world)
    compiled = CompiledImu(model)
    for k, packet in enumerate(list(sequence.packets())[1::10]):
        motion = replace(packet.motion, gyro_radps=packet.motion.gyro_radps * faster)
        if k % 2:
            motion = replace(motion, noise_scale=np.tile([3.0, 2.0], (motion.dt_s.size, 1)))
        bias = prior.bias + 0.01 * k
        start = Belief(IMU_LAYOUT, prior.T_world_imu, prior.v_world + np.arange(3.0), bias, np.eye(15))
        expected, found = (each.integrate(motion, bias).predict(start) for each in (model, compiled))
        sigma = np.sqrt(np.diag(expected.noise))
        correlated = (each._replace(noise=each.noise / np.outer(sigma, sigma)) for each in (found, expected))
        for one, other in zip(*correlated, strict=True):
            np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-9)
        between = (each.integrate(motion, bias).transition_between(start, expected) for each in (model, compiled))
        np.testing.assert_array_equal(*between)
