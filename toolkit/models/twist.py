"""Motion by a measured body twist, with a gyro bias (Kang, eqs. 1-2): its integration, its factors, its model.

The pose moves by T <- T exp(dt [w - b, v]); everything is in GTSAM's order [rotation, position] and perturbed
on the right. The state is pose and gyro bias; the velocity is measured, not estimated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np

from toolkit.estimate import Estimate
from toolkit.geometry import Array, se3_adjoint, se3_exp_and_right_jacobian, se3_inverse
from toolkit.measurements import Motion, Prior, TwistMotion, TwistNoise
from toolkit.models.factors import B, X, joint_prior, latest_values
from toolkit.models.state import POSE, TWIST_LAYOUT, Belief, Prediction


class TwistStep(NamedTuple):
    """The relative motion of one interval and its first-order error.

    ``T_start_end`` (4, 4); ``d_step_d_bias`` (6, 3), the Jacobian of the step's end (right perturbation) to the gyro
    bias; ``cov`` (6, 6), the covariance of the step in the tangent of its end, from the noise of the twist alone;
    ``dt_s``, the interval's length.
    """

    T_start_end: Array
    d_step_d_bias: Array
    cov: Array
    dt_s: float


def integrate(motion: TwistMotion, gyro_bias: Array, noise: TwistNoise) -> TwistStep:
    """Integrate the twists of one interval with a gyro bias (3,) rad/s subtracted."""
    pieces = _pieces(motion.dt_s, motion.w_radps - gyro_bias, motion.v_mps, _density_squared(motion, noise))
    return _joined(pieces, float(motion.dt_s.sum()))


def integrate_each(motions: Sequence[TwistMotion], gyro_biases: Array, noise: TwistNoise) -> list[TwistStep]:
    """Integrate the twists of N intervals, each with its own gyro bias (N, 3) rad/s subtracted."""
    pieces = _pieces(
        np.concatenate([motion.dt_s for motion in motions]),
        np.concatenate([motion.w_radps - bias for motion, bias in zip(motions, gyro_biases, strict=True)]),
        np.concatenate([motion.v_mps for motion in motions]),
        np.concatenate([np.broadcast_to(_density_squared(m, noise), (*m.v_mps.shape[:1], 6)) for m in motions]),
    )
    ends = np.cumsum([motion.dt_s.size for motion in motions]).tolist()
    return [
        _joined(_Pieces(*(part[start:end] for part in pieces)), float(motion.dt_s.sum()))
        for motion, start, end in zip(motions, [0, *ends[:-1]], ends, strict=True)
    ]


class _Pieces(NamedTuple):
    """The part of a step by each twist: motions (n, 4, 4), derivatives (n, 6, 3) and covariances (n, 6, 6)."""

    motions: Array
    biases: Array
    covs: Array


def _pieces(dt_s: Array, w_radps: Array, v_mps: Array, density_squared: Array) -> _Pieces:
    """Integrate n twists, each by itself, with squared noise densities (n, 6) or (6,) of turn rate and velocity."""
    dt_s = dt_s[:, None]
    motions, d_end_d_xi = se3_exp_and_right_jacobian(dt_s * np.concatenate([w_radps, v_mps], axis=1))
    covs = (d_end_d_xi * (dt_s * density_squared)[:, None]) @ np.swapaxes(d_end_d_xi, 1, 2)
    return _Pieces(motions, -dt_s[..., None] * d_end_d_xi[:, :, :3], covs)


def _density_squared(motion: TwistMotion, noise: TwistNoise) -> Array:
    """Return the squared noise densities of turn rate and velocity: of each twist (n, 6), or common to all (6,)."""
    density_squared = np.concatenate([noise.gyro_noise_density**2, noise.velocity_noise_density**2])
    if motion.noise_scale is None:
        return density_squared
    return np.asarray(density_squared * np.repeat(motion.noise_scale[:, ::-1] ** 2, 3, axis=1))


def _joined(pieces: _Pieces, dt_s: float) -> TwistStep:
    """Return the step composed of consecutive pieces."""
    T_start_end, d_step_d_bias, cov = (part[0] for part in pieces)
    for piece, own_bias, own_cov in zip(*(part[1:] for part in pieces), strict=True):
        carry = se3_adjoint(se3_inverse(piece))
        T_start_end = T_start_end @ piece
        d_step_d_bias = carry @ d_step_d_bias + own_bias
        cov = carry @ cov @ carry.T + own_cov
    return TwistStep(T_start_end, d_step_d_bias, cov, dt_s)


def bias_walk_cov(noise: TwistNoise, dt_s: float) -> Array:
    """Return the covariance (3, 3) of the gyro bias' walk over an interval."""
    return np.diag(noise.gyro_random_walk**2 * dt_s)


def twist_factor(step: TwistStep, step_bias: Array, k: int) -> gtsam.NonlinearFactor:
    """Return the factor from pose X(k - 1) and gyro bias B(k - 1) (3,) to pose X(k).

    The residual is the pose error in the tangent of the predicted end, ``log(predicted^-1 T_k)``. ``step``
    was integrated with the bias ``step_bias`` (3,); the change with another bias is first order, as in a
    preintegration.
    """
    predicted, d_step_d_bias = gtsam.Pose3(step.T_start_end), step.d_step_d_bias
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


