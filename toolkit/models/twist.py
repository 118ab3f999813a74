"""Motion by a body twist: measured, with a gyro bias (Kang, eqs. 1-2), or not measured and constant but for noise.

The pose moves by T <- T exp(dt [w - b, v]); everything is in GTSAM's order [rotation, position] and perturbed on the
right. With measured twists the state is pose and gyro bias; the velocity is measured, not estimated.

Without a measurement the state is pose, velocity and turn rate. Velocity and turn rate stand where a state with an IMU
has velocity and gyro bias: a gyro that always reads zero has the turn rate, with the sign changed, as its bias. So
estimators need no code for this kind of motion. Over dt the pose moves by T <- T exp(dt [w, v]), where v is the
velocity in the body frame, which is constant. White noise of densities q on the twist's change adds q dt^3/3 to the
covariance of the pose, q dt to that of the twist, and q dt^2/2 to that between them (Barfoot, "State estimation for
robotics" (2017), eq. 3.202: white noise on acceleration).
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from toolkit.geometry import (
    Array,
    se3_adjoint,
    se3_exp,
    se3_exp_and_right_jacobian,
    se3_inverse,
    se3_log,
    se3_right_jacobian,
    skew,
)
from toolkit.measurements import Motion, TwistChangeNoise, TwistMotion, TwistNoise, UnmeasuredMotion, noise_scale_of
from toolkit.models.factors import B, V, X
from toolkit.models.graph_state import MotionModel
from toolkit.models.state import POSE, ROTATION, TWIST_LAYOUT, Belief, Layout, Prediction


@dataclass(frozen=True, eq=False)
class TwistIncrement:
    """The relative motion of one interval, integrated about a gyro bias (3,), and its first-order error.

    ``T_start_end`` (4, 4); ``d_step_d_bias`` (6, 3), the Jacobian of the step's end (right perturbation) to the gyro
    bias; ``cov`` (6, 6), the covariance of the step in the tangent of its end, from the noise of the twist alone;
    ``dt_s``, the interval's length. Of several intervals, each has one axis more in front.
    """

    T_start_end: Array
    d_step_d_bias: Array
    cov: Array
    dt_s: float | Array
    gyro_bias: Array
    noise: TwistNoise

    def predict(self, start: Belief) -> Prediction:
        size, gyro_bias = TWIST_LAYOUT.size, TWIST_LAYOUT.gyro_bias
        transition, noise = np.zeros((2, *self.cov.shape[:-2], size, size))
        transition[..., POSE, POSE] = se3_adjoint(se3_inverse(self.T_start_end))
        transition[..., POSE, gyro_bias] = self.d_step_d_bias
        transition[..., gyro_bias, gyro_bias] = np.eye(3)
        noise[..., POSE, POSE] = self.cov
        noise[..., gyro_bias, gyro_bias] = bias_walk_cov(self.noise, self.dt_s)
        return Prediction(start.T_world_imu @ self.T_start_end, start.v_world, transition, noise)

    def transition_between(self, start: Belief, end: Prediction) -> Array:
        transition = end.transition.copy()
        transition[POSE, POSE] = se3_adjoint(se3_inverse(end.T_world_imu) @ start.T_world_imu)
        return transition

    def factors(self, k: int) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        graph.add(twist_factor(self, k))
        walk = gtsam.noiseModel.Gaussian.Covariance(bias_walk_cov(self.noise, self.dt_s))
        graph.add(gtsam.BetweenFactorVector(B(k - 1), B(k), np.zeros(3), walk))
        return graph


def integrate(motion: TwistMotion, gyro_bias: Array, noise: TwistNoise) -> TwistIncrement:
    """Integrate the twists of one interval, piece by piece, with a gyro bias (3,) rad/s subtracted.

    Several intervals of equally many twists are integrated at once, where all arrays have one axis more in front.
    """
    density_squared = np.concatenate([noise.gyro_noise_density**2, noise.velocity_noise_density**2])
    if motion.noise_scale is not None:
        density_squared = density_squared * np.repeat(motion.noise_scale[..., ::-1] ** 2, 3, axis=-1)
    dt_s = motion.dt_s[..., None]
    pieces, d_end_d_xi = se3_exp_and_right_jacobian(
        dt_s * np.concatenate([motion.w_radps - gyro_bias[..., None, :], motion.v_mps], axis=-1)
    )
    by_bias = -dt_s[..., None] * d_end_d_xi[..., :3]
    covs = (d_end_d_xi * (dt_s * density_squared)[..., None, :]) @ d_end_d_xi.mT
    (T_start_end, d_step_d_bias, cov), *others = zip(
        *(np.moveaxis(a, -3, 0) for a in (pieces, by_bias, covs)), strict=True
    )
    for piece, own_by_bias, own_cov in others:
        carry = se3_adjoint(se3_inverse(piece))
        T_start_end = T_start_end @ piece
        d_step_d_bias = carry @ d_step_d_bias + own_by_bias
        cov = carry @ cov @ carry.mT + own_cov
    return TwistIncrement(T_start_end, d_step_d_bias, cov, motion.dt_s.sum(axis=-1), gyro_bias, noise)


def bias_walk_cov(noise: TwistNoise, dt_s: float | Array) -> Array:
    """Return the covariance (..., 3, 3) of the gyro bias' walk over intervals (...) s."""
    return np.asarray(dt_s)[..., None, None] * np.diag(noise.gyro_random_walk**2)


