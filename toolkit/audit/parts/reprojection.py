"""The one-step stereo reprojection: how well the motion samples carry each point to where the next frame sees it."""

import numpy as np

from toolkit.audit.parts.intervals import interval_means
from toolkit.audit.parts.vision import usable_pairs
from toolkit.geometry import Array, se3_exp, se3_inverse, transform
from toolkit.models.stereo import project, triangulate
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence


def median_one_step_px(sequence: Sequence, T_imu_cam: Array) -> float:
    """Return the median over the sightings of the root mean square of (uL, uR, v) residuals, in pixels.

    Points triangulated in one frame are moved by the twist samples (``sequence`` has twists) through the
    extrinsic ``T_imu_cam`` and projected into the next.
    """
    pairs, uv_px = usable_pairs(sequence), sequence.observations.uv_px
    dt_s = np.diff(sequence.frames_t_ns)[:, None] / NS_PER_S
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values, sequence.frames_t_ns)
    T_before_after_imu = se3_exp(dt_s * np.concatenate([mean[:, 3:], mean[:, :3]], axis=1))
    T_after_before = se3_inverse(se3_inverse(T_imu_cam) @ T_before_after_imu @ T_imu_cam)
    points = transform(T_after_before[pairs.interval], triangulate(uv_px[pairs.before], sequence.rig))
    points[:, 2] = np.maximum(points[:, 2], 0.1)
    residual_px = uv_px[pairs.after] - project(points, sequence.rig)
    return float(np.median(np.sqrt(np.mean(residual_px**2, axis=1))))
