"""An accelerometer whose channels are exchanged or have the wrong sign, while gyro and camera agree.

In the axes of one frame, by the gyro, the change of the camera's velocity less the specific force is gravity, which is
constant. All 48 ways to exchange and negate three channels are tried; the right one leaves the smallest variation. A
motion that turns about one axis only and hardly accelerates distinguishes few of them.
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

# Durations (s). Over a stride the camera's velocity changes by more than its noise; over a window the gyro drifts
# little.
STRIDE_S, WINDOW_S = 0.5, 10.0
# So many strides begin within the length of one.
OVERLAP = 2
LEAST_STRIDES = 20
# Accuracy of such a change of velocity (m/s^2).
LEAST_SPREAD = 0.1
# Another order must be better than the given one by so many standard errors, and leave at most this share of what the
# given one leaves, because an order can also explain a part of other faults. In sound recordings the given order is the
# best.
AGAINST_GIVEN, MOST_LEFT = 5.0, 0.7


class _Changes(NamedTuple):
    """Over M strides: the change of velocity (M, 3), and that of each channel in each axis (M, 3, 3, 3), in m/s^2.

    ``along`` is the mean of each channel if it measured each axis: [stride, axis of the IMU, channel, axis of the first
    frame]. ``window`` (M,) numbers the windows.
    """

    velocity: Array
    along: Array
    window: IntArray


def check(evidence: Evidence) -> Symptom | None:
    """Report the order and the signs of the channels that fit the camera's motion, if they are not the given ones."""
    intervals, sequence = evidence.intervals, evidence.sequence
    if intervals is None or sequence.motion_kind != "imu":
        return None
    found = evidence.agreement
    if found.residual_px > found.limit_px:
        return None  # gyro and camera differ, which `disagreement` reports
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
            f"the accelerometer's x, y, z are the gyro's {axes_named(orders[best])}: the residual against the camera's "
            f"change of velocity is {given_mps2:.2f} m/s^2 as given, {best_mps2:.2f} m/s^2 then (median)"
        ),
        treatment=f"its channels are exchanged or have the wrong sign: correct them{MIRRORED}",
        remedy=None,
        spoils_vision=True,
    )


def _changes(evidence: Evidence, intervals: Intervals) -> _Changes:
    """Return changes of the camera's velocity between the middles of intervals, in axes of the first frame."""
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
    """Return the changes (M, 3) less the specific force in an order (3, 3) of channels, about the window's median."""
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
