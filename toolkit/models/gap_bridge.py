"""A factor for frames without a common track: the body's twist there is close to the twist before and after.

Across such a gap only the measured twist connects the poses, and its error in heading turns all later poses. A car's
twist changes more slowly than measurements with noise suggest: between neighbouring intervals it is constant except for
white noise on its change (Barfoot, "State estimation for robotics" (2017), section 3.4). The factor is on the three
poses of two intervals, at least one of them a gap, beside the measured twist of both. Everywhere else the tracks
determine the motion better than this prior, which would damp turns and speeds and shrink the map.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import gtsam
import numpy as np

from toolkit.geometry import Array, IntArray, se3_adjoint, se3_inverse, se3_log, se3_right_jacobian
from toolkit.measured_motion import Motion, MotionNoise, TwistChangeNoise, TwistMotion, TwistNoise
from toolkit.models.factors import X
from toolkit.resampling import NS_PER_S
from toolkit.sequence import StereoFrame

# The initial value of the change, from the scatter of the measured twists, has the weight of this many intervals.
_STATED_FOR = 10
# Larger changes are clipped to this many standard deviations: they are revisions of the estimate, not motion.
_MOST_SIGMAS = 3.0
# Measured twists are noisy where their change is at least this many times the body's, in mean square.
_NOISY = 2.0
# Smallest standard deviation of the change, as a share of the stated noise, where twists do not change at all.
_ROUNDING = 1e-6


def gaps(frames: Sequence[StereoFrame]) -> IntArray:
    """Return the indices k of the frames (K,) that have no track in common with frame k - 1."""
    pairs = ((one.track_ids, other.track_ids) for one, other in pairwise(frames))
    common = [np.intersect1d(*ids, assume_unique=True).size for ids in pairs]
    return 1 + np.flatnonzero(np.array(common, dtype=np.int64) == 0)


class TwistChange:
    """Estimates how much the twist changes from one interval to the next, from poses between which tracks continue.

    The initial value follows from the white noise of two measured twists; a bridge then has little weight. Errors of
    the poses count as change as well, so that the change is overestimated.
    """

    def __init__(self, measured: TwistNoise) -> None:
        self._measured = np.concatenate([measured.gyro_noise_density, measured.velocity_noise_density])
        self._squares, self._measured_squares, self._count = np.zeros(6), np.zeros(6), 0
        self._stated = np.zeros(6)

    def learn(self, t_ns: IntArray, poses: Array, measured: Array) -> None:
        """Add three successive poses (3, 4, 4) at stamps (3,) ns, between which tracks continue.

        ``measured`` (2, 6) are the twists [rad/s, m/s] that were measured between them.
        """
        before_s, after_s = (np.diff(t_ns) / NS_PER_S).tolist()
        between_s = 0.5 * (before_s + after_s)
        # This runs at every frame: GTSAM's logarithm of one pose takes a hundredth of NumPy's time.
        before, after = (gtsam.Pose3.Logmap(a.between(b)) for a, b in pairwise(map(gtsam.Pose3, poses)))
        change = np.square(after / after_s - before / before_s) / between_s
        if not self._count:
            self._stated = 2.0 * np.square(self._measured / between_s)
        self._squares = self._squares + np.minimum(change, _MOST_SIGMAS**2 * self._mean_squares)
        self._measured_squares = self._measured_squares + np.square(measured[1] - measured[0]) / between_s
        self._count += 1

    @property
    def is_below_that_measured(self) -> bool:
        """Say whether measured twists change by much more than the body's does, as noisy ones do."""
        rounding = _ROUNDING * self._count * self._stated
        return bool((self._measured_squares > _NOISY * self._squares + rounding).any())

    @property
    def noise(self) -> TwistChangeNoise | None:
        """Return the noise on the change; None before the first change was added."""
        if not self._count:
            return None
        density = np.sqrt(self._mean_squares)
        return TwistChangeNoise(density[3:], density[:3])

    @property
    def _mean_squares(self) -> Array:
        return np.asarray((self._squares + _STATED_FOR * self._stated) / (self._count + _STATED_FOR))


class KeptTwist(NamedTuple):
    """The constraint that two successive intervals, with durations in seconds, have the same twist up to noise.

    It is white noise on the change over the time between the midpoints of the intervals.
    """

    before_s: float
    after_s: float
    noise: TwistChangeNoise

    @property
    def sigmas(self) -> Array:
        """Return the standard deviations (6,) of the change [rad/s, m/s]."""
        density = np.concatenate([self.noise.turn_change_density, self.noise.velocity_change_density])
        return np.asarray(density * np.sqrt(0.5 * (self.before_s + self.after_s)))

    def change(self, poses: Array) -> Array:
        """Return the twist (6,) [rad/s, m/s] from the second to the third of three poses minus that to the second."""
        before, after = (se3_log(step) / dt_s for step, dt_s in self._steps(poses))
        return np.asarray(after - before)

    def derivatives(self, poses: Array) -> Array:
        """Return the Jacobian (6, 18) of the change to three poses (3, 4, 4), each perturbed in its own frame."""
        (by_first, by_second), (by_second_too, by_third) = (_by_ends(*step) for step in self._steps(poses))
        return np.hstack([-by_first, by_second_too - by_second, by_third])

    def _steps(self, poses: Array) -> list[tuple[Array, float]]:
        moved = se3_inverse(poses[:2]) @ poses[1:]
        return [(moved[0], self.before_s), (moved[1], self.after_s)]


