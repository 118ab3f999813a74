"""Unmeasured motion: the body's twist is constant but for white noise on its change.

The state is pose, velocity and turn rate. Velocity and turn rate stand where a state with an IMU has velocity and gyro
bias: a gyro that always reads zero has the turn rate, with the sign changed, as its bias. So estimators need no code
for this kind of motion.

Over dt the pose moves by T <- T exp(dt [w, v]), where v is the velocity in the body frame, which is constant. White
noise of densities q on the twist's change adds q dt^3/3 to the covariance of the pose, q dt to that of the twist, and q
dt^2/2 to that between them (Barfoot, "State estimation for robotics" (2017), eq. 3.202: white noise on acceleration).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from toolkit.estimate import Estimate
from toolkit.geometry import Array, se3_adjoint, se3_exp, se3_inverse, se3_log, se3_right_jacobian, skew
from toolkit.measurements import Motion, Prior, TwistChangeNoise, UnmeasuredMotion
from toolkit.models.factors import B, V, X, joint_prior, latest_values
from toolkit.models.state import POSE, ROTATION, Belief, Layout, Prediction, with_velocity_turned

_VELOCITY, _TURN = slice(6, 9), slice(9, 12)
SMOOTH_LAYOUT = Layout(12, _VELOCITY, None, _TURN)


def _twist(T_world_imu: Array, v_world: Array, bias: Array) -> Array:
    """Return the body twist (6,) [rad/s, m/s] of a state."""
    return np.concatenate([-bias, T_world_imu[:3, :3].T @ v_world])


def twist_change_cov(noise: TwistChangeNoise, dt_s: float) -> Array:
    """Return the covariance (12, 12) that an interval adds to pose [rotation, position] and twist [rad/s, m/s]."""
    density = np.concatenate([noise.turn_change_density, noise.velocity_change_density]) ** 2
    return np.block(
        [
            [np.diag(density * dt_s**3 / 3.0), np.diag(density * dt_s**2 / 2.0)],
            [np.diag(density * dt_s**2 / 2.0), np.diag(density * dt_s)],
        ]
    )


@dataclass(frozen=True, eq=False)
class SmoothIncrement:
    """An interval of ``dt_s`` in which the twist changes by noise alone."""

    dt_s: float
    noise: TwistChangeNoise

    def predict(self, start: Belief) -> Prediction:
        """Predict a state over the interval, moved by the twist of its mean."""
        xi = self.dt_s * _twist(start.T_world_imu, start.v_world, start.bias[3:])
        T_start_end = se3_exp(xi)
        v_body = start.T_world_imu[:3, :3].T @ start.v_world
        T_world_imu = start.T_world_imu @ T_start_end
        v_world = T_world_imu[:3, :3] @ v_body
        transition = _transition(T_start_end, se3_right_jacobian(xi), v_body, self.dt_s)
        # A rotation error at the end also changes the velocity error, because the body's velocity is fixed in its axes.
        spread = np.zeros((12, 12))
        spread[POSE, POSE] = np.eye(6)
        spread[_VELOCITY, ROTATION] = -skew(v_body)
        spread[_VELOCITY, 9:12], spread[_TURN, 6:9] = np.eye(3), -np.eye(3)
        noise = spread @ twist_change_cov(self.noise, self.dt_s) @ spread.T
        return Prediction(T_world_imu, v_world, transition, 0.5 * (noise + noise.T))

    def transition_between(self, start: Belief, end: Prediction) -> Array:
        """Return the transition (12, 12) from the mean of ``start`` to that of ``end``."""
        T_start_end = se3_inverse(start.T_world_imu) @ end.T_world_imu
        v_body = start.T_world_imu[:3, :3].T @ start.v_world
        return _transition(T_start_end, se3_right_jacobian(se3_log(T_start_end)), v_body, self.dt_s)

    def factors(self, k: int) -> gtsam.NonlinearFactorGraph:
        """Return the factor between pose, velocity and turn rate of two states."""
        graph = gtsam.NonlinearFactorGraph()
        graph.add(smooth_factor(self.dt_s, self.noise, k))
        return graph


def _transition(T_start_end: Array, d_end_d_xi: Array, v_body: Array, dt_s: float) -> Array:
    """Return F (12, 12): an error of the start's pose, velocity (body) and turn rate, carried to the end."""
    F = np.zeros((12, 12))
    F[POSE, POSE] = se3_adjoint(se3_inverse(T_start_end))
    # The velocity in the body frame depends on the velocity in the world and on the body's attitude.
    F[POSE, ROTATION] += dt_s * d_end_d_xi[:, 3:] @ skew(v_body)
    F[POSE, _VELOCITY] = dt_s * d_end_d_xi[:, 3:]
    F[POSE, _TURN] = -dt_s * d_end_d_xi[:, :3]
    F[_VELOCITY] = -skew(v_body) @ F[ROTATION]
    F[_VELOCITY, ROTATION] += skew(v_body)
    F[_VELOCITY, _VELOCITY] += np.eye(3)
    F[_TURN, _TURN] = np.eye(3)
    return F


