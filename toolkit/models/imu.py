"""Motion by raw IMU samples, through one preintegration that filter and smoother share.

The preintegration is GTSAM's ``PreintegratedCombinedMeasurements``: the filter predicts with it, and the smoother makes
its ``CombinedImuFactor`` from the same object, so that both have the same residual, Jacobians and noise (Forster et al.
2017, eqs. 26-38). The state is pose, velocity and both biases.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from toolkit.estimate import Estimate
from toolkit.geometry import Array, skew, so3_exp
from toolkit.measurements import ImuMotion, ImuNoise, Motion, Prior
from toolkit.models.factors import B, V, X, joint_prior, latest_values
from toolkit.models.state import IMU_LAYOUT, POSE, POSITION, ROTATION, Belief, Prediction, with_velocity_turned

_VELOCITY = slice(6, 9)

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
    return _preintegrated(motion, _from_mid_step(motion.dt_s, motion.gyro_radps, motion.accel_mps2, bias), bias, params)


def _from_mid_step(dt_s: Array, gyro_radps: Array, accel_mps2: Array, bias: Array) -> Array:
    """Return specific forces (n, 3) rotated to the starts of their steps, with the bias taken off and added back.

    The bias is (6,), or one each (n, 6).
    """
    half_turns = so3_exp(0.5 * dt_s[:, None] * (gyro_radps - bias[..., 3:]))
    return np.asarray((half_turns @ (accel_mps2 - bias[..., :3])[..., None])[..., 0] + bias[..., :3])


def _preintegrated(
    motion: ImuMotion, accel_mps2: Array, bias: Array, params: gtsam.PreintegrationCombinedParams
) -> Preintegration:
    """Preintegrate an interval with specific forces (n, 3) given at the starts of its steps."""
    preintegration = Preintegration(params, constant_bias(bias))
    for accel, gyro, dt_s in zip(accel_mps2, motion.gyro_radps, motion.dt_s.tolist(), strict=True):
        preintegration.integrateMeasurement(accel, gyro, dt_s)
    return preintegration


def predict(preintegration: Preintegration, T_world_imu: Array, v_world: Array, bias: Array) -> Prediction:
    """Predict a state (pose (4, 4), velocity (3,) m/s, bias (6,)) over the preintegrated interval."""
    state = gtsam.NavState(gtsam.Pose3(T_world_imu), v_world)
    d_state, d_bias = np.zeros((9, 9), order="F"), np.zeros((9, 6), order="F")
    predicted = preintegration.predict(state, constant_bias(bias), d_state, d_bias)
    transition = np.eye(15)
    transition[:9, :9], transition[:9, 9:] = d_state, d_bias
    noise = np.asarray(preintegration.residualCovariance())
    return Prediction(predicted.pose().matrix(), predicted.velocity(), transition, noise)


def imu_factor(preintegration: Preintegration, k: int) -> gtsam.NonlinearFactor:
    """Return the factor from frame k - 1 to frame k on poses X, velocities V and biases B."""
    return gtsam.CombinedImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k), preintegration)


def constant_bias(bias: Array) -> gtsam.imuBias.ConstantBias:
    """Return GTSAM's value for a bias (6,) [accel, gyro]."""
    return gtsam.imuBias.ConstantBias(bias[:3], bias[3:])


def transition_over(dt_s: float, gravity_world: Array, start: Belief, end: Prediction) -> Array:
    """Return the transition (15, 15) of an interval from the mean of ``start`` to that of ``end``.

    The blocks of the biases stay as predicted; those of pose and velocity are the exact derivatives at both means
    (Li & Mourikis 2013, section 4).
    """
    to_start = start.T_world_imu[:3, :3].T
    turned_back = end.T_world_imu[:3, :3].T @ start.T_world_imu[:3, :3]
    fallen = start.v_world * dt_s + 0.5 * gravity_world * dt_s**2
    moved = to_start @ (end.T_world_imu[:3, 3] - start.T_world_imu[:3, 3] - fallen)
    accelerated = to_start @ (end.v_world - start.v_world - gravity_world * dt_s)
    transition = end.transition.copy()
    for block in (ROTATION, POSITION, _VELOCITY):
        transition[block, block] = turned_back
    transition[POSITION, ROTATION], transition[_VELOCITY, ROTATION] = -(
        turned_back @ skew(np.array([moved, accelerated]))
    )
    transition[POSITION, _VELOCITY], transition[_VELOCITY, POSITION] = dt_s * turned_back, 0.0
    return transition


def mean_noise_scale(motion: ImuMotion) -> tuple[float, float]:
    """Return the mean factors on the stated standard deviation of the accelerometer's and the gyro's white noise."""
    assert motion.noise_scale is not None
    accel, gyro = np.sqrt(motion.dt_s @ motion.noise_scale**2 / motion.dt_s.sum()).tolist()
    return accel, gyro


