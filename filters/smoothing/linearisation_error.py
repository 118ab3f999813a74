"""How far variables may move from their linearisation points: states by thresholds, landmarks by their image.

The effect of a metre on an image falls with the square of the depth. A threshold in metres that is small enough for
near landmarks would relinearise far ones in every frame: a disparity of some pixels determines their depth only to
metres.
"""

from collections.abc import Mapping

import gtsam
import numpy as np

from toolkit.geometry import Array, BoolArray, se3_inverse, transform
from toolkit.measurements import StereoRig
from toolkit.models import stereo
from toolkit.models.factors import kind_of
from toolkit.models.state import MotionModel

# How far states may move from their linearisation points: rad; m/s, or the unit of a rate; m/s^2 and rad/s for a bias;
# and multiples of the baseline, which is the length scale of stereo: the image of a point 20 baselines away is then
# off by a tenth of a pixel. A change of velocity or accelerometer bias common to all states affects residuals only by
# the rotation between two frames. Coarser thresholds mix linearisation points: five times 0.01 rad, 0.1 baselines and
# 0.01 for the rest made a flight of two minutes five times less accurate.
ROTATION_THRESHOLD_RAD, VELOCITY_THRESHOLD, BIAS_THRESHOLD = 0.01, 0.1, (0.1, 0.01)
POSITION_THRESHOLD_BASELINES = 0.3
# In sigmas of a sighting.
LANDMARK_BEYOND_SIGMA = 0.1


def state_thresholds(motion: MotionModel, baseline_m: float) -> dict[str, Array]:
    """Return how far a state's variables may move from their linearisation points, (6,) or (3,) by kind.

    In GTSAM's tangent spaces.
    """
    pose = np.repeat([ROTATION_THRESHOLD_RAD, POSITION_THRESHOLD_BASELINES * baseline_m], 3)
    at_most = {"x": pose, "v": np.repeat(VELOCITY_THRESHOLD, 6), "b": np.repeat(BIAS_THRESHOLD, 3)}
    return {kind: at_most[kind][-size:] for kind, size in motion.variable_sizes.items()}


def any_moved_beyond(at_most: Mapping[str, Array], steps: gtsam.VectorValues, keys: list[int]) -> bool:
    """Say whether a state variable is beyond its threshold, given its step from the linearisation point."""
    if not keys:
        return False
    return bool((np.abs(steps.vector(keys)) >= np.concatenate([at_most[kind_of(key)] for key in keys])).any())


def linearised_badly(now: Array, linearised_at: Array, T_world_imu: Array, rig: StereoRig) -> BoolArray:
    """Say for which points (N, 3) m in the world the linearised image in a pose (4, 4) is off by too much.

    With image h, depth z and a point moved by dp, ``h(p) + h'(p) dp - h(p + dp)`` is ``(h(p + dp) - h(p)) dz / z``.
    """
    T_imu_world = se3_inverse(T_world_imu)
    before_px, before_m = stereo.images(transform(T_imu_world, linearised_at), rig)
    now_px, now_m = stereo.images(transform(T_imu_world, now), rig)
    off_px = (now_px - before_px) * ((now_m - before_m) / before_m)[:, None]
    off_sigma = np.linalg.norm(off_px @ rig.whitener.T, axis=1)
    return np.asarray((off_sigma > LANDMARK_BEYOND_SIGMA) | (before_m <= 0.0) | (now_m <= 0.0))
