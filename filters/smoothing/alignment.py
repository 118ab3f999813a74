"""Where a new state begins: where its sightings of known landmarks put it, not where the measured motion alone does.

The motion may be off by many times what is new in a sighting of a track. Linearised there, a loss would weigh every
sighting down as an outlier.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from filters.smoothing.robust_loss import Cauchy
from toolkit.geometry import Array, se3_exp
from toolkit.models import left_only, stereo
from toolkit.models.state import POSE, Belief
from toolkit.sequence import StereoFrame, StereoRig

# Gauss-Newton with weights of the step before: a turn of three pixels is within a tenth of one after these.
ITERATIONS = 5
# As batch has it, between its first solve and its last.
_LOSS = Cauchy(2.0)


def aligned(expected: Belief, frame: StereoFrame, points: Mapping[int, Array], rig: StereoRig) -> Belief:
    """Return the belief at the pose that a frame's sightings of points (3,) m and the expected pose agree on.

    Each sighting counts by itself, with the noise of the pixels; the covariance stays as it is.
    """
    seen = frame.select(np.array([i in points for i in frame.track_ids.tolist()], dtype=bool))
    if not seen.track_ids.size:
        return expected
    landmarks = np.array([points[i] for i in seen.track_ids.tolist()])
    held = np.linalg.inv(expected.cov[POSE, POSE])
    T_world_imu, off, whitener = expected.T_world_imu, np.zeros(6), left_only.whitener(seen.uvs_px, rig)
    for _ in range(ITERATIONS):
        predicted = stereo.predict(landmarks, T_world_imu, rig)
        residual = left_only.whitened_residuals(seen.uvs_px, predicted.uv_px, rig)
        weights = np.where(predicted.depth_m > 0.0, _LOSS.weight(np.linalg.norm(residual, axis=1)), 0.0)
        H = (whitener @ predicted.d_uv_d_pose).reshape(-1, 6)
        weighed = H * np.repeat(weights, 3)[:, None]
        step = np.linalg.solve(held + weighed.T @ H, weighed.T @ residual.ravel() - held @ off)
        off, T_world_imu = off + step, T_world_imu @ se3_exp(step)
    return replace(expected, T_world_imu=T_world_imu)
