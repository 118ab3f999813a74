"""EKF-SLAM: the pose and every landmark in view in one Gaussian, all cross-covariances kept.

What it approximates: past poses and landmarks out of view are marginalised at once, so the cost is bounded by the
number of landmarks in view, and nothing is ever relinearised (Smith, Self & Cheeseman 1990; Bailey et al. 2006).
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from filters.kalman import joint_landmarks
from filters.kalman.frame_gate import FrameGate
from filters.kalman.joint import JointBelief
from filters.kalman.linearisation import Linearisation, propagate
from filters.kalman.online_output import LandmarkMemory
from filters.kalman.tracks import TrackSightings
from toolkit.arrays import is_among
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Setup
from toolkit.measurements import Packet, StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DEPTH_M, LEAST_DISPARITY_PX
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief


class Correct(Protocol):
    """Corrects a joint belief by the landmarks of its state; the frame must show every one of them."""

    def __call__(
        self, joint: JointBelief, frame: StereoFrame, at: Linearisation, rig: StereoRig, gate: FrameGate, /
    ) -> None:
        """Correct the belief; the gate counts the tests."""


class JointEkf:
    """Propagate, drop lost or outdated landmarks, correct pose and landmarks together, start new landmarks.

    ``belief`` decides what a correction does to estimates and covariance, ``correct`` how a correction is computed.
    """

    def __init__(
        self,
        setup: Setup,
        linearisation: Linearisation,
        belief: Callable[[Belief], JointBelief] = JointBelief,
        correct: Correct = joint_landmarks.correct,
    ) -> None:
        self._rig, self._at, self._correct = setup.rig, linearisation, correct
        self._outliers = setup.settings.outliers
        self._motion = motion_model(setup.noise, setup.gravity_world)
        self._joint = belief(self._motion.initial_belief(setup.prior))
        self._memory = LandmarkMemory()

    @property
    def joint(self) -> JointBelief:
        """Return the present joint belief."""
        return self._joint

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and return the state at its frame."""
        propagate(self._joint, self._motion, self._at, packet.motion)
        self._joint.clone()
        gate = FrameGate(self._outliers.gate_probability, self._outliers.joint_huber, self._rig.track_weight)
        joint_landmarks.forget_lost(self._joint, packet.frame, self._memory)
        joint_landmarks.forget(self._joint, self._at.outdated(self._joint), self._memory)
        self._correct(self._joint, packet.frame, self._at, self._rig, gate)
        self._start_new(packet.frame)
        self._joint.forget_clones(np.ones(1, dtype=bool))
        return self._joint.core.estimate(packet.frame.t_ns, **gate.info())

    def landmarks(self) -> Landmarks:
        """Return the last estimate of every landmark of the run."""
        self._memory.remember(self._joint.landmark_ids, self._joint.points)
        return self._memory.landmarks()

    def _start_new(self, frame: StereoFrame) -> None:
        """Start landmarks for the frame's tracks that are not in the state, by the stereo point of this one view."""
        joint, rig = self._joint, self._rig
        new = frame.select(~is_among(frame.track_ids, joint.landmark_ids))
        near = stereo.disparity_px(new.uvs_px) > LEAST_DISPARITY_PX
        new = new.select(near & (rig.fx_px * rig.baseline_m > LEAST_DEPTH_M * stereo.disparity_px(new.uvs_px)))
        if len(new.track_ids):
            points = stereo.triangulate_world(new.uvs_px, joint.clones[-1], rig)
            sightings = TrackSightings(new.track_ids, new.uvs_px[:, None], np.ones((len(points), 1), dtype=bool))
            linearised = joint_landmarks.linearise(sightings, points, joint.clones, self._at.clones(joint), rig)
            weighted = linearised.scaled(np.full(len(points), np.sqrt(rig.track_weight)))
            joint_landmarks.add_tracks(joint, new.track_ids, points, weighted)
