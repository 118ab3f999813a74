"""How well the tracks follow the measured motion, and how badly they may: the judge of every repaired calibration."""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.intervals import median_one_step_px, own_one_step_px
from toolkit.measured_motion import TwistChangeNoise, TwistNoise
from toolkit.models.camera_motion import CameraMotion, usable_pairs
from toolkit.models.stereo import triangulate
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# Median one-step residual (px) beyond which samples and tracks disagree. Sound recordings have 0.3 to 3.1 px, the
# largest where the samples' own noise explains it.
MOST_PX = 3.0
# So many times what the tracks' own scatter and the stated noise of the samples explain is allowed in any case.
TIMES_EXPLAINED = 2.0


class Agreement(NamedTuple):
    """Median one-step residuals (px): under the measured motion, under the camera's own, and what is allowed."""

    residual_px: float
    own_px: float
    limit_px: float


def agreement(sequence: Sequence, camera: CameraMotion) -> Agreement:
    """Measure how well the tracks follow the measured motion of a sequence that can be compared."""
    own_px = own_one_step_px(sequence, camera)
    limit_px = max(MOST_PX, TIMES_EXPLAINED * _explained_px(sequence, own_px))
    return Agreement(median_one_step_px(sequence, camera, sequence.rig.T_imu_cam), own_px, limit_px)


def _explained_px(sequence: Sequence, own_px: float) -> float:
    """Return the residual that the tracks' own scatter and the stated noise over a usual interval explain together."""
    noise, focal_px = sequence.noise, sequence.rig.fx_px
    root_dt = np.sqrt(np.median(np.diff(sequence.frames_t_ns)) / NS_PER_S)
    turned_px = moved_px = 0.0
    if not isinstance(noise, TwistChangeNoise):
        turned_px = focal_px * root_dt * float(np.max(noise.gyro_noise_density))
    if isinstance(noise, TwistNoise):
        uv_px = sequence.observations.uv_px[usable_pairs(sequence).before]
        depth_m = float(np.median(triangulate(uv_px, sequence.rig)[:, 2])) if len(uv_px) else np.inf
        moved_px = focal_px / depth_m * root_dt * float(np.max(noise.velocity_noise_density))
    return float(np.sqrt(own_px**2 + turned_px**2 + moved_px**2))
