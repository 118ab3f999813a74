"""EKF prediction of the IMU's state from a measured twist (Kang, eqs. 1-2) or from raw IMU samples."""

from typing import NamedTuple, Protocol

import numpy as np

from filters.kalman.belief import IMU_LAYOUT, POSE, POSITION, ROTATION, TWIST_LAYOUT, Belief
from toolkit.estimator import Setup
from toolkit.geometry import Array, se3_adjoint, se3_inverse, skew
from toolkit.models import imu, twist
from toolkit.sequence import ImuMotion, ImuNoise, Motion, TwistMotion, TwistNoise


class Step(NamedTuple):
    """A state carried over one interval, how its error was carried (d, d), and what was added to it (d, d)."""

    T_world_imu: Array
    v_world: Array
    transition: Array
    noise: Array


class Predictor(Protocol):
    """Carries states over the motion between two frames."""

    def step(self, belief: Belief, motion: Motion) -> Step:
        """Carry the mean of a belief over an interval."""

    def transition_between(self, start: Belief, step: Step, motion: Motion) -> Array:
        """Return the transition (d, d) linearised at other states than the step was taken from.

        From the mean of ``start`` to the end of ``step``: with the first estimates of both instants, errors
        of the unobservable heading and position stay unobservable (Li & Mourikis 2013, section 4).
        """


def predictor(setup: Setup) -> Predictor:
    """Return the prediction for the kind of motion and the noise of a setup."""
    if isinstance(setup.noise, TwistNoise):
        return _TwistPredictor(setup.noise)
    return _ImuPredictor(setup.noise, setup.gravity_world)


def predicted(belief: Belief, step: Step) -> Belief:
    """Return the belief at the end of a step."""
    cov = step.transition @ belief.cov @ step.transition.T + step.noise
    return Belief(belief.layout, step.T_world_imu, step.v_world, belief.bias, 0.5 * (cov + cov.T))


class _TwistPredictor:
    def __init__(self, noise: TwistNoise) -> None:
        self._noise = noise

    def step(self, belief: Belief, motion: Motion) -> Step:
        assert isinstance(motion, TwistMotion)
        layout = TWIST_LAYOUT
        step = twist.integrate(motion, belief.bias[3:], self._noise)
        transition, noise = np.eye(layout.size), np.zeros((layout.size, layout.size))
        transition[POSE, POSE] = se3_adjoint(se3_inverse(step.T_start_end))
        transition[POSE, layout.gyro_bias] = step.d_step_d_bias
        noise[POSE, POSE] = step.cov
        noise[layout.gyro_bias, layout.gyro_bias] = twist.bias_walk_cov(self._noise, step.dt_s)
        return Step(belief.T_world_imu @ step.T_start_end, belief.v_world, transition, noise)

    def transition_between(self, start: Belief, step: Step, motion: Motion) -> Array:
        transition = step.transition.copy()
        transition[POSE, POSE] = se3_adjoint(se3_inverse(step.T_world_imu) @ start.T_world_imu)
        return transition


class _ImuPredictor:
    def __init__(self, noise: ImuNoise, gravity_world: Array) -> None:
        self._params = imu.preintegration_params(noise, gravity_world)
        self._gravity_world = gravity_world

    def step(self, belief: Belief, motion: Motion) -> Step:
        assert isinstance(motion, ImuMotion)
        preintegration = imu.preintegrate(motion, belief.bias, self._params)
        return Step(*imu.predict(preintegration, belief.T_world_imu, belief.v_world, belief.bias))

    def transition_between(self, start: Belief, step: Step, motion: Motion) -> Array:
        dt_s, velocity = float(motion.dt_s.sum()), IMU_LAYOUT.velocity
        to_start = start.T_world_imu[:3, :3].T
        turned_back = step.T_world_imu[:3, :3].T @ start.T_world_imu[:3, :3]
        fallen = start.v_world * dt_s + 0.5 * self._gravity_world * dt_s**2
        moved = to_start @ (step.T_world_imu[:3, 3] - start.T_world_imu[:3, 3] - fallen)
        hastened = to_start @ (step.v_world - start.v_world - self._gravity_world * dt_s)
        transition = step.transition.copy()
        transition[ROTATION, ROTATION] = turned_back
        transition[POSITION, :9] = turned_back @ np.hstack([-skew(moved), np.eye(3), dt_s * np.eye(3)])
        transition[velocity, :9] = turned_back @ np.hstack([-skew(hastened), np.zeros((3, 3)), np.eye(3)])
        return transition
