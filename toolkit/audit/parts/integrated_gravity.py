"""The camera's velocity less the integrated specific force of an IMU, which changes by gravity alone."""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.alignment import chained
from toolkit.audit.parts.intervals import Intervals, interval_means, subdivided
from toolkit.geometry import Array, IntArray, so3_exp
from toolkit.models.camera_motion import CameraMotion
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence


class IntegratedGravity(NamedTuple):
    """The middle (K - 1,) of each interval, and the camera's velocity less the integrated specific force (K - 1, 3).

    Velocities are in the axes of the first frame, by the rates of the gyro less its bias. Without errors the difference
    is a straight line in time, whose slope is gravity.
    """

    middle_ns: IntArray
    velocity_mps: Array


def integrated_gravity(sequence: Sequence, camera: CameraMotion, intervals: Intervals) -> IntegratedGravity:
    """Subtract the specific force, integrated from the first interval on, from the camera's velocity."""
    bias_radps = np.median(intervals.w_radps - intervals.w_cam_radps @ sequence.rig.T_imu_cam[:3, :3].T, axis=0)
    R_imu_cam, p_imu_cam = sequence.rig.T_imu_cam[:3, :3], sequence.rig.T_imu_cam[:3, 3]
    frames_t_ns, motion = sequence.frames_t_ns, sequence.motion
    middle_ns = frames_t_ns[:-1] + np.diff(frames_t_ns) // 2
    w_radps = interval_means(motion.t_ns, motion.values, frames_t_ns)[:, 3:] - bias_radps
    v_mps = camera.v_mps @ R_imu_cam.T - np.cross(w_radps, p_imu_cam)
    t_ns, middle_at = subdivided(middle_ns)
    step_s = np.diff(t_ns)[:, None] / NS_PER_S
    mean = interval_means(motion.t_ns, motion.values, t_ns)
    half = so3_exp(0.5 * step_s * (mean[:, 3:] - bias_radps))
    R_first_imu = chained(half @ half)
    v_first = (R_first_imu[middle_at] @ v_mps[:, :, None]).squeeze(-1)
    gained = (R_first_imu[:-1] @ half @ mean[:, :3, None]).squeeze(-1) * step_s
    return IntegratedGravity(
        middle_ns, v_first - np.concatenate([np.zeros((1, 3)), np.cumsum(gained, axis=0)])[middle_at]
    )
