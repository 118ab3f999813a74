"""Joint EKF of the pose and the landmarks in view, all cross-covariances kept (Smith, Self & Cheeseman 1990).

What it approximates: past poses and landmarks out of view are marginalised at once, so the cost is bounded by the
number of landmarks in view, and nothing is ever relinearised (Bailey et al. 2006). `riekf` and `iekf` are this filter
with other errors and another update.

First-estimate Jacobians: in world coordinates a standard joint EKF evaluates the Jacobians of one landmark at estimates
that change from frame to frame. Together these Jacobians reduce the variance of the heading, which no measurement
observes. Here every Jacobian is evaluated at first estimates, with which global position and heading stay exactly
unobservable (Huang, Mourikis & Roumeliotis 2010).

A landmark's first estimate comes from one stereo sighting, and may be poor. With an IMU, a landmark that has moved from
its first estimate by more than a share of its distance is therefore started again from its next sighting; what its
earlier sightings contributed to the other states is kept (docs/estimators.md). With odometry, which measures how much
nearer landmarks come, restarting costs more than the old Jacobians do. What remains approximate: an update is one
Gauss-Newton step with Jacobians at first estimates.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from filters.kalman.coordinates import InverseDepthBelief
from filters.kalman.joint import (
    AtFirstEstimates,
    JointBelief,
    Linearisation,
    correct_by_landmarks,
    linearisation,
    marginalise,
    marginalise_lost,
    propagate,
)
from filters.kalman.online_output import LandmarkMemory, OnlineOutput
from toolkit.arrays import is_among
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Estimator, Setup
from toolkit.measurements import Packet, StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DEPTH_M, LEAST_DISPARITY_PX, FrameGate
from toolkit.models.state import Belief
from toolkit.settings import Scalar

CITES = ("smith1990estimating", "huang2010observability")
RUNG, CHANGE = 30, "+ cross-covariances, first-estimate Jacobians, inverse depth"
OPTIONS = {"linearisation": ("first", "latest"), "landmarks": ("inverse depth", "metres")}
INGREDIENTS = (
    "landmark uncertainty",
    "biases",
    "cross-covariances",
    "consistent linearisation",
    "inverse depth",
    "long-lived landmarks",
)
WITHOUT = {
    "biases": {"noise.biases": "fixed"},
    "consistent linearisation": {"linearisation": "latest"},
    "inverse depth": {"landmarks": "metres"},
}

# With an IMU a landmark may have moved from its first estimate by this share of its distance before it is restarted.
MOST_MOVED = 0.3


def build(setup: Setup) -> Estimator:
    return OnlineOutput(joint_ekf(setup))


def joint_ekf(setup: Setup) -> "JointEkf":
    first = AtFirstEstimates(MOST_MOVED) if setup.motion_kind == "imu" else AtFirstEstimates()
    at = linearisation(setup, first)
    in_inverse_depth = partial(InverseDepthBelief, T_imu_cam=setup.rig.T_imu_cam, at=at)
    beliefs: dict[Scalar, Callable[[Belief], JointBelief]] = {"inverse depth": in_inverse_depth, "metres": JointBelief}
    return JointEkf(setup, at, setup.choice("landmarks", beliefs))


# Corrects a joint belief by the landmarks of its state; the frame must show all of them, and the gate counts tests.
Correct = Callable[[JointBelief, StereoFrame, Linearisation, StereoRig, FrameGate], None]


class JointEkf:
    """Propagate, drop lost or outdated landmarks, correct pose and landmarks together, start new landmarks.

    ``belief`` decides what a correction does to estimates and covariance, ``correct`` how a correction is computed.
    """

    def __init__(
        self,
        setup: Setup,
        linearisation: Linearisation,
        belief: Callable[[Belief], JointBelief] = JointBelief,
        correct: Correct = correct_by_landmarks,
    ) -> None:
        self._rig, self._at, self._correct = setup.rig, linearisation, correct
        self._outliers = setup.settings.outliers
        self._motion = setup.motion
        self.joint = belief(self._motion.initial_belief(setup.prior))
        self._memory = LandmarkMemory()

    def step(self, packet: Packet) -> Estimate:
        propagate(self.joint, self._motion, self._at, packet.motion)
        self.joint.clone()
        gate = FrameGate(self._outliers.gate_probability, self._outliers.joint_huber, self._rig.track_weight)
        marginalise_lost(self.joint, packet.frame, self._memory)
        marginalise(self.joint, self._at.outdated(self.joint), self._memory)
        self._correct(self.joint, packet.frame, self._at, self._rig, gate)
        self._start_new(packet.frame)
        self.joint.marginalise_clones(1)
        return self.joint.core.estimate(packet.frame.t_ns, **gate.info())

    def landmarks(self) -> Landmarks:
        self._memory.remember(self.joint.landmark_ids, self.joint.points)
        return self._memory.landmarks()

    def _start_new(self, frame: StereoFrame) -> None:
        """Start landmarks for the frame's tracks that are not in the state, by the stereo point of this one view."""
        joint, rig = self.joint, self._rig
        new = frame.select(~is_among(frame.track_ids, joint.landmark_ids))
        near = stereo.disparity_px(new.uvs_px) > LEAST_DISPARITY_PX
        new = new.select(near & (rig.fx_px * rig.baseline_m > LEAST_DEPTH_M * stereo.disparity_px(new.uvs_px)))
        if len(new.track_ids):
            points = stereo.triangulate_world(new.uvs_px, joint.clones[-1], rig)
            there = stereo.predict(points, self._at.clones(joint)[-1], rig)
            d_point_d_uv = np.linalg.inv(there.d_uv_d_point)
            by_pose = -d_point_d_uv @ there.d_uv_d_pose
            covs = d_point_d_uv @ (rig.cov_uv_px2 / rig.track_weight) @ np.swapaxes(d_point_d_uv, 1, 2)
            joint.add_landmarks(new.track_ids, points, by_pose.reshape(-1, 6), covs)
