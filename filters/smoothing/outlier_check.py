"""Which sightings are outliers to a smoother: they are far from where it expects the landmark of their track.

Expected is what the newest state, carried on by the measured motion, sees of the smoother's own landmarks. No filter
beside the smoother takes part: one whose covariance is too small diverges, and would reject every sound sighting.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from toolkit.geometry import Array, BoolArray
from toolkit.models import left_only, stereo
from toolkit.models.gating import MOST_MISMATCHED, chi2_bound, mahalanobis_squared
from toolkit.models.state import POSE, Belief
from toolkit.sequence import StereoFrame, StereoRig
from toolkit.settings import Outliers


def relative_to_its_map(belief: Belief) -> Belief:
    """Return the belief with its pose taken for certain.

    Landmarks are known from the pose, and share its error: how far both are off in the world shows in no sighting.
    """
    cov = belief.cov.copy()
    cov[POSE], cov[:, POSE] = 0.0, 0.0
    return replace(belief, cov=cov)


@dataclass(frozen=True, eq=False)
class OutlierCheck:
    """Leaves sightings out that are beyond the gate of an outlier policy, or a multiple of it."""

    rig: StereoRig
    policy: Outliers

    def without_outliers(self, frame: StereoFrame, points: Mapping[int, Array], expected: Belief) -> StereoFrame:
        """Return the frame without its outliers."""
        return frame.select(~self.outliers(frame, points, expected))

    def outliers(self, frame: StereoFrame, points: Mapping[int, Array], expected: Belief) -> BoolArray:
        """Say which sightings (N,) of a frame are not of the landmarks (3,) m that their tracks have.

        ``expected`` is the state as predicted, its covariance that of its motion relative to the map. A landmark counts
        as known as well as one sighting from here would tell. A sighting of an unknown landmark is no outlier. Where
        most are outliers the state is wrong, and none is returned.
        """
        known = np.array([i in points for i in frame.track_ids.tolist()], dtype=bool)
        if not known.any():
            return known
        landmarks = np.array([points[i] for i in frame.track_ids[known].tolist()])
        predicted, uvs_px = stereo.predict(landmarks, expected.T_world_imu, self.rig), frame.uvs_px[known]
        H = left_only.seen_rows(uvs_px, predicted.d_uv_d_pose)
        covs_px2 = 2.0 * left_only.noise_px2(uvs_px, self.rig) + H @ expected.cov[POSE, POSE] @ np.swapaxes(H, 1, 2)
        dof = left_only.degrees_of_freedom(uvs_px)
        bound = self.policy.smoother_gate_factor * chi2_bound(dof, self.policy.gate_probability)
        far = mahalanobis_squared(left_only.residuals_px(uvs_px, predicted.uv_px), covs_px2) > bound
        if far.mean() > MOST_MISMATCHED:
            return np.zeros_like(known)
        result = known.copy()
        result[known] = far
        return result
