"""Every motion model offers a filter and a graph the same state and the same motion."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from filters.kalman.joint import JointBelief
from tests.filters.conftest import assert_covariances_agree, gauge
from tests.models.conftest import numerical_jacobian
from toolkit.datasets import load_sequence
from toolkit.geometry import se3_exp
from toolkit.initialization import start_from_measurements
from toolkit.measurements import Packet, TwistChangeNoise
from toolkit.models.factors import joint_cov, ordering_of
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief, predicted
from toolkit.motion_samples import NoSamples
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, FLIGHT, simulate

each_motion = pytest.mark.parametrize("kind", ["twist", "imu", "none"])
K, UP = 7, np.eye(3)[:, 2:]
CHANGE_NOISE = TwistChangeNoise(np.array([1.0, 2.0, 3.0]), np.array([0.3, 0.5, 0.7]))


def recorded(kind: str) -> tuple[Sequence, Packet]:
    sequence = simulate(replace(FLIGHT if kind == "imu" else DRIVE, duration_s=2.0), 4)
    if kind == "none":
        sequence = replace(sequence, motion=NoSamples(sequence.frames_t_ns), noise=CHANGE_NOISE)
    return sequence, list(sequence.packets())[K]


def some_belief(sequence: Sequence, seed: int = 0) -> Belief:
    """Return a belief at an arbitrary attitude, whose errors are all correlated."""
    rng = np.random.default_rng(seed)
    model = motion_model(sequence.noise, sequence.gravity_world)
    first = model.initial_belief(sequence.prior)
    sigma, mixed = np.sqrt(np.diag(first.cov)), rng.standard_normal((model.layout.size, 2 * model.layout.size))
    cov = sigma[:, None] * (mixed @ mixed.T / mixed.shape[1]) * sigma
    bias = first.bias + np.r_[np.zeros(3), 0.01 * rng.standard_normal(3)]
    moved = replace(first, T_world_imu=se3_exp(rng.standard_normal(6)), bias=bias, cov=cov)
    if model.layout.velocity is None:
        return moved
    return replace(moved, v_world=rng.standard_normal(3))


@each_motion
def test_the_error_to_a_moved_belief_is_what_moved_it(kind):
    sequence, _ = recorded(kind)
    belief, rng = some_belief(sequence), np.random.default_rng(3)
    error = 0.3 * rng.standard_normal(len(belief.cov))
    np.testing.assert_allclose(belief.error_to(belief.moved(error, belief.cov)), error, rtol=0.0, atol=1e-14)


@each_motion
def test_a_held_state_has_the_covariance_it_is_held_with(kind):
    sequence, packet = recorded(kind)
    model, values = motion_model(sequence.noise, sequence.gravity_world), gtsam.Values()
    belief = some_belief(sequence)
    model.insert(values, belief.estimate(packet.frame.t_ns), K)
    cov = joint_cov(gtsam.Marginals(model.hold(belief, K), values), model.keys(K))
    sigma = np.sqrt(np.diag(belief.cov))
    in_estimate_order = model.estimate_cov(cov, belief.T_world_imu[:3, :3])
    # Two inversions of a matrix whose condition, scaled to unit variances, is below 1e3.
    assert np.abs((in_estimate_order - belief.cov) / np.outer(sigma, sigma)).max() < 1e-9


@each_motion
def test_filter_and_factors_agree_on_every_interval(kind):
    """Of kitti00 by GTSAM's CombinedImuFactor, and of two seconds by twists and without a measurement.

    An implicit function links the two: whitened residuals vanish at the prediction, so that of their Jacobians (A, B)
    by start and end -B^-1 A is the transition and B^-1 B^-T its noise.
    """
    sequence = load_sequence("kitti00") if kind == "imu" else recorded(kind)[0]
    prior = sequence.prior or start_from_measurements(sequence)
    model, compared = motion_model(sequence.noise, sequence.gravity_world), 0
    start = model.initial_belief(prior)
    for k, motion in ((packet.index, packet.motion) for packet in sequence.packets() if packet.motion is not None):
        increment, values = model.integrate(motion, prior.bias), gtsam.Values()
        step = increment.predict(start)
        end = start.predicted(step)
        by_state = []
        for at, state in ((k - 1, start), (k, end)):
            model.insert(values, state.estimate(0), at)
            by_state.append(np.eye(model.layout.size))
            if model.layout.velocity is not None:  # in the world for GTSAM
                by_state[-1][6:9, 6:9] = state.T_world_imu[:3, :3]
        keys = ordering_of([*model.keys(k - 1), *model.keys(k)])
        whole, residual = increment.factors(k).linearize(values).jacobian(keys)
        by_start, by_end = (part @ turned for part, turned in zip(np.hsplit(whole, 2), by_state, strict=True))
        root = np.linalg.inv(by_end)
        # 1e-9 is the promise of docs; positions up to the drive's extent of 300 m leave twelve digits.
        np.testing.assert_allclose(root @ residual, 0.0, atol=1e-9)
        np.testing.assert_allclose(-root @ by_start, step.transition, rtol=0.0, atol=1e-9)
        # Variances of rotation, velocity and bias differ by many orders: compare correlations.
        assert_covariances_agree(root @ root.T, step.noise, 1e-9)
        start, compared = end, compared + 1
    assert compared == sequence.frame_count - 1


def turning(sequence: Sequence) -> Belief:
    """Return a belief that turns fast about all axes where it is told by its biases."""
    return replace(some_belief(sequence), bias=np.r_[np.zeros(3), np.random.default_rng(8).standard_normal(3)])


@pytest.mark.parametrize("kind", ["twist", "none"])
@pytest.mark.parametrize("size", [0.0, 1e-4, 0.05, 0.5])
def test_a_factor_has_the_derivatives_of_its_residual_away_from_the_prediction(kind, size):
    """Of the factors that are not GTSAM's."""
    sequence, packet = recorded(kind)
    model, start = motion_model(sequence.noise, sequence.gravity_world), turning(sequence)
    end, values = predicted(start, model, packet.motion), gtsam.Values()
    end = end.moved(size * np.random.default_rng(5).standard_normal(len(end.cov)), end.cov)
    model.insert(values, start.estimate(0), K - 1)
    model.insert(values, end.estimate(0), K)
    factor = model.integrate(packet.motion, start.bias).factors(K).at(0)
    sizes = [values.extract([key]).dim() for key in factor.keys()]  # noqa: SIM118 - not a mapping

    def residual(step):
        delta = gtsam.VectorValues()
        for key, part in zip(factor.keys(), np.split(step, np.cumsum(sizes)[:-1]), strict=True):
            delta.insert(key, part)
        return factor.linearize(values.retract(delta)).jacobian()[1]

    derivatives, _ = factor.linearize(values).jacobian()
    # The residual is whitened: divided by sigmas down to 0.002.
    np.testing.assert_allclose(derivatives, -numerical_jacobian(residual, sum(sizes)), atol=1e-5)


