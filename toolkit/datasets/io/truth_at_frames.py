"""A truth of its own stamps at the stamps of frames."""

import numpy as np

from toolkit.geometry import Array, IntArray, interpolate_poses
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Truth

# Between truths farther apart nothing is known of the motion at 1 m/s: two periods of the camera.
_LONGEST_TRUTH_GAP_NS = NS_PER_S // 10


def stamps_within(stamps: IntArray, imu_t_ns: IntArray, truth_t_ns: IntArray) -> IntArray:
    """Return the stamps (K,) that lie within the IMU's time and between truths close enough to interpolate."""
    first, last = max(imu_t_ns.min(), truth_t_ns[0]), min(imu_t_ns.max(), truth_t_ns[-1])
    inside = stamps[(stamps >= first) & (stamps <= last)]
    after = np.clip(np.searchsorted(truth_t_ns, inside), 1, truth_t_ns.size - 1)
    return np.asarray(inside[truth_t_ns[after] - truth_t_ns[after - 1] <= _LONGEST_TRUTH_GAP_NS])


def truth_near(truth: Truth, t_ns: IntArray) -> Truth:
    """Return the truth at those stamps (K,) that lie between truths close enough to interpolate."""
    return truth_at(truth, stamps_within(t_ns, truth.t_ns, truth.t_ns))


def truth_at(truth: Truth, t_ns: IntArray) -> Truth:
    """Return the truth at stamps (K,) within it: poses on the geodesic, velocities and biases on straight lines."""
    poses = interpolate_poses(truth.t_ns, truth.T_world_imu, t_ns)
    return Truth(t_ns, poses, _linear(truth.v_world, truth.t_ns, t_ns), _linear(truth.bias, truth.t_ns, t_ns))


def _linear(values: Array | None, t_ns: IntArray, at_ns: IntArray) -> Array | None:
    if values is None:
        return None
    t_s, at_s = (t_ns - t_ns[0]) / NS_PER_S, (at_ns - t_ns[0]) / NS_PER_S
    return np.stack([np.interp(at_s, t_s, column) for column in values.T], axis=1)
