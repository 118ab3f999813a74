"""A scale on all disparities: d becomes d (1 + scale), the mean column c = (uL + uR) / 2 and the row stay.

That is, exactly, a pair whose baseline is b (1 + scale) about the same middle: the left camera is half of what is added
further to the left. A baseline or a focal length that is calibrated wrong does so, and matching that prefers one side;
one about the left camera would move c by half a scaled disparity as well.
"""

from dataclasses import replace

import numpy as np

from toolkit.geometry import Array
from toolkit.models.stereo import disparity_px
from toolkit.sequence import StereoRig

# (uL, uR) of a disparity that is added: half of it on either side.
_OF_A_DISPARITY = np.array([0.5, -0.5, 0.0])


def scaled_rig(rig: StereoRig, scale: float) -> StereoRig:
    """Return the rig whose sightings have disparities larger by a share, which is more than -1."""
    T_imu_cam = rig.T_imu_cam.copy()
    T_imu_cam[:3, 3] -= 0.5 * scale * rig.baseline_m * T_imu_cam[:3, 0]
    return replace(rig, baseline_m=rig.baseline_m * (1.0 + scale), T_imu_cam=T_imu_cam)


def d_uv_d_scale(uv_px: Array, scale: float) -> Array:
    """Return the derivatives (..., 3) of what a scaled rig predicts, (..., 3) px, by its scale."""
    return np.asarray(disparity_px(uv_px)[..., None] / (1.0 + scale) * _OF_A_DISPARITY)