def gyro_bias_walk_factor(noise: TwistNoise, dt_s: float, k: int) -> gtsam.NonlinearFactor:
    """Return the random walk of the gyro bias from B(k - 1) to B(k), both (3,)."""
    covariance = gtsam.noiseModel.Gaussian.Covariance(bias_walk_cov(noise, dt_s))
    return gtsam.BetweenFactorVector(B(k - 1), B(k), np.zeros(3), covariance)


@dataclass(frozen=True, eq=False)
class TwistIncrement:
    """The step between two frames and the gyro bias (3,) it was integrated about."""

    step: TwistStep
    gyro_bias: Array
    noise: TwistNoise

    def predict(self, start: Belief) -> Prediction:
        """Predict a state over the interval."""
        size, gyro_bias = TWIST_LAYOUT.size, TWIST_LAYOUT.gyro_bias
        transition, noise = np.eye(size), np.zeros((size, size))
        transition[POSE, POSE] = se3_adjoint(se3_inverse(self.step.T_start_end))
        transition[POSE, gyro_bias] = self.step.d_step_d_bias
        noise[POSE, POSE] = self.step.cov
        noise[gyro_bias, gyro_bias] = bias_walk_cov(self.noise, self.step.dt_s)
        return Prediction(start.T_world_imu @ self.step.T_start_end, start.v_world, transition, noise)

    def transition_between(self, start: Belief, end: Prediction) -> Array:
        """Return the transition (9, 9) from the mean of ``start`` to that of ``end``."""
        transition = end.transition.copy()
        transition[POSE, POSE] = se3_adjoint(se3_inverse(end.T_world_imu) @ start.T_world_imu)
        return transition

    def factors(self, k: int) -> gtsam.NonlinearFactorGraph:
        """Return the factors between the poses and the random walk of the gyro bias."""
        graph = gtsam.NonlinearFactorGraph()
        graph.add(twist_factor(self.step, self.gyro_bias, k))
        graph.add(gyro_bias_walk_factor(self.noise, self.step.dt_s, k))
        return graph


class TwistModel:
    """Pose and gyro bias, moved by a measured twist."""

    layout = TWIST_LAYOUT
    variable_sizes: Mapping[str, int] = {"x": 6, "b": 3}

    def __init__(self, noise: TwistNoise) -> None:
        self._noise = noise

    def initial_belief(self, prior: Prior) -> Belief:
        """Return the belief at the first frame: pose and gyro bias of the prior."""
        return Belief.of_prior(prior, self.layout)

    def integrate(self, motion: Motion, bias: Array) -> TwistIncrement:
        """Integrate the twists between two frames about a bias (6,), of which only the gyro's part is used."""
        assert isinstance(motion, TwistMotion)
        return TwistIncrement(integrate(motion, bias[3:], self._noise), bias[3:], self._noise)

    def integrate_each(self, motions: Sequence[Motion], biases: Sequence[Array]) -> list[TwistIncrement]:
        """Integrate the twists of some intervals, each about its own bias (6,), vectorised."""
        twists = [motion for motion in motions if isinstance(motion, TwistMotion)]
        steps = integrate_each(twists, np.array(biases)[:, 3:], self._noise)
        return [TwistIncrement(step, bias[3:], self._noise) for step, bias in zip(steps, biases, strict=True)]

    def latest(self, tree: gtsam.ISAM2, keys: list[int]) -> gtsam.Values:
        """Return the latest values of some variables of a tree."""
        return latest_values(tree, keys, tree.calculateEstimateVector)

    def insert(self, values: gtsam.Values, estimate: Estimate, k: int) -> None:
        """Add state k at an estimate."""
        assert estimate.bias is not None
        values.insert(X(k), gtsam.Pose3(estimate.T_world_imu))
        values.insert(B(k), estimate.bias[3:])

    def read(self, values: gtsam.Values, k: int, t_ns: int) -> Estimate:
        """Return state k; its accelerometer bias is zero."""
        bias = np.concatenate([np.zeros(3), values.atVector(B(k))])
        return Estimate(t_ns, values.atPose3(X(k)).matrix(), bias=bias)

    def hold(self, belief: Belief, k: int) -> gtsam.NonlinearFactorGraph:
        """Return the prior on state k at a belief."""
        at = gtsam.Values()
        at.insert(X(k), gtsam.Pose3(belief.T_world_imu))
        at.insert(B(k), belief.bias[3:])
        return joint_prior(at, {X(k): POSE, B(k): self.layout.gyro_bias}, belief.cov)

    def estimate_cov(self, cov: Array, R_world_imu: Array) -> Array:
        """Return the covariance (9, 9), made exactly symmetric: GTSAM's errors are those of an Estimate here."""
        return np.asarray(0.5 * (cov + cov.T))
