"""Which estimated pose is compared with which true one.

The rule, the same for every estimator on a sequence: a truth stamp is scored where an estimate lies within the
stamp tolerance (1 ms, or a quarter of the truth's period if that is less; stamps that coincide up to rounding are
never interpolated), or where it lies between two estimates at most 1.5 frame periods apart (the estimate is then
interpolated on the geodesic of SE(3)). Everything else is not scored; the coverage counts it as missing.
"""

from dataclasses import dataclass

import numpy as np

from toolkit.estimate import Trajectory
from toolkit.geometry import Array, BoolArray, IntArray, interpolate_poses
from toolkit.sequence import Truth

STAMP_TOLERANCE_NS = 1_000_000
WIDEST_BRIDGE_IN_FRAME_PERIODS = 1.5


@dataclass(frozen=True, eq=False)
class Matched:
    """The n pairs that are scored: stamps (n,), true and estimated poses (n, 4, 4), path (n,) m.

    ``path_m`` is the distance travelled along the whole truth up to each pair, so a gap in the estimate does
    not shorten it. The estimates are in their own world.
    """

    t_ns: IntArray
    truth: Array
    estimate: Array
    path_m: Array

    def __len__(self) -> int:
        return self.t_ns.size

    @property
    def positions(self) -> tuple[Array, Array]:
        """The true and the estimated positions (n, 3) m, to fit the one to the other."""
        return self.truth[:, :3, 3], self.estimate[:, :3, 3]


def finite_poses(poses: Array) -> BoolArray:
    """Say for each pose (N, 4, 4) whether all its entries are finite."""
    return np.asarray(np.isfinite(poses).all(axis=(-2, -1)))


def median_period_ns(t_ns: IntArray) -> float:
    """Return the median step of stamps (N,), 0 where there are fewer than two."""
    return float(np.median(np.diff(t_ns))) if t_ns.size > 1 else 0.0


def associate(estimate: Trajectory, truth: Truth, frame_period_ns: float) -> Matched:
    """Match an estimate with the truth on the truth's stamps; poses that are not finite take no part."""
    known = finite_poses(truth.T_world_imu)
    truth_t_ns, truth_poses = truth.t_ns[known], truth.T_world_imu[known]
    usable = finite_poses(estimate.T_world_imu)
    t_ns, poses = estimate.t_ns[usable], estimate.T_world_imu[usable]
    if t_ns.size == 0 or truth_t_ns.size == 0:
        return Matched(np.empty(0, np.int64), np.empty((0, 4, 4)), np.empty((0, 4, 4)), np.empty(0))
    scored, estimates = poses_at(t_ns, poses, truth_t_ns, frame_period_ns)
    path_m = distance_along(truth_poses[:, :3, 3])
    return Matched(truth_t_ns[scored], truth_poses[scored], estimates, path_m[scored])


def true_poses_at(t_ns: IntArray, truth: Truth, frame_period_ns: float) -> tuple[BoolArray, Array]:
    """Return which of the stamps (N,) the truth covers, and the true poses (n, 4, 4) there, by the rule above.

    The roles are exchanged: here the truth is interpolated, because a stated covariance belongs to the estimate's own
    stamp.
    """
    known = finite_poses(truth.T_world_imu)
    if not known.any() or t_ns.size == 0:
        return np.zeros(t_ns.size, dtype=bool), np.empty((0, 4, 4))
    return poses_at(truth.t_ns[known], truth.T_world_imu[known], t_ns, frame_period_ns)


def poses_at(t_ns: IntArray, poses: Array, at_ns: IntArray, frame_period_ns: float) -> tuple[BoolArray, Array]:
    """Return which of the stamps (M,) finite poses (N, 4, 4), N > 0, cover by the rule above, and the poses there."""
    tolerance_ns = min(STAMP_TOLERANCE_NS, median_period_ns(at_ns) / 4.0) if at_ns.size > 1 else STAMP_TOLERANCE_NS
    after = np.clip(np.searchsorted(t_ns, at_ns), 0, t_ns.size - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(t_ns[after] - at_ns) < np.abs(at_ns - t_ns[before]), after, before)
    coincides = np.abs(t_ns[nearest] - at_ns) <= tolerance_ns
    inside = (t_ns[before] < at_ns) & (at_ns < t_ns[after])
    bridged = inside & (t_ns[after] - t_ns[before] <= WIDEST_BRIDGE_IN_FRAME_PERIODS * frame_period_ns) & ~coincides
    result = np.array(poses[nearest])
    if bridged.any():
        result[bridged] = interpolate_poses(t_ns, poses, at_ns[bridged])
    scored = coincides | bridged
    return scored, result[scored]


def distance_along(positions: Array) -> Array:
    """Return the distance travelled (N,) m at each of the positions (N, 3)."""
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps_m)])
