"""EKF prediction of the IMU's state from a measured twist (Kang, eqs. 1-2) or from raw IMU samples."""

from dataclasses import replace
from typing import Protocol

import numpy as np

from filters.kalman.belief import POSE, TWIST_LAYOUT, Belief
from toolkit.estimator import Setup
from toolkit.geometry import Array, se3_adjoint, se3_inverse
from toolkit.models import imu, twist
from toolkit.sequence import ImuMotion, ImuNoise, Motion, TwistMotion, TwistNoise


class Predict(Protocol):
    """Carries a belief over the motion between two frames."""

    def __call__(self, belief: Belief, motion: Motion) -> Belief:
        """Return the belief at the end of the interval."""


def predictor(setup: Setup) -> Predict:
    """Return the prediction for the kind of motion and the noise of a setup."""
    if isinstance(setup.noise, TwistNoise):
        return _TwistPredictor(setup.noise)
    return _ImuPredictor(setup.noise, setup.gravity_world)


class _TwistPredictor:
    def __init__(self, noise: TwistNoise) -> None:
        self._noise = noise

    def __call__(self, belief: Belief, motion: Motion) -> Belief:
        assert isinstance(motion, TwistMotion)
        bias = TWIST_LAYOUT.gyro_bias
        step = twist.integrate(motion, belief.bias[3:], self._noise)
        transition = np.eye(TWIST_LAYOUT.size)
        transition[POSE, POSE] = se3_adjoint(se3_inverse(step.T_start_end))
        transition[POSE, bias] = step.d_step_d_bias
        cov = transition @ belief.cov @ transition.T
        cov[POSE, POSE] += step.cov
        cov[bias, bias] += twist.bias_walk_cov(self._noise, step.dt_s)
        return replace(belief, T_world_imu=belief.T_world_imu @ step.T_start_end, cov=0.5 * (cov + cov.T))


class _ImuPredictor:
    def __init__(self, noise: ImuNoise, gravity_world: Array) -> None:
        self._params = imu.preintegration_params(noise, gravity_world)

    def __call__(self, belief: Belief, motion: Motion) -> Belief:
        assert isinstance(motion, ImuMotion)
        preintegration = imu.preintegrate(motion, belief.bias, self._params)
        step = imu.predict(preintegration, belief.T_world_imu, belief.v_world, belief.bias)
        cov = step.transition @ belief.cov @ step.transition.T + step.cov
        return replace(belief, T_world_imu=step.T_world_imu, v_world=step.v_world, cov=0.5 * (cov + cov.T))
