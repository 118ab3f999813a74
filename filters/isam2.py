"""Incremental full smoother: every state and landmark kept, re-solved only where new factors reach (iSAM2, GTSAM).

What it approximates, frame by frame (Kaess et al. 2012, "iSAM2: Incremental smoothing and mapping using the Bayes
tree"):

- each frame makes one Gauss-Newton step;
- recent states are relinearised together, once one of them has moved by a threshold, and a landmark once its predicted
  image has moved, instead of at every iteration;
- a variable on which none of the last 30 frames has a factor is not relinearised, and after 60 frames its marginal
  replaces it in the tree.

The causal answer is the newest state. For the final answer everything is relinearised until the error no longer falls,
which gives the optimum of all factors in the graph. If the residuals there give tracks less weight than they had, it is
solved for once more with that weight. A landmark is dropped, and the log says so, if it falls behind the
camera, makes the system indeterminate, or has more sightings rejected by its gate than it was built from while the
rejected ones agree.

Where the rig states a track noise model, the innovation of each sighting of a track, given the sighting before it, is a
residual of two poses and the landmark (``filters/smoothing/chained_past.py``).
"""

from dataclasses import replace

import gtsam
import numpy as np

from filters.smoothing.chained_past import ChainedPast
from filters.smoothing.graph_builder import LEARNT_AFTER_FRAMES, GraphBuilder, GraphExtension
from filters.smoothing.indeterminate import Recovery, behind_camera, with_covariances
from filters.smoothing.isam2_tree import FROZEN_AFTER_FRAMES, Isam2Tree
from filters.smoothing.landmark_steps import FirstImages
from filters.smoothing.levenberg_marquardt import Stopping, solve
from filters.smoothing.linearisation_error import linearised_badly
from filters.smoothing.robust_schedule import CHAIN_STOPPING
from toolkit.arrays import is_among
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import Array
from toolkit.models.factors import L, X, landmark_keys
from toolkit.models.motion import state_cov
from toolkit.sequence import Packet, StereoFrame

CITES = ("kaess2012isam2", "gtsam")
RUNG, CHANGE = 110, "+ every state and landmark kept, bridge; one step a frame, old variables frozen"
RULES = {"window": "it keeps every state", "bridge_gaps": True, "match_tracks": True}

# A landmark tens of kilometres away never stops moving, although no pose moves with it: the last solve converges by
# the criterion of `batch`.
_LAST_STOPPING = Stopping(enough=1e-4)


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return Isam2(setup)