def twist_factor(step: TwistIncrement, k: int) -> gtsam.NonlinearFactor:
    """Return the factor from pose X(k - 1) and gyro bias B(k - 1) (3,) to pose X(k).

    The residual is the pose error in the tangent of the predicted end, ``log(predicted^-1 T_k)``; its change with
    another bias than the step's is first order, as in a preintegration.
    """
    predicted, d_step_d_bias, step_bias = gtsam.Pose3(step.T_start_end), step.d_step_d_bias, step.gyro_bias
    noise = gtsam.noiseModel.Gaussian.Covariance(step.cov)

    def residual(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        start, end, bias_key = this.keys()
        correction = gtsam.Pose3.Expmap(d_step_d_bias @ (values.atVector(bias_key) - step_bias))
        step_now = predicted.compose(correction)
        moved = values.atPose3(start).between(values.atPose3(end))
        error_pose = step_now.between(moved)
        error: Array = gtsam.Pose3.Logmap(error_pose)
        if jacobians is not None:
            d_error_d_end = gtsam.Pose3.LogmapDerivative(error)
            d_error_d_step = -d_error_d_end @ error_pose.inverse().AdjointMap()
            jacobians[0] = d_error_d_step @ step_now.inverse().AdjointMap()
            jacobians[1] = d_error_d_end
            jacobians[2] = d_error_d_step @ d_step_d_bias
        return error

    return gtsam.CustomFactor(noise, [X(k - 1), X(k), B(k - 1)], residual)


class TwistModel(MotionModel):
    """Pose and gyro bias, moved by a measured twist."""

    layout = TWIST_LAYOUT

    def __init__(self, noise: TwistNoise) -> None:
        self._noise = noise

    def integrate(self, motion: Motion, bias: Array) -> TwistIncrement:
        """Integrate the twists between two frames about a bias (6,), of which only the gyro's part is used."""
        assert isinstance(motion, TwistMotion)
        return integrate(motion, bias[..., 3:], self._noise)

    def predict_each(self, motions: list[Motion], starts: Belief) -> Prediction:
        """Predict S stacked states over an interval each, at once over those of equally many twists."""
        counts = np.array([motion.dt_s.size for motion in motions])
        order = np.argsort(counts, kind="stable")
        alike = np.split(order, np.flatnonzero(np.diff(counts[order])) + 1)
        parts = [
            self.integrate(_stacked([motions[k] for k in rows]), starts.bias[rows]).predict(starts[rows])
            for rows in alike
        ]
        return Prediction(*(np.concatenate(part)[np.argsort(order)] for part in zip(*parts, strict=True)))


def _stacked(motions: list[Motion]) -> TwistMotion:
    """Return intervals of equally many twists as one, with the axis of the intervals in front."""
    twists = [motion for motion in motions if isinstance(motion, TwistMotion)]
    each = [(motion.dt_s, motion.v_mps, motion.w_radps, noise_scale_of(motion)) for motion in twists]
    return TwistMotion(*(np.stack(part) for part in zip(*each, strict=True)))


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
        transition = _transition(T_start_end, se3_right_jacobian(xi), (v_body, v_body), self.dt_s)
        # A rotation error at the end also changes the velocity error, because the body's velocity is fixed in its axes.
        spread = np.zeros((12, 12))
        spread[POSE, POSE] = np.eye(6)
        spread[_VELOCITY, ROTATION] = -skew(v_body)
        spread[_VELOCITY, 9:12], spread[_TURN, 6:9] = np.eye(3), -np.eye(3)
        noise = spread @ twist_change_cov(self.noise, self.dt_s) @ spread.T
        return Prediction(T_world_imu, v_world, transition, 0.5 * (noise + noise.T))

    def transition_between(self, start: Belief, end: Prediction) -> Array:
        T_start_end = se3_inverse(start.T_world_imu) @ end.T_world_imu
        v_body = start.T_world_imu[:3, :3].T @ start.v_world, end.T_world_imu[:3, :3].T @ end.v_world
        return _transition(T_start_end, se3_right_jacobian(se3_log(T_start_end)), v_body, self.dt_s)

    def factors(self, k: int) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        graph.add(smooth_factor(self.dt_s, self.noise, k))
        return graph


def _transition(T_start_end: Array, d_end_d_xi: Array, v_body: tuple[Array, Array], dt_s: float) -> Array:
    """Return F (12, 12): an error of the start's pose, velocity (body) and turn rate, carried to the end.

    ``v_body`` are the velocities (3,) in the axes of the body at the start and at the end.
    """
    F = np.zeros((12, 12))
    F[POSE, POSE] = se3_adjoint(se3_inverse(T_start_end))
    # The velocity in the body frame depends on the velocity in the world and on the body's attitude.
    F[POSE, ROTATION] += dt_s * d_end_d_xi[:, 3:] @ skew(v_body[0])
    F[POSE, _VELOCITY] = dt_s * d_end_d_xi[:, 3:]
    F[POSE, _TURN] = -dt_s * d_end_d_xi[:, :3]
    F[_VELOCITY] = -skew(v_body[1]) @ F[ROTATION]
    F[_VELOCITY, ROTATION] += skew(v_body[0])
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


class SmoothTwist(MotionModel):
    """Pose, velocity and turn rate, moved by a twist that is constant but for noise."""

    layout = SMOOTH_LAYOUT

    def __init__(self, noise: TwistChangeNoise) -> None:
        self._noise = noise

    def integrate(self, motion: Motion, bias: Array) -> SmoothIncrement:
        """Return the interval between two frames; nothing was measured in it, and its bias (6,) is not used."""
        assert isinstance(motion, UnmeasuredMotion)
        return SmoothIncrement(float(motion.dt_s.sum()), self._noise)
