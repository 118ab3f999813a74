"""The reference workload: what a machine is worth now, in the terms of what the estimators do all day.

Small dense updates in NumPy, a joint filter's matrix products, and preintegration and elimination in GTSAM. Its
processor time is measured beside every run; a run's time over it may be compared between machines and days.
"""

import time
from functools import cache

import gtsam
import numpy as np

from toolkit.geometry import Array

_UPDATES, _JOINT, _SAMPLES, _POSES = 30, 20, 1500, 100


def reference_s() -> float:
    """Return the seconds of processor time the reference workload takes now: some 20 ms on a core of 2023."""
    roots, jacobians, joint = _problem()
    began = time.process_time()
    _small_updates(roots, jacobians)
    _joint_updates(joint)
    _preintegrate()
    _eliminate()
    return time.process_time() - began


@cache
def _problem() -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(0)
    joint = rng.standard_normal((150, 150))
    return rng.standard_normal((64, 3, 3)), rng.standard_normal((64, 3, 6)), joint @ joint.T + 150.0 * np.eye(150)


def _small_updates(roots: Array, jacobians: Array) -> None:
    """Correct 64 landmarks and the pose they are seen from, as a decoupled filter does in a frame."""
    for _ in range(_UPDATES):
        covs = roots @ np.swapaxes(roots, 1, 2) + np.eye(3)
        weighted = np.swapaxes(jacobians, 1, 2) @ np.linalg.inv(covs)
        np.linalg.solve((weighted @ jacobians).sum(axis=0) + np.eye(6), np.ones(6))


def _joint_updates(joint: Array) -> None:
    """Correct a joint state of 150 by 30 measurements."""
    rows = joint[:30]
    for _ in range(_JOINT):
        gain = np.linalg.solve(rows[:, :30] + np.eye(30), rows)
        joint - rows.T @ gain


def _preintegrate() -> None:
    imu = gtsam.PreintegratedCombinedMeasurements(gtsam.PreintegrationCombinedParams.MakeSharedU(9.81))
    accel, gyro = np.array([0.1, 0.2, 9.8]), np.array([0.01, -0.02, 0.3])
    for _ in range(_SAMPLES):
        imu.integrateMeasurement(accel, gyro, 0.005)


def _eliminate() -> None:
    """Optimise a chain of poses with a loop every tenth."""
    noise, step = gtsam.noiseModel.Isotropic.Sigma(6, 0.1), gtsam.Pose3(gtsam.Rot3.Rz(0.1), np.array([1.0, 0.0, 0.0]))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), noise))
    pose = gtsam.Pose3()
    for k in range(_POSES):
        values.insert(k, pose)
        pose = pose.compose(step)
        for back in (1, 10):
            if k >= back:
                between = gtsam.Pose3()
                for _ in range(back):
                    between = between.compose(step)
                graph.add(gtsam.BetweenFactorPose3(k - back, k, between, noise))
    gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
