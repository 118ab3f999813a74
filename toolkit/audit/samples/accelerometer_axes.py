"""An accelerometer whose channels are exchanged or have the wrong sign, against a gyro and a camera that agree.

The change of the camera's velocity less the specific force is gravity, the same all along in the axes of one frame,
into which the gyro turns everything. All 48 ways to exchange and negate three channels are tried; the right one leaves
the least. What turns about one axis only, and hardly accelerates, tells few of them apart.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.alignment import chained
from toolkit.audit.parts.axes import MIRRORED, axes_named, signed_axes
from toolkit.audit.parts.intervals import Intervals, interval_means
from toolkit.audit.parts.robust import cauchy, mean_in_sigmas
from toolkit.geometry import Array, IntArray, so3_exp
from toolkit.resampling import NS_PER_S

# The camera's velocity changes by more than its noise over so long; the gyro drifts little over a window.
STRIDE_S, WINDOW_S = 0.5, 10.0
# A stride begins so many times in the length of one.
OVERLAP = 2
LEAST_STRIDES = 20
# What such a change of velocity is good for (m/s^2).
LEAST_SPREAD = 0.1
# Another order must be beyond doubt (sound recordings have the given one as the best), and leave at most this share of
# what that leaves: other faults are explained in part.
AGAINST_GIVEN, MOST_LEFT = 5.0, 0.7


class _Changes(NamedTuple):
    """Over M strides: the change of velocity (M, 3) and what each channel makes along each axis (M, 3, 3, 3), m/s^2.

    ``along`` is [stride, axis of the IMU, channel, axis of the first frame]; ``window`` (M,) numbers the windows.
    """

    velocity: Array
    along: Array
    window: IntArray


def check(evidence: Evidence) -> Symptom | None:
    """Name the order and the signs of the channels with which the specific force is the camera's, if it is another."""
    intervals, sequence = evidence.intervals, evidence.sequence
    if intervals is None or sequence.motion_kind != "imu":
        return None
    found = evidence.agreement
    if found.residual_px > found.limit_px:
        return None  # the gyro is not the camera's, and a disagreement is told
    changes = _changes(evidence, intervals)
    if len(changes.velocity) < LEAST_STRIDES:
        return None
    orders = signed_axes()
    left = np.stack([_left(changes, order) for order in orders])
    costs = cauchy(left, LEAST_SPREAD)
    ranked = [int(k) for k in np.argsort(costs.mean(axis=1))]
    best = ranked[0]
    given_mps2, best_mps2 = (float(np.median(np.linalg.norm(left[k], axis=1))) for k in (0, best))
    if best == 0 or mean_in_sigmas(costs[0] - costs[best]) < AGAINST_GIVEN or best_mps2 > MOST_LEFT * given_mps2:
        return None
    return Symptom(
        count=1,
        detail=(
            f"the accelerometer's x, y, z are the gyro's {axes_named(orders[best])}: of the change of the camera's "
            f"velocity the samples leave {given_mps2:.2f} m/s^2 as given, {best_mps2:.2f} m/s^2 then (median)"
        ),
        treatment=f"its channels are exchanged or have the wrong sign: set them right{MIRRORED}",
        remedy=None,
        spoils_vision=True,
    )


def _changes(evidence: Evidence, intervals: Intervals) -> _Changes:
    """Take the camera's velocities in the middles of the intervals, turned by the gyro less its bias to the first."""
    sequence, camera = evidence.sequence, evidence.camera_motion
    R_imu_cam, p_imu_cam = sequence.rig.T_imu_cam[:3, :3], sequence.rig.T_imu_cam[:3, 3]
    bias_radps = np.median(intervals.w_radps - intervals.w_cam_radps @ R_imu_cam.T, axis=0)
    frames_t_ns, motion = sequence.frames_t_ns, sequence.motion
    w_radps = interval_means(motion.t_ns, motion.values, frames_t_ns)[:, 3:] - bias_radps
    v_mps = camera.v_mps @ R_imu_cam.T - np.cross(w_radps, p_imu_cam)
    middle_ns = frames_t_ns[:-1] + np.diff(frames_t_ns) // 2
    h_s = np.diff(middle_ns) / NS_PER_S
    mean = interval_means(motion.t_ns, motion.values, middle_ns)
    half = so3_exp(0.5 * h_s[:, None] * (mean[:, 3:] - bias_radps))
    R_first_imu = chained(half @ half)
    v_first = (R_first_imu @ v_mps[:, :, None]).squeeze(-1)
    made = np.einsum("kia,kc,k->kaci", R_first_imu[:-1] @ half, mean[:, :3], h_s)
    up_to = np.concatenate([np.zeros((1, 3, 3, 3)), np.cumsum(made, axis=0)])
    stride = max(OVERLAP, round(STRIDE_S / float(np.median(h_s))))
    a = np.arange(0, len(v_first) - stride, stride // OVERLAP)
    unknown = np.concatenate([[0], np.cumsum(~camera.known)])
    a = a[unknown[a + stride + 1] == unknown[a]]
    b = a + stride
    t_s = (middle_ns - middle_ns[0]) / NS_PER_S
    over_s = t_s[b] - t_s[a]
    window = (t_s[a] // WINDOW_S).astype(np.int64)
    return _Changes(
        (v_first[b] - v_first[a]) / over_s[:, None], (up_to[b] - up_to[a]) / over_s[:, None, None, None], window
    )


def _left(changes: _Changes, order: Array) -> Array:
    """Return what an order (3, 3) of the channels leaves of the changes (M, 3), less the median of each window."""
    left = changes.velocity - np.einsum("kaci,ac->ki", changes.along, order.T)
    for window in np.unique(changes.window):
        here = changes.window == window
        left[here] -= np.median(left[here], axis=0)
    return np.asarray(left)


FAULT = Fault(
    "accelerometer-axes",
    "an accelerometer whose channels are exchanged or have the wrong sign",
    check,
    after=("units", "mixed-axes", "time-offset", "saturated-samples"),
)