class Isam2:
    """Adds a packet to the tree and reads the newest state; at the end it reads all states."""

    def __init__(self, setup: Setup) -> None:
        self._rig, self._progress = setup.rig, setup.progress
        self._builder = GraphBuilder(setup)
        self._chained = None
        if setup.rig.track_noise is not None:
            self._chained = ChainedPast(setup.rig, setup.settings.outliers.smoother_huber, FROZEN_AFTER_FRAMES + 1)
        self._tree = Isam2Tree(self._builder.motion, setup.rig.baseline_m, self._chained)
        self._stamps_ns, self._used = list[int](), list[StereoFrame]()
        self._log: list[str] = []

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and return the state at its frame."""
        self._note(packet, self._tree.see(landmark_keys(packet.frame.track_ids.tolist())))
        extension = self._builder.extend(packet)
        self._stamps_ns.append(packet.frame.t_ns)
        self._used.append(packet.frame.select(is_among(packet.frame.track_ids, np.array(extension.landmark_ids))))
        recovery = self._tree.add(extension.factors, extension.values, extension.state_keys, extension.chained)
        self._note(packet, recovery)
        estimate = self._newest(extension, packet)
        in_view = [i for i in sorted(packet.frame.track_ids.tolist()) if self._tree.has(L(i))]
        points = dict(zip(in_view, self._tree.points(landmark_keys(in_view)), strict=True))
        self._relinearise(points, estimate)
        seen = {i: points[i] for i in extension.landmark_ids if i in points}
        self._builder.update(estimate, seen)
        self._learn(packet)
        self._drop_landmarks(seen, estimate, packet)
        return estimate

    def finish(self) -> Finished:
        """Solve for every state and landmark, with the weight that tracks have by their residuals at the solution."""
        graph, values, converged = self._solved(self._tree.graph(), self._tree.values())
        T_world_imu = np.array([values.atPose3(X(k)).matrix() for k in range(len(self._stamps_ns))])
        if self._builder.learn_from_all(self._used, T_world_imu, self._points(values)):
            graph, values, converged = self._solved(graph, values)
        motion = self._builder.motion
        states = [motion.read(values, k, t_ns) for k, t_ns in enumerate(self._stamps_ns)]
        trajectory, log = with_covariances(Trajectory.of(states), graph.linearize(values), motion)
        landmarks = Landmarks.of(self._points(values))
        return Finished(trajectory, landmarks, converged, (*self._builder.log(), *self._log, *log))

    def _solved(
        self, graph: gtsam.NonlinearFactorGraph, start: gtsam.Values
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, bool]:
        """Relinearise all until the error no longer falls; return the graph, the values and whether it converged.

        Chained sightings, which are not in the graph given, are linear in the one returned.
        """
        graph = self._builder.brought_up_to_date(graph)
        beside, stopping = (None, _LAST_STOPPING) if self._chained is None else (self._chained.whole(), CHAIN_STOPPING)
        landmarks = FirstImages.in_graph(graph, self._rig) if beside is None else beside
        solution = solve(graph, start, stopping, self._progress, landmarks=landmarks)
        if beside is not None:
            graph.push_back(beside.linearised(solution.values))
        return graph, solution.values, solution.converged

    def _points(self, values: gtsam.Values) -> dict[int, Array]:
        return {gtsam.Symbol(key).index(): values.atPoint3(key) for key in self._tree.landmarks()}

    def _learn(self, packet: Packet) -> None:
        """Measure the residual correlation of tracks in an earlier frame, whose pose has settled."""
        k = packet.index - LEARNT_AFTER_FRAMES
        if k >= 0:
            poses = self._tree.read([X(k), X(k + 1)])
            self._builder.learn(k, np.array([poses.atPose3(X(i)).matrix() for i in (k, k + 1)]))

    def _relinearise(self, in_view: dict[int, Array], estimate: Estimate) -> None:
        """Mark the landmarks (3,) m in view that are too far from their linearisation points, rejected ones included.

        ``in_view`` is in ascending order of track ids.
        """
        keys, now = landmark_keys(in_view), np.array(list(in_view.values())).reshape(-1, 3)
        rows = np.flatnonzero(linearised_badly(now, self._tree.linearised_at(keys), estimate.T_world_imu, self._rig))
        self._tree.relinearise(keys[row] for row in rows)

    def _newest(self, extension: GraphExtension, packet: Packet) -> Estimate:
        values = self._tree.read(extension.state_keys)
        estimate = self._builder.motion.read(values, packet.index, packet.frame.t_ns)
        cov = state_cov(self._builder.motion, self._tree.isam, packet.index, estimate.T_world_imu[:3, :3])
        return replace(estimate, cov=cov, info=self._builder.info)

    def _drop_landmarks(self, seen: dict[int, Array], estimate: Estimate, packet: Packet) -> None:
        """Drop landmarks behind the camera, where a sighting has no gradient, and those later sightings contradict."""
        points = np.array(list(seen.values())).reshape(-1, 3)
        behind = behind_camera(points, estimate.T_world_imu, self._rig).tolist()
        log = {i: "fell behind the camera" for i, is_behind in zip(seen, behind, strict=True) if is_behind}
        contradicted = {i for i in self._builder.contradicted() if self._tree.has(L(i))}
        log |= dict.fromkeys(contradicted, "was inconsistent with its next sightings")
        if log:
            recovery = self._tree.drop(map(L, log))
            lines = [f"landmark {i} {why} and was dropped" for i, why in sorted(log.items())]
            self._note(packet, Recovery(lines + recovery.log, log.keys() | recovery.dropped))

    def _note(self, packet: Packet, recovery: Recovery) -> None:
        """Log a recovery; a landmark that it dropped is started again from its next sighting."""
        self._log += [f"frame {packet.index}: {line}" for line in recovery.log]
        self._builder.forget(recovery.dropped)
