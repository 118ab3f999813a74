"""The report's visual-inertial EKF to the letter, so that anyone can see what it does (Kang, III-C, eqs. 1-14).

It corrects the map from the predicted pose and then corrects the pose by that map, taken as exact, with the same
measurements. It has no gate, and the innovation covariance leaves out the landmarks' uncertainty. The pose covariance
therefore collapses, after which one mismatched sighting moves the pose. The report's measurement has four rows; here vL
and vR are replaced by their mean with half the variance, which gives the same update.
"""

from dataclasses import replace

import numpy as np

from filters.kalman.landmark_map import (
    LandmarkMap,
    TrackedMap,
    correct_landmarks,
    information_update,
    residuals_with_jacobians,
)
from filters.kalman.online_output import Filter, OnlineOutput
from toolkit.estimate import Estimate, Landmarks
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import Array
from toolkit.measurements import Packet
from toolkit.models import stereo
from toolkit.models.state import Belief, predicted

# Used instead of zero, which has no inverse: a bias of 1e-8 rad/s turns the pose by 1e-6 rad in 100 s.
_FIXED_VARIANCE = 1e-16

CITES = ("kang_vislam",)
RUNG, CHANGE = 10, "+ vision as in the report: map and pose updated in turn, biases fixed, no gate"
RULES = {"outliers": "the report's filter has neither gate nor loss"}
INGREDIENTS = ("long-lived landmarks",)


def build(setup: Setup) -> Estimator:
    return OnlineOutput(SeedEkf(setup))


class SeedEkf(Filter):
    """Equations 1 to 14 in the order of the report."""

    def __init__(self, setup: Setup) -> None:
        self._rig = setup.rig
        self._motion = setup.motion
        self._belief = _without_biases(self._motion.initial_belief(setup.prior))
        self._map = TrackedMap(setup.rig)

    def step(self, packet: Packet) -> Estimate:
        """Predict (1-2), map (3-10), correct the pose (11-14)."""
        self._belief = _without_biases(predicted(self._belief, self._motion, packet.motion))
        seen, uvs_px = self._map.seen_again(packet.frame)
        if len(seen):
            seen, *_ = correct_landmarks(seen, uvs_px, self._belief.T_world_imu, np.zeros((6, 6)), self._rig)
            self._correct_pose(seen, uvs_px)
        self._map.keep(seen, packet.frame, self._belief.T_world_imu)
        return self._belief.estimate(packet.frame.t_ns)

    def _correct_pose(self, seen: LandmarkMap, uvs_px: Array) -> None:
        residual_px, H_pose, *_ = residuals_with_jacobians(seen, uvs_px, self._belief.T_world_imu, self._rig)
        noise_px2 = stereo.noise_px2(uvs_px, self._rig) / self._rig.track_weight
        rows = np.asarray(np.linalg.solve(noise_px2, H_pose)).reshape(-1, 6)
        self._belief = information_update(
            self._belief, rows.T @ H_pose.reshape(-1, 6), rows.T @ residual_px.reshape(-1)
        )

    def landmarks(self) -> Landmarks:
        return self._map.landmarks()


def _without_biases(belief: Belief) -> Belief:
    """Return the belief with its biases fixed at their values, because the report's state has none."""
    cov, biases = belief.cov.copy(), belief.layout.biases
    cov[biases], cov[:, biases] = 0.0, 0.0
    cov[biases, biases] = _FIXED_VARIANCE * np.eye(biases.stop - biases.start)
    return replace(belief, cov=cov)
