"""Dead reckoning is the measured motion composed, and its covariance the spread of what noise does to it."""

from dataclasses import replace

import gtsam
import numpy as np

from toolkit.geometry import se3_inverse, se3_log
from toolkit.measurements import TwistMotion
from toolkit.models import imu
from toolkit.simulation import DRIVE, FLIGHT, simulate


def test_twists_are_composed_by_the_exponential_map(run_estimator):
    sequence = simulate(DRIVE, 0)
    run = run_estimator("dead-reckoning", sequence)
    pose = gtsam.Pose3(sequence.prior.T_world_imu)
    for packet, estimated in zip(sequence.packets(), run.causal.T_world_imu, strict=True):
        if isinstance(packet.motion, TwistMotion):
            parts = zip(packet.motion.dt_s, packet.motion.w_radps, packet.motion.v_mps, strict=True)
            for dt_s, w, v in parts:
                pose = pose.compose(gtsam.Pose3.Expmap(dt_s * np.concatenate([w, v])))
        # 600 products of matrices with entries up to 300 m.
        np.testing.assert_allclose(estimated, pose.matrix(), atol=1e-9)


def test_imu_samples_are_integrated_as_gtsam_does(run_estimator):
    sequence = simulate(replace(FLIGHT, duration_s=10.0), 0)
    run, prior = run_estimator("dead-reckoning", sequence), sequence.prior
    params = imu.preintegration_params(sequence.noise, sequence.gravity_world)
    state, bias = gtsam.NavState(gtsam.Pose3(prior.T_world_imu), prior.v_world), gtsam.imuBias.ConstantBias()
    for packet, estimated in zip(sequence.packets(), run.causal.T_world_imu, strict=True):
        if packet.motion is not None:
            state = imu.preintegrate(packet.motion, np.zeros(6), params).predict(state, bias)
        np.testing.assert_allclose(estimated, state.pose().matrix(), atol=1e-9)


def test_covariance_is_the_spread_over_seeds(run_estimator):
    """NEES of the pose at the end of 4 s, whose covariance matters most: chi-square with 6 dof."""
    nees = []
    for seed in range(30):
        sequence = simulate(replace(DRIVE, duration_s=4.0), seed)
        last = run_estimator("dead-reckoning", sequence).causal
        error = se3_log(se3_inverse(last.T_world_imu[-1]) @ sequence.truth.T_world_imu[-1])
        nees.append(error @ np.linalg.solve(last.cov[-1][:6, :6], error))
    # The mean of 30 has a standard error of sqrt(12 / 30) = 0.63; four of them.
    assert abs(np.mean(nees) - 6.0) < 2.5
