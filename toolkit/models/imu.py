"""Motion by raw IMU samples, through one preintegration that filter and smoother share.

The preintegration is GTSAM's ``PreintegratedCombinedMeasurements``: the filter predicts with it, and the smoother makes
its ``CombinedImuFactor`` from the same object, so that both have the same residual, Jacobians and noise (Forster et al.
2017, eqs. 26-38). The state is pose, velocity and both biases.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from toolkit.geometry import Array, skew, so3_exp
from toolkit.measurements import ImuMotion, ImuNoise, Motion
from toolkit.models.factors import B, V, X, constant_bias
from toolkit.models.graph_state import MotionModel
from toolkit.models.state import IMU_LAYOUT, POSITION, ROTATION, Belief, Prediction

_VELOCITY = slice(6, 9)
_IDENTITY = np.eye(IMU_LAYOUT.size)

# GTSAM requires a noise of position integration (m/s/sqrt(Hz)); this one is far below any accelerometer's effect.
INTEGRATION_DENSITY = 1e-6

Preintegration = gtsam.PreintegratedCombinedMeasurements


def preintegration_params(noise: ImuNoise, gravity_world: Array) -> gtsam.PreintegrationCombinedParams:
    """Return GTSAM's parameters for continuous noise densities and a gravity vector (3,) m/s^2."""
    params = gtsam.PreintegrationCombinedParams(gravity_world)
    eye = np.eye(3)
    params.setAccelerometerCovariance(eye * noise.accel_noise_density**2)
    params.setGyroscopeCovariance(eye * noise.gyro_noise_density**2)
    params.setBiasAccCovariance(eye * noise.accel_random_walk**2)
    params.setBiasOmegaCovariance(eye * noise.gyro_random_walk**2)
    params.setIntegrationCovariance(eye * INTEGRATION_DENSITY**2)
    return params


def preintegrate(motion: ImuMotion, bias: Array, params: gtsam.PreintegrationCombinedParams) -> Preintegration:
    """Preintegrate one interval about a bias (6,) [accel, gyro].

    GTSAM rotates each specific force by the attitude at the start of its step. The samples here are for the middle of
    the step, so they are first rotated by half the step's rotation. That makes the integration second order: 20 s of a
    200 Hz flight drift by 1 mm instead of 9 cm.
    """
    half_turns = so3_exp(0.5 * motion.dt_s[:, None] * (motion.gyro_radps - bias[3:]))
    at_start = (half_turns @ (motion.accel_mps2 - bias[:3])[..., None])[..., 0] + bias[:3]
    preintegration = Preintegration(params, constant_bias(bias))
    for accel, gyro, dt_s in zip(at_start, motion.gyro_radps, motion.dt_s.tolist(), strict=True):
        preintegration.integrateMeasurement(accel, gyro, dt_s)
    return preintegration


def predict(preintegration: Preintegration, T_world_imu: Array, v_world: Array, bias: Array) -> Prediction:
    """Predict a state (pose (4, 4), velocity (3,) m/s, bias (6,)) over the preintegrated interval."""
    state = gtsam.NavState(gtsam.Pose3(T_world_imu), v_world)
    by_start = np.empty((9, 15), order="F")  # GTSAM writes to both parts
    predicted = preintegration.predict(state, constant_bias(bias), by_start[:, :9], by_start[:, 9:])
    transition = _IDENTITY.copy()
    transition[:9] = by_start
    noise = np.asarray(preintegration.residualCovariance())
    return Prediction(predicted.pose().matrix(), predicted.velocity(), transition, noise)


@dataclass(frozen=True, eq=False)
class ImuIncrement:
    """The preintegrated samples between two frames, their duration, and gravity (3,) m/s^2 in the world."""

    preintegration: Preintegration
    dt_s: float
    gravity_world: Array

    def predict(self, start: Belief) -> Prediction:
        return predict(self.preintegration, start.T_world_imu, start.v_world, start.bias)

    def transition_between(self, start: Belief, end: Prediction) -> Array:
        """Return the transition (15, 15) from the mean of ``start`` to that of ``end``.

        The blocks of the biases stay as predicted; those of pose and velocity are the exact derivatives at both means
        (Li & Mourikis 2013, section 4).
        """
        dt_s, to_start = self.dt_s, start.T_world_imu[:3, :3].T
        turned_back = end.T_world_imu[:3, :3].T @ start.T_world_imu[:3, :3]
        fallen = start.v_world * dt_s + 0.5 * self.gravity_world * dt_s**2
        moved = to_start @ (end.T_world_imu[:3, 3] - start.T_world_imu[:3, 3] - fallen)
        accelerated = to_start @ (end.v_world - start.v_world - self.gravity_world * dt_s)
        transition = end.transition.copy()
        for block in (ROTATION, POSITION, _VELOCITY):
            transition[block, block] = turned_back
        transition[POSITION, ROTATION], transition[_VELOCITY, ROTATION] = -(
            turned_back @ skew(np.array([moved, accelerated]))
        )
        transition[POSITION, _VELOCITY], transition[_VELOCITY, POSITION] = dt_s * turned_back, 0.0
        return transition

    def factors(self, k: int) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        states = X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k)
        graph.add(gtsam.CombinedImuFactor(*states, self.preintegration))
        return graph


class ImuModel(MotionModel):
    """Pose, velocity and both biases, moved by specific force and turn rate."""

    layout = IMU_LAYOUT

    def __init__(self, noise: ImuNoise, gravity_world: Array) -> None:
        self._noise, self._gravity_world = noise, gravity_world
        self._params = preintegration_params(noise, gravity_world)

    def integrate(self, motion: Motion, bias: Array) -> ImuIncrement:
        assert isinstance(motion, ImuMotion)
        preintegration = preintegrate(motion, bias, self._params_over(motion))
        return ImuIncrement(preintegration, float(motion.dt_s.sum()), self._gravity_world)

    def _params_over(self, motion: ImuMotion) -> gtsam.PreintegrationCombinedParams:
        """Return the parameters over an interval; a preintegration has one noise, the mean over a bridged piece."""
        if motion.noise_scale is None:
            return self._params
        accel, gyro = np.sqrt(motion.dt_s @ motion.noise_scale**2 / motion.dt_s.sum()).tolist()
        scaled = replace(
            self._noise,
            accel_noise_density=accel * self._noise.accel_noise_density,
            gyro_noise_density=gyro * self._noise.gyro_noise_density,
        )
        return preintegration_params(scaled, self._gravity_world)