@dataclass(frozen=True, eq=False)
class ImuIncrement:
    """The preintegrated samples between two frames, their duration, and gravity (3,) m/s^2 in the world."""

    preintegration: Preintegration
    dt_s: float
    gravity_world: Array

    def predict(self, start: Belief) -> Prediction:
        """Predict a state over the interval."""
        return predict(self.preintegration, start.T_world_imu, start.v_world, start.bias)

    def transition_between(self, start: Belief, end: Prediction) -> Array:
        """Return the transition (15, 15) from the mean of ``start`` to that of ``end``."""
        return transition_over(self.dt_s, self.gravity_world, start, end)

    def factors(self, k: int) -> gtsam.NonlinearFactorGraph:
        """Return the preintegrated factor between two states."""
        graph = gtsam.NonlinearFactorGraph()
        graph.add(imu_factor(self.preintegration, k))
        return graph


class ImuModel:
    """Pose, velocity and both biases, moved by specific force and turn rate."""

    layout = IMU_LAYOUT
    variable_sizes: Mapping[str, int] = {"x": 6, "v": 3, "b": 6}

    def __init__(self, noise: ImuNoise, gravity_world: Array) -> None:
        self._noise, self._gravity_world = noise, gravity_world
        self._params = preintegration_params(noise, gravity_world)

    def initial_belief(self, prior: Prior) -> Belief:
        """Return the belief at the first frame: the whole prior."""
        return Belief.of_prior(prior, self.layout)

    def integrate(self, motion: Motion, bias: Array) -> ImuIncrement:
        """Preintegrate the samples between two frames about a bias (6,)."""
        assert isinstance(motion, ImuMotion)
        preintegration = preintegrate(motion, bias, self._params_over(motion))
        return ImuIncrement(preintegration, float(motion.dt_s.sum()), self._gravity_world)

    def integrate_each(self, motions: Sequence[Motion], biases: Sequence[Array]) -> list[ImuIncrement]:
        """Preintegrate the samples of some intervals, each about its own bias (6,), half-step rotations all at once."""
        imu = [motion for motion in motions if isinstance(motion, ImuMotion)]
        sizes = [motion.dt_s.size for motion in imu]
        accel_mps2 = _from_mid_step(
            np.concatenate([motion.dt_s for motion in imu]),
            np.concatenate([motion.gyro_radps for motion in imu]),
            np.concatenate([motion.accel_mps2 for motion in imu]),
            np.repeat(np.array(biases), sizes, axis=0),
        )
        parts = np.split(accel_mps2, np.cumsum(sizes)[:-1])
        return [
            ImuIncrement(
                _preintegrated(motion, accel, bias, self._params_over(motion)),
                float(motion.dt_s.sum()),
                self._gravity_world,
            )
            for motion, accel, bias in zip(imu, parts, biases, strict=True)
        ]

    def _params_over(self, motion: ImuMotion) -> gtsam.PreintegrationCombinedParams:
        """Return the parameters over an interval; a preintegration has one noise, the mean over a bridged piece."""
        if motion.noise_scale is None:
            return self._params
        accel, gyro = mean_noise_scale(motion)
        scaled = replace(
            self._noise,
            accel_noise_density=accel * self._noise.accel_noise_density,
            gyro_noise_density=gyro * self._noise.gyro_noise_density,
        )
        return preintegration_params(scaled, self._gravity_world)

    def latest(self, tree: gtsam.ISAM2, keys: list[int]) -> gtsam.Values:
        """Return the latest values of some variables of a tree."""
        return latest_values(tree, keys, tree.calculateEstimateConstantBias)

    def insert(self, values: gtsam.Values, estimate: Estimate, k: int) -> None:
        """Add state k at an estimate."""
        assert estimate.bias is not None and estimate.v_world is not None
        values.insert(X(k), gtsam.Pose3(estimate.T_world_imu))
        values.insert(V(k), estimate.v_world)
        values.insert(B(k), constant_bias(estimate.bias))

    def read(self, values: gtsam.Values, k: int, t_ns: int) -> Estimate:
        """Return state k."""
        pose, velocity, bias = values.atPose3(X(k)), values.atVector(V(k)), values.atConstantBias(B(k))
        return Estimate(t_ns, pose.matrix(), v_world=velocity, bias=bias.vector())

    def hold(self, belief: Belief, k: int) -> gtsam.NonlinearFactorGraph:
        """Return the prior on state k at a belief."""
        at = gtsam.Values()
        at.insert(X(k), gtsam.Pose3(belief.T_world_imu))
        at.insert(V(k), belief.v_world)
        at.insert(B(k), constant_bias(belief.bias))
        cov = with_velocity_turned(belief.cov, self.layout, belief.T_world_imu[:3, :3])
        blocks = {X(k): POSE, V(k): _VELOCITY, B(k): self.layout.biases}
        return joint_prior(at, blocks, cov)

    def estimate_cov(self, cov: Array, R_world_imu: Array) -> Array:
        """Return the covariance (15, 15) with the velocity's error in the body frame, exactly symmetric."""
        cov = with_velocity_turned(cov, self.layout, R_world_imu.T)
        return 0.5 * (cov + cov.T)