class GapBridge:
    """Decides frame by frame where a bridge is added; its noise is estimated from the frames before.

    For estimators that keep states for a limited number of seconds.
    """

    def __init__(self, window_s: float, measured: TwistNoise) -> None:
        self._window_s, self._change = window_s, TwistChange(measured)
        self._frames: list[StereoFrame] = []
        # For each of the last two intervals, whether no track spans it.
        self._blind: list[bool] = []
        self._poses: list[Array] = []
        self._twists: list[Array] = []

    @property
    def noise(self) -> TwistChangeNoise | None:
        """Return the noise on the twist's change so far; None where measured twists are not noisier than the change."""
        return self._change.noise if self._change.is_below_that_measured else None

    def added(self, frame: StereoFrame, motion: Motion | None) -> KeptTwist | None:
        """Return the bridge over the last two intervals that a frame and the motion before it require, or None."""
        self._frames = [*self._frames[-2:], frame]
        self._blind = [*self._blind[-1:], bool(gaps(self._frames[-2:]).size)]
        if isinstance(motion, TwistMotion):
            twists = np.hstack([motion.w_radps, motion.v_mps])
            self._twists = [*self._twists[-1:], np.average(twists, axis=0, weights=motion.dt_s)]
        if len(self._frames) < 3 or not any(self._blind):
            return None
        noise = self.noise
        if noise is None:
            return None
        before_s, after_s = _durations_s(self._frames)
        # States farther apart than the window are never in it together.
        return KeptTwist(before_s, after_s, noise) if before_s <= self._window_s else None

    def learn(self, T_world_imu: Array) -> None:
        """Add the estimated pose (4, 4) of the last frame."""
        self._poses = [*self._poses[-2:], T_world_imu]
        if len(self._poses) == 3 and not any(self._blind):
            t_ns = np.array([frame.t_ns for frame in self._frames])
            self._change.learn(t_ns, np.array(self._poses), np.array(self._twists))


def gap_bridge_for(measured: MotionNoise, window_s: float) -> GapBridge | None:
    """Return the bridge of an estimator that keeps states for ``window_s``; None where no twists are measured."""
    return GapBridge(window_s, measured) if isinstance(measured, TwistNoise) else None


def bridges(frames: Sequence[StereoFrame], noise: TwistChangeNoise) -> dict[int, KeptTwist]:
    """Return the constraints over the gaps of frames (K,), by the index of the last of their three frames."""
    ends = sorted({k for place in gaps(frames).tolist() for k in (place, place + 1) if 2 <= k < len(frames)})
    return {k: KeptTwist(*_durations_s(frames[k - 2 : k + 1]), noise) for k in ends}


def bridged(over: Mapping[int, KeptTwist]) -> gtsam.NonlinearFactorGraph:
    """Return the factors of bridges between the poses X(k) of frames."""
    graph = gtsam.NonlinearFactorGraph()
    for k, kept in over.items():
        graph.add(kept_twist(kept, k))
    return graph


def kept_twist(kept: KeptTwist, k: int) -> gtsam.NonlinearFactor:
    """Return the factor on X(k - 2), X(k - 1), X(k) whose residual (6,) is the change of the twist.

    It is :meth:`KeptTwist.change` with its Jacobian in GTSAM's arithmetic: single matrices are slow in NumPy, and a
    solve evaluates thousands of them.
    """
    lasting_s = (kept.before_s, kept.after_s)

    def residual(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        poses = [values.atPose3(key) for key in this.keys()]  # noqa: SIM118 - not a mapping
        steps = [start.between(end) for start, end in pairwise(poses)]
        logs = [gtsam.Pose3.Logmap(step) for step in steps]
        if jacobians is not None:
            ends = [gtsam.Pose3.LogmapDerivative(log) / dt_s for log, dt_s in zip(logs, lasting_s, strict=True)]
            starts = [-end @ step.inverse().AdjointMap() for end, step in zip(ends, steps, strict=True)]
            jacobians[0], jacobians[1], jacobians[2] = -starts[0], starts[1] - ends[0], ends[1]
        before, after = (log / dt_s for log, dt_s in zip(logs, lasting_s, strict=True))
        return np.asarray(after - before)

    covariance = gtsam.noiseModel.Diagonal.Sigmas(kept.sigmas)
    return gtsam.CustomFactor(covariance, [X(k - 2), X(k - 1), X(k)], residual)


def _durations_s(frames: Sequence[StereoFrame]) -> tuple[float, float]:
    """Return the durations (s) of the two intervals of three frames."""
    before_s, after_s = (np.diff([one.t_ns for one in frames]) / NS_PER_S).tolist()
    return before_s, after_s


def _by_ends(step: Array, dt_s: float) -> tuple[Array, Array]:
    """Return the derivatives (6, 6) of a step's twist by the pose at its start and at its end."""
    by_end = np.asarray(np.linalg.inv(dt_s * se3_right_jacobian(se3_log(step))), dtype=np.float64)
    return -by_end @ se3_adjoint(se3_inverse(step)), by_end
