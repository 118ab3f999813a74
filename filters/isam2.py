"""Incremental full smoother: every state and landmark kept, re-solved only where news reaches (iSAM2, GTSAM).

What it approximates: a variable is relinearised once it has moved by a threshold, not at every iteration, and each
frame makes one Gauss-Newton step (Kaess et al. 2012, "iSAM2: Incremental smoothing and mapping using the Bayes tree").
Its causal answer is the newest state, its final answer the latest value of every state. A landmark that falls behind
the camera, or makes the system indeterminate, is dropped and the log says so.
"""

from dataclasses import replace

import gtsam
import numpy as np

from filters.smoothing.covariance_recovery import with_covariances
from filters.smoothing.graph_builder import Grown, Growth
from filters.smoothing.incremental import IncrementalTree
from filters.smoothing.marginals import state_cov
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import Array, se3_inverse, transform
from toolkit.models.factors import L
from toolkit.sequence import Packet

RUNG, CHANGE = 110, "+ every state and landmark kept"


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return Isam2(setup)


class Isam2:
    """Adds a packet to the tree and reads the newest state; reads all of them in the end."""

    def __init__(self, setup: Setup) -> None:
        self._rig = setup.rig
        self._growth = Growth(setup)
        self._tree = IncrementalTree(6 if setup.motion_kind == "imu" else 3, setup.rig.baseline_m)
        self._stamps_ns: list[int] = []
        self._log: list[str] = []

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and say where the IMU is."""
        grown = self._growth.by(packet)
        self._stamps_ns.append(packet.frame.t_ns)
        self._note(packet, self._tree.add(grown.factors, grown.values, grown.state_keys))
        estimate = self._newest(grown, packet)
        seen = [i for i in grown.landmark_ids if self._tree.has(L(i))]
        points = self._tree.points(map(L, seen))
        self._growth.solved(estimate, dict(zip(seen, points, strict=True)))
        self._drop_landmarks_behind(seen, points, estimate, packet)
        return estimate

    def finish(self) -> Finished:
        """Return every state and landmark as last known."""
        self._log += [f"in the end: {line}" for line in self._tree.settle()]
        values, motion = self._tree.isam.calculateBestEstimate(), self._growth.motion
        states = [motion.read(values, k, t_ns) for k, t_ns in enumerate(self._stamps_ns)]
        points = {gtsam.Symbol(key).index(): values.atPoint3(key) for key in self._tree.landmarks()}
        linear = self._tree.isam.getFactorsUnsafe().linearize(values)
        keys = [motion.keys(k) for k in range(len(states))]
        trajectory, log = with_covariances(Trajectory.of(states), linear, self._tree.landmarks(), keys)
        return Finished(trajectory, Landmarks.of(points), log=(*self._log, *log))

    def _newest(self, grown: Grown, packet: Packet) -> Estimate:
        values = self._tree.read(grown.state_keys)
        estimate = self._growth.motion.read(values, packet.index, packet.frame.t_ns)
        cov = state_cov(self._tree.isam, self._growth.motion.keys(packet.index), estimate.T_world_imu[:3, :3])
        return replace(estimate, cov=cov)

    def _drop_landmarks_behind(self, seen: list[int], points: Array, estimate: Estimate, packet: Packet) -> None:
        """Drop what is no longer in front of the camera that sees it: its sightings would say nothing at all."""
        T_cam_world = se3_inverse(estimate.T_world_imu @ self._rig.T_imu_cam)
        depths_m = transform(T_cam_world, points)[:, 2]
        behind = [seen[row] for row in np.flatnonzero(depths_m <= 0.0)]
        if behind:
            self._growth.forget(set(behind))
            log = [f"landmark {i} fell behind the camera and was dropped" for i in behind]
            self._note(packet, log + self._tree.drop(map(L, behind)))

    def _note(self, packet: Packet, lines: list[str]) -> None:
        self._log += [f"frame {packet.index}: {line}" for line in lines]
