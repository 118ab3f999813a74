"""The IMU model: its transition and noise, that they are those of GTSAM's CombinedImuFactor.

An implicit function links the two: the factor's residual r(x_i, x_j) vanishes at our prediction, so the error it
carries from i to j is F = -(dr/dx_j)^-1 dr/dx_i and its noise, seen at j, is (dr/dx_j)^-1 cov (dr/dx_j)^-T. Its
velocity is perturbed in the world, ours in the body.
"""

import gtsam
import numpy as np

from toolkit.datasets import load_sequence
from toolkit.geometry import Array
from toolkit.initialization import start_from_measurements
from toolkit.models import imu
from toolkit.models.factors import B, V, X
from toolkit.models.state import Belief


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
    start = model.initial_belief(prior)
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
