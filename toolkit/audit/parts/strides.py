"""The motion of an IMU over strides of some frames, preintegrated, and how it changes with the biases.

Source: Forster, Carlone, Dellaert & Scaramuzza, "On-manifold preintegration for real-time visual-inertial odometry"
(2017), section VI. The derivatives are differences of the integrals: all are linear to what biases are off by.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.intervals import interval_means, subdivided
from toolkit.geometry import Array, IntArray, so3_exp, so3_log
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# Of the biases (rad/s, m/s^2), for derivatives.
_DIFFERENCE = 1e-4


class Strides(NamedTuple):
    """The strides (m,) between m + 1 frames: durations (m,) s, turns (m, 3, 3), and changes (m, 3) of the velocity and
    the position in the axes of their begin, as if the IMU began at rest in free fall.

    The derivatives (m, 3, 6) are those of the turn's logarithm and of the changes by the biases of gyro and
    accelerometer, in that order.
    """

    dt_s: Array
    R_a_b: Array
    faster: Array
    moved: Array
    d_turn: Array
    d_faster: Array
    d_moved: Array

    def biased(self, bias: Array) -> "Strides":
        """Return what the strides are where the biases (6,) are these."""
        return self._replace(
            R_a_b=self.R_a_b @ so3_exp(self.d_turn @ bias),
            faster=self.faster + self.d_faster @ bias,
            moved=self.moved + self.d_moved @ bias,
        )


def strides_between(sequence: Sequence, t_ns: IntArray, w_bias_radps: Array) -> Strides:
    """Integrate an IMU's samples, less a bias (3,) of the gyro, between stamps (m + 1,) of frames."""
    part_t_ns, frame_at = subdivided(t_ns)
    count, parts = len(t_ns) - 1, int(frame_at[1])
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values, part_t_ns).reshape(count, parts, 6)
    h_s = (np.diff(part_t_ns) / NS_PER_S).reshape(count, parts, 1)
    gyro_first = np.eye(6)[[3, 4, 5, 0, 1, 2]]
    off = np.concatenate([np.zeros((1, 6)), _DIFFERENCE * gyro_first])[:, None] + np.append(np.zeros(3), w_bias_radps)
    R_a_now = np.tile(np.eye(3), (7, count, 1, 1))
    faster, moved = np.zeros((7, count, 3)), np.zeros((7, count, 3))
    for k in range(parts):
        sample, step_s = mean[None, :, k] - off, h_s[None, :, k]
        half = so3_exp(0.5 * step_s * sample[..., 3:])
        middle = R_a_now @ half
        force = (middle @ sample[..., :3, None])[..., 0]
        moved = moved + step_s * faster + 0.5 * step_s**2 * force
        faster = faster + step_s * force
        R_a_now = middle @ half
    turned = so3_log(R_a_now[0].swapaxes(1, 2) @ R_a_now[1:])
    changes = (np.moveaxis(x / _DIFFERENCE, 0, -1) for x in (turned, faster[1:] - faster[0], moved[1:] - moved[0]))
    return Strides(np.diff(t_ns) / NS_PER_S, R_a_now[0], faster[0], moved[0], *changes)
