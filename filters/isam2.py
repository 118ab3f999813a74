"""Incremental full smoother: every state and landmark kept, re-solved only where new factors reach (iSAM2, GTSAM).

What it approximates, frame by frame (Kaess et al. 2012, "iSAM2: Incremental smoothing and mapping using the Bayes
tree"):

- each frame makes one Gauss-Newton step;
- recent states are relinearised together, once one of them has moved by a threshold, and a landmark once its predicted
  image has moved, instead of at every iteration;
- a variable on which none of the last 30 frames has a factor is not relinearised, and after 60 frames its marginal
  replaces it in the tree.

The causal answer is the newest state. For the final answer everything is relinearised until the error no longer falls,
which gives the optimum of all factors in the graph. A landmark is dropped, and the log says so, if it falls behind the
camera, makes the system indeterminate, or has more sightings rejected by its gate than it was built from while the
rejected ones agree.
"""

from dataclasses import replace

import gtsam
import numpy as np

from filters.smoothing.graph_builder import GraphBuilder, GraphExtension
from filters.smoothing.indeterminate import Recovery, with_covariances
from filters.smoothing.isam2_tree import Isam2Tree, linearised_badly
from filters.smoothing.levenberg_marquardt import FirstImages, Stopping, solve
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import Array
from toolkit.measurements import Packet
from toolkit.models.factors import L, landmark_keys

CITES = ("kaess2012isam2", "gtsam")
RUNG, CHANGE = 110, "+ every state and landmark kept; one step a frame, old variables frozen"
RULES = {"window": "it keeps every state"}
INGREDIENTS = (
    "landmark uncertainty",
    "biases",
    "cross-covariances",
    "consistent linearisation",
    "past poses",
    "long-lived landmarks",
    "relinearisation",
    "whole past",
    "the future",
)
WITHOUT = {"biases": {"noise.biases": "fixed"}, "the future": {"output": "causal"}}

# A landmark tens of kilometres away never stops moving, although no pose moves with it: the last solve converges by
# the criterion of `batch`.
_LAST_STOPPING = Stopping(enough=1e-4)


def build(setup: Setup) -> Estimator:
    return Isam2(setup)


class Isam2:
    """Adds a packet to the tree and reads the newest state; at the end it reads all states."""

    def __init__(self, setup: Setup) -> None:
        self._rig, self._progress = setup.rig, setup.progress
        self._builder = GraphBuilder(setup)
        self._tree = Isam2Tree(self._builder.motion, setup.rig.baseline_m)
        self._stamps_ns, self._log = list[int](), list[str]()

    def step(self, packet: Packet) -> Estimate:
        self._note(packet, self._tree.see(landmark_keys(packet.frame.track_ids.tolist())))
        extension = self._builder.extend(packet)
        self._stamps_ns.append(packet.frame.t_ns)
        self._note(packet, self._tree.add(extension.factors, extension.values, extension.state_keys))
        estimate = self._newest(extension, packet)
        in_view = [i for i in sorted(packet.frame.track_ids.tolist()) if self._tree.has(L(i))]
        points = dict(zip(in_view, self._tree.points(landmark_keys(in_view)), strict=True))
        self._relinearise(points, estimate)
        seen = {i: points[i] for i in extension.landmark_ids if i in points}
        self._builder.update(estimate, seen)
        self._drop_landmarks(seen, packet)
        return estimate

    def finish(self) -> Finished:
        """Relinearise all until the error no longer falls, and return every state and landmark."""
        graph, motion = self._tree.graph(), self._builder.motion
        images = FirstImages.in_graph(graph, self._rig)
        values, _, _, converged, _ = solve(graph, self._tree.values(), _LAST_STOPPING, self._progress, landmarks=images)
        states = [motion.read(values, k, t_ns) for k, t_ns in enumerate(self._stamps_ns)]
        trajectory, log = with_covariances(Trajectory.of(states), graph.linearize(values), motion)
        landmarks = Landmarks.of(self._points(values))
        return Finished(trajectory, landmarks, converged, (*self._log, *log))

    def _points(self, values: gtsam.Values) -> dict[int, Array]:
        return {gtsam.Symbol(key).index(): values.atPoint3(key) for key in self._tree.landmarks()}

    def _relinearise(self, in_view: dict[int, Array], estimate: Estimate) -> None:
        """Mark the landmarks (3,) m in view, by ascending id, that are too far from where they are linearised."""
        keys, now = landmark_keys(in_view), np.array(list(in_view.values())).reshape(-1, 3)
        rows = np.flatnonzero(linearised_badly(now, self._tree.linearised_at(keys), estimate.T_world_imu, self._rig))
        self._tree.relinearise(keys[row] for row in rows)

    def _newest(self, extension: GraphExtension, packet: Packet) -> Estimate:
        values = self._tree.read(extension.state_keys)
        estimate = self._builder.motion.read(values, packet.index, packet.frame.t_ns)
        cov = self._builder.motion.state_cov(self._tree.isam, packet.index, estimate.T_world_imu[:3, :3])
        return replace(estimate, cov=cov)

    def _drop_landmarks(self, seen: dict[int, Array], packet: Packet) -> None:
        why = {i: reason for i, reason in self._builder.to_drop(seen).items() if self._tree.has(L(i))}
        if why:
            self._note(packet, self._tree.drop(map(L, why)).after(why))

    def _note(self, packet: Packet, recovery: Recovery) -> None:
        """Log a recovery; a landmark that it dropped is started again from its next sighting."""
        self._log += [f"frame {packet.index}: {line}" for line in recovery.log]
        self._builder.forget(recovery.dropped)
