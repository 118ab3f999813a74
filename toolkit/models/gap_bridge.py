"""Where no track leads from one frame to the next, the body's twist there is like the twist before and after.

Across such a gap the poses before and behind are tied by the measured twist alone, and what it errs in heading turns
all that follows. A car's twist does not change as fast as a noisy sensor says: between neighbouring intervals it is the
same but for white noise on its change (Barfoot, "State estimation for robotics" (2017), section 3.4). The factor is on
the three poses of two intervals, at least one of them a gap, beside the measured twist of both. Everywhere else the
tracks tell the motion better than such a prior, which would hold all turns and speeds back and shrink the world.
"""

from collections.abc import Sequence
from itertools import pairwise

import gtsam
import numpy as np

from toolkit.geometry import Array, IntArray
from toolkit.measured_motion import TwistChangeNoise
from toolkit.models.factors import X
from toolkit.resampling import NS_PER_S
from toolkit.sequence import StereoFrame

# How a car's twist changes from one tenth of a second to the next: 0.06, 0.06, 0.03 rad/s and 0.2, 0.1, 0.2 m/s
# (roll, pitch, yaw; forward, left, up). Twice the figures found on drives of KITTI, with which errors were too small.
CAR = TwistChangeNoise(np.array([0.2, 0.1, 0.2]) / np.sqrt(0.1), np.array([0.06, 0.06, 0.03]) / np.sqrt(0.1))


def gaps(frames: Sequence[StereoFrame]) -> IntArray:
    """Return the places k of the frames (K,) that have no track in common with the frame before, k - 1."""
    common = [np.intersect1d(one.track_ids, other.track_ids).size for one, other in pairwise(frames)]
    return 1 + np.flatnonzero(np.array(common, dtype=np.int64) == 0)


def bridged(frames: Sequence[StereoFrame], noise: TwistChangeNoise = CAR) -> gtsam.NonlinearFactorGraph:
    """Return the factors over the gaps of frames (K,), of which frame k has the pose X(k)."""
    graph, builder = gtsam.NonlinearFactorGraph(), BridgeBuilder(np.inf, noise)
    for k, frame in enumerate(frames):
        graph.push_back(builder.added(frame, k))
    return graph


class BridgeBuilder:
    """Yields the factors over gaps frame by frame, for a smoother that keeps so many seconds of states."""

    def __init__(self, window_s: float, noise: TwistChangeNoise = CAR) -> None:
        self._window_s, self._noise = window_s, noise
        self._frames: list[StereoFrame] = []

    def added(self, frame: StereoFrame, k: int) -> gtsam.NonlinearFactorGraph:
        """Return what frame k, that of X(k), adds: the factor on the last three poses, or nothing."""
        self._frames = [*self._frames[-2:], frame]
        graph = gtsam.NonlinearFactorGraph()
        if len(self._frames) == 3 and gaps(self._frames).size:
            before_s, after_s = (np.diff([one.t_ns for one in self._frames]) / NS_PER_S).tolist()
            # Of two states further apart the first had left when the second came.
            if before_s <= self._window_s:
                graph.add(kept_twist(before_s, after_s, self._noise, k))
        return graph


def kept_twist(before_s: float, after_s: float, noise: TwistChangeNoise, k: int) -> gtsam.NonlinearFactor:
    """Return the factor on X(k - 2), X(k - 1), X(k), whose intervals last some seconds each.

    The residual (6,) is the twist [rad/s, m/s] that leads from the second pose to the third, less that from the first
    to the second. Its covariance is that of noise over the time between the middles of the intervals.
    """
    density = np.concatenate([noise.turn_change_density, noise.velocity_change_density])
    covariance = gtsam.noiseModel.Diagonal.Sigmas(density * np.sqrt(0.5 * (before_s + after_s)))

    def residual(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        first, second, third = (values.atPose3(key) for key in this.keys())  # noqa: SIM118 - not a mapping
        moved = (first.between(second), before_s), (second.between(third), after_s)
        before, after = (gtsam.Pose3.Logmap(step) / dt_s for step, dt_s in moved)
        if jacobians is not None:
            (by_first, by_second), (by_second_too, by_third) = (_by_ends(step, dt_s) for step, dt_s in moved)
            jacobians[0], jacobians[1], jacobians[2] = -by_first, by_second_too - by_second, by_third
        return np.asarray(after - before)

    return gtsam.CustomFactor(covariance, [X(k - 2), X(k - 1), X(k)], residual)


def _by_ends(step: gtsam.Pose3, dt_s: float) -> tuple[Array, Array]:
    """Return the derivatives (6, 6) of a step's twist by the pose at its start and at its end."""
    by_end = gtsam.Pose3.LogmapDerivative(step) / dt_s
    return -by_end @ step.inverse().AdjointMap(), by_end