def test_where_no_motion_is_measured_a_body_keeps_its_twist():
    sequence, packet = recorded("none")
    model, start = motion_model(sequence.noise, sequence.gravity_world), turning(sequence)
    end = predicted(predicted(start, model, packet.motion), model, packet.motion)
    v_body = start.T_world_imu[:3, :3].T @ start.v_world
    whole = se3_exp(2.0 * packet.motion.dt_s.sum() * np.concatenate([-start.bias[3:], v_body]))
    np.testing.assert_allclose(end.T_world_imu, start.T_world_imu @ whole, atol=1e-12)
    np.testing.assert_allclose(end.T_world_imu[:3, :3].T @ end.v_world, v_body, atol=1e-12)
    np.testing.assert_array_equal(end.bias, start.bias)


@each_motion
def test_the_transition_between_a_prediction_and_its_own_start_is_the_predictions(kind):
    sequence, packet = recorded(kind)
    model, belief = motion_model(sequence.noise, sequence.gravity_world), some_belief(sequence)
    increment = model.integrate(packet.motion, belief.bias)
    prediction = increment.predict(belief)
    # Both are exact derivatives at the same states; positions of metres leave rounding of 1e-15 each.
    np.testing.assert_allclose(increment.transition_between(belief, prediction), prediction.transition, atol=1e-12)


@pytest.mark.parametrize(("kind", "linear"), [("twist", "velocity_noise_density"), ("imu", "accel_noise_density")])
def test_noise_over_a_bridge_is_scaled_and_the_motion_is_not(kind, linear):
    """Factors of linear and angular noise (3, 2): the covariance is that of a noise stated so much larger."""
    sequence, packet = recorded(kind)
    start, noise = some_belief(sequence), sequence.noise
    scaled = {linear: 3.0 * getattr(noise, linear), "gyro_noise_density": 2.0 * noise.gyro_noise_density}
    bridged = replace(packet.motion, noise_scale=np.tile([3.0, 2.0], (packet.motion.dt_s.size, 1)))
    one, other = (
        motion_model(stated, sequence.gravity_world).integrate(motion, start.bias).predict(start)
        for stated, motion in ((noise, bridged), (replace(noise, **scaled), packet.motion))
    )
    np.testing.assert_allclose(one.noise, other.noise, rtol=1e-12)
    np.testing.assert_array_equal(one.T_world_imu, other.T_world_imu)


@each_motion
def test_states_predicted_at_once_are_those_predicted_one_by_one(kind):
    """Over intervals of one sample, of two and of three, in any order."""
    sequence, _ = recorded(kind)
    model, packets = motion_model(sequence.noise, sequence.gravity_world), list(sequence.packets())[1:7]
    whole = [replace(packet.motion, **_first(packet.motion, 1 + k % 3)) for k, packet in enumerate(packets)]
    starts = [some_belief(sequence, seed) for seed in range(len(whole))]
    stacked = Belief(model.layout, *(np.stack([getattr(s, name) for s in starts]) for name in _ARRAYS))
    together = stacked.predicted(model.predict_each(whole, stacked))
    for k, (motion, start) in enumerate(zip(whole, starts, strict=True)):
        alone = predicted(start, model, motion)
        np.testing.assert_allclose(alone.error_to(together[k]), 0.0, atol=1e-14)
        np.testing.assert_allclose(together[k].cov, alone.cov, rtol=1e-12, atol=1e-15)


_ARRAYS = "T_world_imu", "v_world", "bias", "cov"


def _first(motion, count):
    """Return the first samples of a motion by the names of its arrays, repeated where it has fewer."""
    names = [name for name, value in vars(motion).items() if value is not None]
    return {name: np.resize(getattr(motion, name), (count, *getattr(motion, name).shape[1:])) for name in names}


@each_motion
def test_a_turn_and_a_shift_of_the_world_pass_through_first_estimates(kind):
    """Between any two states the transition takes the gauge's error at one to the gauge's error at the other."""
    sequence, packet = recorded(kind)
    model, belief = motion_model(sequence.noise, sequence.gravity_world), some_belief(sequence)
    increment = model.integrate(packet.motion, belief.bias)
    end = increment.predict(belief)
    start = some_belief(sequence, seed=1)
    F = increment.transition_between(start, end)
    there = replace(start, T_world_imu=end.T_world_imu, v_world=end.v_world)
    np.testing.assert_allclose(F @ gauge(JointBelief(start), UP), gauge(JointBelief(there), UP), atol=1e-9)
