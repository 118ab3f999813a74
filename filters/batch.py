"""Full smoother: Levenberg-Marquardt over all poses and landmarks at once, answering at the end (GTSAM).

What it approximates: only the noise, by its stated model. Every measurement is relinearised at every iteration
(Dellaert & Kaess 2017, "Factor Graphs for Robot Perception", chapter 2). The solver starts from the trajectory of
msckf-fej and from landmarks mapped along it: from a start that has diverged, that is dead-reckoned or whose covariance
is too small it converges to poor local minima. The window of that causal pass is as short with an IMU as without one,
because the solver finds what a longer window would add.
"""

import gtsam
import numpy as np

from filters.kalman.correction import KnownPoseMapper
from filters.kalman.linearisation import AtFirstEstimates
from filters.kalman.sliding_window import SlidingWindowFilter
from filters.smoothing.indeterminate import with_covariances
from filters.smoothing.robust_schedule import MotionFactors, seen_ids, solve_robustly, worth_smoothing
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import IntArray
from toolkit.models.factors import L
from toolkit.models.motion import motion_model
from toolkit.models.stacked_factors import stacked
from toolkit.sequence import Packet

CITES = ("dellaert2017factor", "gtsam")
RUNG, CHANGE = 120, "+ all relinearised to convergence at the end: Huber, Cauchy, cut"
RULES = {"window": "it keeps every state"}
DEFAULT = True


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return Batch(setup)


class Batch:
    """Keeps every packet and solves for all of them in the end."""

    def __init__(self, setup: Setup) -> None:
        self._rig, self._outliers, self._progress = setup.rig, setup.settings.outliers, setup.progress
        self._motion = motion_model(setup.noise, setup.gravity_world)
        self._first_belief = self._motion.initial_belief(setup.prior)
        window_s = setup.settings.window.seconds("twist")
        self._causal_pass = SlidingWindowFilter(setup, AtFirstEstimates(), window_s=window_s)
        self._map = KnownPoseMapper(setup.rig, self._outliers.gate_probability)
        self._packets: list[Packet] = []
        self._estimates: list[Estimate] = []

    def step(self, packet: Packet) -> None:
        """Keep the packet and step the causal pass; there is no answer before the end."""
        self._packets.append(packet)
        self._estimates.append(self._causal_pass.step(packet))
        self._map.add(packet.frame, self._estimates[-1].T_world_imu)

    def finish(self) -> Finished:
        """Solve for every state and landmark, and for the covariance of every state."""
        known = self._map.landmarks()
        all_frames = [packet.frame for packet in self._packets]
        track_ids = worth_smoothing(all_frames, known)
        frames = [frame.select(np.isin(frame.track_ids, track_ids)) for frame in all_frames]
        start = self._start(known, track_ids)
        smoothed = solve_robustly(self._motion_factors(), frames, self._rig, start, self._outliers, self._progress)
        values = smoothed.solution.values
        states = [self._motion.read(values, p.index, p.frame.t_ns) for p in self._packets]
        trajectory, log = with_covariances(Trajectory.of(states), smoothed.graph.linearize(values), self._motion)
        landmarks = Landmarks.of({i: values.atPoint3(L(i)) for i in seen_ids(smoothed.frames)})
        return Finished(trajectory, landmarks, smoothed.solution.converged, log)

    def _motion_factors(self) -> MotionFactors:
        """Return the prior and the motion factors, preintegrated about the causal pass's last bias."""
        graph = self._motion.hold(self._first_belief, 0)
        best_bias = self._estimates[-1].bias
        assert best_bias is not None
        moved = {packet.index: packet.motion for packet in self._packets if packet.motion is not None}
        increments = {k: self._motion.integrate(motion, best_bias) for k, motion in moved.items()}
        for k, increment in increments.items():
            graph.push_back(increment.factors(k))
        return MotionFactors(graph, stacked(increments))

    def _start(self, known: Landmarks, track_ids: IntArray) -> gtsam.Values:
        values = gtsam.Values()
        for packet, estimate in zip(self._packets, self._estimates, strict=True):
            self._motion.insert(values, estimate, packet.index)
        rows = np.searchsorted(known.track_ids, track_ids)
        for track_id, point in zip(track_ids.tolist(), known.points_world[rows], strict=True):
            values.insert(L(track_id), point)
        return values
