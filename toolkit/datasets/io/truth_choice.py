"""Which of several truths of one recording fits its gyro best."""

import numpy as np

from toolkit.geometry import Array, IntArray, interpolate_poses, so3_log
from toolkit.resampling import NS_PER_S
from toolkit.sequence import ImuSamples, Truth

# Long enough that the noise of single truth poses hardly counts, short enough that the gyro's mean is the rotation.
_STEP_NS = NS_PER_S // 10


def rate_scatter_radps(truth: Truth, imu: ImuSamples) -> float:
    """Return how far the truth's rates of rotation are from the gyro's, RMS (rad/s), the gyro's mean bias removed.

    A truth whose axes are not the IMU's turns about other axes than the gyro says. Infinite where the two share
    no 0.2 s.
    """
    sample_t_ns, gyro_radps = _usable(imu)
    if not sample_t_ns.size:
        return float("inf")
    first, last = max(truth.t_ns[0], sample_t_ns[0]), min(truth.t_ns[-1], sample_t_ns[-1])
    at_ns = np.arange(first, last + 1, _STEP_NS, dtype=np.int64)
    if at_ns.size < 3:
        return float("inf")
    R_world_imu = interpolate_poses(truth.t_ns, truth.T_world_imu, at_ns)[:, :3, :3]
    steps = so3_log(np.swapaxes(R_world_imu[:-1], 1, 2) @ R_world_imu[1:])
    off = steps * (NS_PER_S / _STEP_NS) - _mean_rates(sample_t_ns, gyro_radps, at_ns)
    return float(np.sqrt(((off - np.median(off, axis=0)) ** 2).mean()))


def _usable(imu: ImuSamples) -> tuple[IntArray, Array]:
    """Return stamps (S,) and rates (S, 3) without what the audit will repair: rows not finite, out of order, twice."""
    finite = np.flatnonzero(np.isfinite(imu.gyro_radps).all(axis=1))
    t_ns, first = np.unique(imu.t_ns[finite], return_index=True)
    return t_ns, imu.gyro_radps[finite[first]]


def _mean_rates(t_ns: IntArray, gyro_radps: Array, at_ns: IntArray) -> Array:
    """Return the means (N - 1, 3) rad/s of samples (S, 3), taken as straight lines, between stamps (N,)."""
    t_s, at_s = (t_ns - t_ns[0]) / NS_PER_S, (at_ns - t_ns[0]) / NS_PER_S
    areas = 0.5 * (gyro_radps[1:] + gyro_radps[:-1]) * np.diff(t_s)[:, None]
    turned = np.vstack([np.zeros(3), np.cumsum(areas, axis=0)])
    reached = np.stack([np.interp(at_s, t_s, axis) for axis in turned.T], axis=1)
    means: Array = np.diff(reached, axis=0) / np.diff(at_s)[:, None]
    return means
