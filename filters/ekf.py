"""The report's decoupled EKF made sound: gates, landmark noise in the innovation, biases (Kang, III-C).

What it approximates: pose and landmarks are kept as if they were independent. A frame then costs a constant time per
landmark, but the filter is overconfident: its covariance does not grow with the distance driven.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from filters.kalman.landmark_map import (
    LandmarkMap,
    TrackedMap,
    correct_gated_landmarks,
    information_update,
    projected_cov,
    residuals_with_jacobians,
)
from filters.kalman.online_output import Filter, OnlineOutput
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import Array, BoolArray, transposed
from toolkit.measurements import Packet, StereoRig
from toolkit.models import stereo
from toolkit.models.gating import FrameGate, mahalanobis_squared
from toolkit.models.state import POSE, Belief

CITES = ("kang_vislam",)
RUNG, CHANGE = 20, "+ gate and loss, biases; pose before map, each with the other's uncertainty as noise"
DEFAULT = True
OPTIONS = {"landmark_uncertainty": (True, False)}
INGREDIENTS = ("landmark uncertainty", "biases", "long-lived landmarks")
WITHOUT = {"biases": {"noise.biases": "fixed"}, "landmark uncertainty": {"landmark_uncertainty": False}}


def build(setup: Setup) -> Estimator:
    known = setup.choice("landmark_uncertainty", {True: as_uncertain_as_stated, False: as_exact})
    return OnlineOutput(DecoupledEkf(setup, known))


class DecoupledEkf(Filter):
    """Predict, correct the pose by the known landmarks, correct the landmarks, start new ones, drop lost ones.

    ``known`` says as how uncertain the landmarks correct the pose.
    """

    def __init__(self, setup: Setup, known: Callable[[LandmarkMap], LandmarkMap]) -> None:
        self._rig, self._outliers, self._known = setup.rig, setup.settings.outliers, known
        self._motion = setup.motion
        self._belief = self._motion.initial_belief(setup.prior)
        self._map = TrackedMap(setup.rig)

    def step(self, packet: Packet) -> Estimate:
        if packet.motion is not None:
            increment = self._motion.integrate(packet.motion, self._belief.bias)
            self._belief = self._belief.predicted(increment.predict(self._belief))
        seen, uvs_px = self._map.seen_again(packet.frame)
        gate = FrameGate(self._outliers.gate_probability, self._outliers.filter_huber)
        if len(seen):
            self._belief, accepted = correct_pose(self._belief, self._known(seen), uvs_px, self._rig, gate)
            # By the corrected pose, as uncertain as it is then and as if it were independent of the landmarks; a gate
            # of their own decides.
            pose_cov = self._belief.cov[POSE, POSE]
            bound = np.where(accepted, gate.bound(stereo.degrees_of_freedom(uvs_px)), 0.0)
            seen = correct_gated_landmarks(seen, uvs_px, self._belief.T_world_imu, pose_cov, self._rig, bound)
        self._map.keep(seen, packet.frame, self._belief.T_world_imu)
        return self._belief.estimate(packet.frame.t_ns, **gate.info())

    def landmarks(self) -> Landmarks:
        return self._map.landmarks()


def as_uncertain_as_stated(landmarks: LandmarkMap) -> LandmarkMap:
    return landmarks


def as_exact(landmarks: LandmarkMap) -> LandmarkMap:
    """Return the landmarks as if they had no error, as the report's filter takes them (Kang, eqs. 11-14)."""
    return replace(landmarks, covs=np.zeros_like(landmarks.covs))


def correct_pose(
    belief: Belief, landmarks: LandmarkMap, uvs_px: Array, rig: StereoRig, gate: FrameGate
) -> tuple[Belief, BoolArray]:
    """Return the belief with its pose corrected by sightings (N, 3) px of N landmarks, and which of them passed (N,).

    The landmarks' uncertainty is part of the innovation covariance S, as if it were independent of the pose's. A
    sighting outside the gate is left out; the others are weighted by the robust loss of their residuals, whitened
    without the pose's own uncertainty, which over seeds is the more accurate. Gate and loss are by the stated noise,
    the update by the rig's weight of tracks.
    """
    residual_px, H_pose, H_point, depth_m = residuals_with_jacobians(landmarks, uvs_px, belief.T_world_imu, rig)
    noise_px2, dof = stereo.noise_px2(uvs_px, rig), stereo.degrees_of_freedom(uvs_px)
    landmark_px2 = H_point @ landmarks.covs @ transposed(H_point)

    S = projected_cov(H_pose, belief.cov[POSE, POSE]) + landmark_px2 + noise_px2
    accepted = gate.accepts(mahalanobis_squared(residual_px, S), dof, depth_m > 0.0)
    weights = gate.weights(mahalanobis_squared(residual_px, landmark_px2 + noise_px2), dof, accepted)

    # The gain of all sightings at once in information form: sums of 3x3 blocks (see landmark_map).
    weighted = weights[:, None, None] * np.linalg.solve(landmark_px2 + noise_px2 / rig.track_weight, H_pose)
    rows = weighted.reshape(-1, 6)
    return information_update(belief, rows.T @ H_pose.reshape(-1, 6), rows.T @ residual_px.reshape(-1)), accepted
