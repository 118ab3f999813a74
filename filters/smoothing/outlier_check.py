"""Which tracks have slipped to something else: their sightings are far from where a smoother expects them.

Expected is what the newest state, carried on by the measured motion, sees of the smoother's own landmarks. No filter
beside the smoother is asked: one that is too sure of itself runs off, and then finds every sound track mistaken.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from filters.kalman.gate import STEREO_GATE, mahalanobis_squared
from toolkit.geometry import Array, BoolArray
from toolkit.models import stereo
from toolkit.models.state import POSE, Belief
from toolkit.sequence import StereoFrame, StereoRig

# A smoother relinearises and weighs doubtful sightings down: it leaves out only what no chance explains.
BEYOND_THE_GATE = 4.0
# Tracks slip one by one. Where most of them disagree with the state, it is the state that is wrong.
MOST_SLIPPED = 0.5


def bound_to_its_map(belief: Belief) -> Belief:
    """Return the belief with its pose taken for certain.

    Landmarks are known from the pose, and share its error: how far both are off in the world shows in no sighting.
    """
    cov = belief.cov.copy()
    cov[POSE], cov[:, POSE] = 0.0, 0.0
    return replace(belief, cov=cov)


def slipped(frame: StereoFrame, points: Mapping[int, Array], expected: Belief, rig: StereoRig) -> BoolArray:
    """Say which sightings (N,) of a frame are not of the landmarks (3,) m that their tracks have.

    ``expected`` is the state as predicted, its covariance that of its motion against the map. A landmark counts as
    known as well as one sighting from here would tell. A sighting of an unknown landmark has not slipped.
    """
    known = np.array([i in points for i in frame.track_ids.tolist()], dtype=bool)
    if not known.any():
        return known
    uvs_px = frame.uvs_px[known]
    landmarks = np.array([points[i] for i in frame.track_ids[known].tolist()])
    predicted = stereo.predict(landmarks, expected.T_world_imu, rig)
    H = predicted.d_uv_d_pose
    covs_px2 = 2.0 * rig.cov_uv_px2 + H @ expected.cov[POSE, POSE] @ np.swapaxes(H, 1, 2)
    far = mahalanobis_squared(uvs_px - predicted.uv_px, covs_px2) > BEYOND_THE_GATE * STEREO_GATE
    if far.mean() > MOST_SLIPPED:
        return np.zeros_like(known)
    result = known.copy()
    result[known] = far
    return result
