"""The IMU model: its transition and noise, that they are those of GTSAM's CombinedImuFactor, and its order.

An implicit function links the two: the factor's residual r(x_i, x_j) vanishes at our prediction, so the error it
carries from i to j is F = -(dr/dx_j)^-1 dr/dx_i and its noise, seen at j, is (dr/dx_j)^-1 cov (dr/dx_j)^-T. Its
velocity is perturbed in the world, ours in the body.
"""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from toolkit.datasets import load_sequence
from toolkit.geometry import Array
from toolkit.initialization import start_from_measurements
from toolkit.measurements import GRAVITY_WORLD, ImuMotion
from toolkit.models import imu
from toolkit.models.factors import B, V, X
from toolkit.models.state import IMU_LAYOUT, Belief
from toolkit.simulation import FLIGHT, noise_free, simulate

MODEL = imu.ImuModel(FLIGHT.motion.noise, np.array(GRAVITY_WORLD))
BIAS = np.array([0.05, -0.08, 0.03, 0.004, -0.006, 0.002])


def at(T_world_imu: Array, v_world: Array, bias: Array) -> Belief:
    """Return a state."""
    return Belief(IMU_LAYOUT, T_world_imu, v_world, bias, np.eye(15))


@pytest.fixture
def motion() -> ImuMotion:
    """A tenth of a second of lively motion in twenty uneven steps."""
    rng = np.random.default_rng(1)
    accel = np.array([0.5, -0.7, 9.6]) + rng.standard_normal((20, 3))
    gyro = np.array([0.4, -0.9, 0.7]) + 0.3 * rng.standard_normal((20, 3))
    return ImuMotion(rng.uniform(0.003, 0.007, 20), accel, gyro)


def test_noise_over_a_bridge_is_scaled_and_the_motion_is_not(motion: ImuMotion) -> None:
    noise = FLIGHT.motion.noise
    bridged = MODEL.integrate(replace(motion, noise_scale=np.tile([3.0, 2.0], (20, 1))), BIAS).preintegration
    larger = replace(
        noise, accel_noise_density=3.0 * noise.accel_noise_density, gyro_noise_density=2.0 * noise.gyro_noise_density
    )
    expected = imu.preintegrate(motion, BIAS, imu.preintegration_params(larger, np.array(GRAVITY_WORLD)))
    np.testing.assert_allclose(bridged.preintMeasCov(), expected.preintMeasCov(), rtol=1e-12)
    np.testing.assert_array_equal(bridged.deltaPij(), expected.deltaPij())


def predicted(motion: ImuMotion, start: Belief) -> Belief:
    """Return a state predicted over a motion that is preintegrated about its own bias."""
    return start.predicted(MODEL.integrate(motion, start.bias).predict(start))


def factor_in_filter_terms(factor: gtsam.NonlinearFactor, start: Belief, end: Belief, k: int) -> tuple[Array, ...]:
    """Return the factor's residual (15,) between two states and the transition and noise (15, 15) it implies."""
    values = gtsam.Values()
    for index, state in ((k - 1, start), (k, end)):
        values.insert(X(index), gtsam.Pose3(state.T_world_imu))
        values.insert(V(index), state.v_world)
        values.insert(B(index), gtsam.imuBias.ConstantBias(state.bias[:3], state.bias[3:]))
    whitened, _ = factor.linearize(values).jacobian()
    jacobian = np.linalg.solve(factor.noiseModel().R(), whitened)
    poses, velocities, biases = (jacobian[:, i : i + w] for i, w in ((0, 6), (6, 3), (18, 6)))
    d_start = np.hstack([poses, velocities @ start.T_world_imu[:3, :3], biases])
    poses, velocities, biases = (jacobian[:, i : i + w] for i, w in ((9, 6), (15, 3), (24, 6)))
    d_end = np.hstack([poses, velocities @ end.T_world_imu[:3, :3], biases])
    assert list(factor.keys()) == [X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k)]
    noise_at_end = np.linalg.solve(d_end, np.linalg.solve(d_end, factor.noiseModel().covariance()).T)
    return factor.unwhitenedError(values), -np.linalg.solve(d_end, d_start), noise_at_end


def test_filter_equals_gtsams_factor_on_every_interval_of_kitti00():
    sequence = load_sequence("kitti00")
    prior = start_from_measurements(sequence)
    model, compared = imu.ImuModel(sequence.noise, sequence.gravity_world), 0
    start = at(prior.T_world_imu, prior.v_world, prior.bias)
    for packet in sequence.packets():
        if packet.motion is None:
            continue
        increment = model.integrate(packet.motion, prior.bias)
        step = increment.predict(start)
        end, factor = start.predicted(step), increment.factors(packet.index).at(0)
        residual, transition, noise = factor_in_filter_terms(factor, start, end, packet.index)
        # 1e-9 is the promise of docs; double precision gives 1e-14 on entries of the order of 1.
        np.testing.assert_allclose(residual, 0.0, atol=1e-9)
        np.testing.assert_allclose(step.transition, transition, rtol=0.0, atol=1e-9)
        # Variances of rotation, velocity and bias differ by many orders: compare correlations.
        sigma = np.sqrt(np.diag(noise))
        np.testing.assert_allclose(step.noise / np.outer(sigma, sigma), noise / np.outer(sigma, sigma), atol=1e-9)
        start, compared = end, compared + 1
    assert compared == sequence.frame_count - 1


def drift_m(rate_hz: float) -> float:
    """Return where 5 s of exact IMU samples of the flight lead, integrated at once, against the truth."""
    scenario = noise_free(replace(FLIGHT, duration_s=5.0))
    sequence = simulate(replace(scenario, motion=replace(scenario.motion, rate_hz=rate_hz)), 0)
    state = at(sequence.prior.T_world_imu, sequence.prior.v_world, np.zeros(6))
    for packet in sequence.packets():
        if packet.motion is not None:
            state = predicted(packet.motion, state)
    return float(np.linalg.norm(state.T_world_imu[:3, 3] - sequence.truth.T_world_imu[-1, :3, 3]))


def test_integration_is_of_second_order():
    """Halving the sample interval divides the error by four; a first-order rule divides it by two."""
    coarse, fine = drift_m(100.0), drift_m(200.0)
    assert coarse / fine == pytest.approx(4.0, rel=0.1)  # what is left is of the next even order
    assert fine < 1e-3
