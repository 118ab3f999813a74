"""Raw-IMU motion through one preintegration that filter and smoother share (Forster et al. 2017, eqs. 26-38).

The preintegration is GTSAM's ``PreintegratedCombinedMeasurements``: the filter predicts with it, the smoother
makes its ``CombinedImuFactor`` of the very same object, so both see the same residual, Jacobians and noise.
"""

from typing import NamedTuple

import gtsam
import numpy as np

from toolkit.geometry import Array, so3_exp
from toolkit.sequence import ImuMotion, ImuNoise

# GTSAM wants a position-integration noise of its own (m/s/sqrt(Hz)); this one is far below any accelerometer's.
_INTEGRATION_DENSITY = 1e-6

Preintegration = gtsam.PreintegratedCombinedMeasurements


class ImuStep(NamedTuple):
    """The state at the end of an interval and its first-order error.

    ``T_world_imu`` (4, 4), ``v_world`` (3,) m/s; ``transition`` (15, 15) carries an error over the interval
    and ``cov`` (15, 15) is what the interval adds, both in the order rotation, position, velocity (body
    frame), accelerometer bias, gyro bias.
    """

    T_world_imu: Array
    v_world: Array
    transition: Array
    cov: Array


def preintegration_params(noise: ImuNoise, gravity_world: Array) -> gtsam.PreintegrationCombinedParams:
    """Return GTSAM's parameters for continuous noise densities and a gravity vector (3,) m/s^2."""
    params = gtsam.PreintegrationCombinedParams(gravity_world)
    eye = np.eye(3)
    params.setAccelerometerCovariance(eye * noise.accel_noise_density**2)
    params.setGyroscopeCovariance(eye * noise.gyro_noise_density**2)
    params.setBiasAccCovariance(eye * noise.accel_random_walk**2)
    params.setBiasOmegaCovariance(eye * noise.gyro_random_walk**2)
    params.setIntegrationCovariance(eye * _INTEGRATION_DENSITY**2)
    return params


def preintegrate(motion: ImuMotion, bias: Array, params: gtsam.PreintegrationCombinedParams) -> Preintegration:
    """Preintegrate one interval about a bias (6,) [accel, gyro].

    GTSAM turns each specific force by the attitude at the start of its step; ours stand for the middle, so
    they are turned by half the step's rotation first. That makes the integration second order: 20 s of a
    200 Hz flight drift by 1 mm instead of 9 cm.
    """
    preintegration = Preintegration(params, gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
    half_turns = so3_exp(0.5 * motion.dt_s[:, None] * (motion.gyro_radps - bias[3:]))
    accel_mps2 = (half_turns @ (motion.accel_mps2 - bias[:3])[..., None])[..., 0] + bias[:3]
    for accel, gyro, dt_s in zip(accel_mps2, motion.gyro_radps, motion.dt_s.tolist(), strict=True):
        preintegration.integrateMeasurement(accel, gyro, dt_s)
    return preintegration


def predict(preintegration: Preintegration, T_world_imu: Array, v_world: Array, bias: Array) -> ImuStep:
    """Carry a state (pose (4, 4), velocity (3,) m/s, bias (6,)) over the preintegrated interval."""
    state = gtsam.NavState(gtsam.Pose3(T_world_imu), v_world)
    d_state, d_bias = np.zeros((9, 9), order="F"), np.zeros((9, 6), order="F")
    predicted = preintegration.predict(state, gtsam.imuBias.ConstantBias(bias[:3], bias[3:]), d_state, d_bias)
    transition = np.eye(15)
    transition[:9, :9], transition[:9, 9:] = d_state, d_bias
    return ImuStep(
        predicted.pose().matrix(), predicted.velocity(), transition, np.asarray(preintegration.residualCovariance())
    )
