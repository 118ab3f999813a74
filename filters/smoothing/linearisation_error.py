"""How far a landmark may move from where it is linearised: until its linear image is off by a share of the noise.

What a metre changes in an image goes with the square of the depth. A threshold in metres that keeps near landmarks
sound has far ones, whose depth a disparity of some pixels tells to a metre, linearised anew in every frame.
"""

import numpy as np

from toolkit.geometry import Array, BoolArray, se3_inverse, transform
from toolkit.models import stereo
from toolkit.sequence import StereoRig

# Sigma of a sighting. A tenth of it is what linearised sightings of a chain are renewed beyond, too.
LANDMARK_BEYOND_SIGMA = 0.1


def linearised_badly(now: Array, linearised_at: Array, T_world_imu: Array, rig: StereoRig) -> BoolArray:
    """Say of which points (N, 3) m in the world the image in a pose (4, 4), linear about others (N, 3), is off too far.

    With image h, depth z and a point moved by dp, ``h(p) + h'(p) dp - h(p + dp)`` is ``(h(p + dp) - h(p)) dz / z``.
    """
    T_imu_world = se3_inverse(T_world_imu)
    before_px, before_m = stereo.images(transform(T_imu_world, linearised_at), rig)
    now_px, now_m = stereo.images(transform(T_imu_world, now), rig)
    off_px = (now_px - before_px) * ((now_m - before_m) / before_m)[:, None]
    off_sigma = np.linalg.norm(off_px @ rig.whitener.T, axis=1)
    return np.asarray((off_sigma > LANDMARK_BEYOND_SIGMA) | (before_m <= 0.0) | (now_m <= 0.0))