def smooth_factor(dt_s: float, noise: TwistChangeNoise, k: int) -> gtsam.NonlinearFactor:
    """Return the factor from X, V, B(k - 1) to X, V, B(k); B (3,) is the turn rate with the sign changed.

    The residual (12,) is the pose error in the tangent of the predicted end, ``log(predicted^-1 T_k)``, then the change
    of the twist [rad/s, m/s].
    """
    covariance = gtsam.noiseModel.Gaussian.Covariance(twist_change_cov(noise, dt_s))
    keys = [X(k - 1), V(k - 1), B(k - 1), X(k), V(k), B(k)]

    def residual(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        x0, v0, b0, x1, v1, b1 = this.keys()
        start, end = values.atPose3(x0).matrix(), values.atPose3(x1).matrix()
        before = _twist(start, values.atVector(v0), values.atVector(b0))
        after = _twist(end, values.atVector(v1), values.atVector(b1))
        T_start_end = se3_exp(dt_s * before)
        off = gtsam.Pose3(se3_inverse(start @ T_start_end) @ end)
        error: Array = gtsam.Pose3.Logmap(off)
        if jacobians is not None:
            _fill(jacobians, (start, before), (end, after), off, dt_s)
        return np.concatenate([error, after - before])

    return gtsam.CustomFactor(covariance, keys, residual)


def _fill(
    jacobians: list[Array], start: tuple[Array, Array], end: tuple[Array, Array], off: gtsam.Pose3, dt_s: float
) -> None:
    """Write the Jacobians of the residual to X, V, B at both ends, poses (4, 4) with twists (6,), to a list."""
    before = start[1]
    d_error_d_end = gtsam.Pose3.LogmapDerivative(gtsam.Pose3.Logmap(off))
    d_error_d_step = -d_error_d_end @ off.inverse().AdjointMap()
    d_error_d_twist = dt_s * d_error_d_step @ se3_right_jacobian(dt_s * before)
    carried = d_error_d_step @ se3_adjoint(se3_exp(-dt_s * before))
    # A twist [w, v] changes by the pose through v = R^T v_world, by v_world, and by the bias -w.
    for place, (T, twist, sign) in enumerate(((*start, -1.0), (*end, 1.0))):
        by_pose, by_velocity, by_turn = np.zeros((6, 6)), np.zeros((6, 3)), np.zeros((6, 3))
        by_pose[3:, :3], by_velocity[3:], by_turn[:3] = skew(twist[3:]), T[:3, :3].T, -np.eye(3)
        through = d_error_d_twist if place == 0 else np.zeros((6, 6))
        direct = carried if place == 0 else d_error_d_end
        jacobians[3 * place] = np.vstack([direct + through @ by_pose, sign * by_pose])
        jacobians[3 * place + 1] = np.vstack([through @ by_velocity, sign * by_velocity])
        jacobians[3 * place + 2] = np.vstack([through @ by_turn, sign * by_turn])


class SmoothTwist:
    """Pose, velocity and turn rate, moved by a twist that is constant but for noise."""

    layout = SMOOTH_LAYOUT
    variable_sizes: Mapping[str, int] = {"x": 6, "v": 3, "b": 3}

    def __init__(self, noise: TwistChangeNoise) -> None:
        self._noise = noise

    def initial_belief(self, prior: Prior) -> Belief:
        """Return the belief at the first frame: pose, velocity and turn rate of the prior."""
        return Belief.of_prior(prior, self.layout)

    def integrate(self, motion: Motion, bias: Array) -> SmoothIncrement:
        """Return the interval between two frames; nothing was measured in it, and its bias (6,) is not used."""
        assert isinstance(motion, UnmeasuredMotion)
        return SmoothIncrement(float(motion.dt_s.sum()), self._noise)

    def latest(self, tree: gtsam.ISAM2, keys: list[int]) -> gtsam.Values:
        """Return the latest values of some variables of a tree."""
        return latest_values(tree, keys, tree.calculateEstimateVector)

    def insert(self, values: gtsam.Values, estimate: Estimate, k: int) -> None:
        """Add state k at an estimate."""
        assert estimate.bias is not None and estimate.v_world is not None
        values.insert(X(k), gtsam.Pose3(estimate.T_world_imu))
        values.insert(V(k), estimate.v_world)
        values.insert(B(k), estimate.bias[3:])

    def read(self, values: gtsam.Values, k: int, t_ns: int) -> Estimate:
        """Return state k."""
        bias = np.concatenate([np.zeros(3), values.atVector(B(k))])
        return Estimate(t_ns, values.atPose3(X(k)).matrix(), v_world=values.atVector(V(k)), bias=bias)

    def hold(self, belief: Belief, k: int) -> gtsam.NonlinearFactorGraph:
        """Return the prior on state k at a belief."""
        at = gtsam.Values()
        at.insert(X(k), gtsam.Pose3(belief.T_world_imu))
        at.insert(V(k), belief.v_world)
        at.insert(B(k), belief.bias[3:])
        cov = with_velocity_turned(belief.cov, self.layout, belief.T_world_imu[:3, :3])
        return joint_prior(at, {X(k): POSE, V(k): _VELOCITY, B(k): _TURN}, cov)

    def estimate_cov(self, cov: Array, R_world_imu: Array) -> Array:
        """Return the covariance (12, 12) with the velocity's error in the body frame, exactly symmetric."""
        cov = with_velocity_turned(cov, self.layout, R_world_imu.T)
        return 0.5 * (cov + cov.T)
