"""Full smoother linearised once, at the estimates of `ekf-slam`: the past given its future (Rauch et al. 1965).

What it approximates: it is the last solve of `batch`, but one Gauss-Newton step of it from the filter's trajectory and
the landmarks mapped along it: the sightings that are plausible there, every motion and the prior, all with full weight.
Where the problem is linear, that is the batch. What `batch` gains over it is relinearisation, and what it gains over
the filter, whose answers it gives as its causal ones, is the future.
"""

import gtsam

from filters import ekf_slam
from filters.batch import Batch, Smoothed, only_seen, placed_by_stereo, with_sightings, without_those_behind
from filters.smoothing.elimination_order import cheaper_order
from filters.smoothing.levenberg_marquardt import FirstImages, MixedGraph, Solution
from toolkit.estimate import Estimate
from toolkit.estimator import Estimator, Setup
from toolkit.measurements import Packet, StereoFrame
from toolkit.models.factors import StereoFactors

CITES = ("rauch1965maximum", "smith1990estimating", "gtsam")
RUNG, CHANGE = 115, "all states, linearised once, at the estimates of ekf-slam"
RULES = {"window": "it keeps every state"}
INGREDIENTS = (
    "landmark uncertainty",
    "biases",
    "cross-covariances",
    "consistent linearisation",
    "past poses",
    "long-lived landmarks",
    "whole past",
    "the future",
)
WITHOUT = {"biases": {"noise.biases": "fixed"}, "the future": {"output": "causal"}}


def build(setup: Setup) -> Estimator:
    return Rts(setup, ekf_slam.joint_ekf(setup))


class Rts(Batch):
    """Steps the filter, and smooths what it answered at the end."""

    def step(self, packet: Packet) -> Estimate:
        super().step(packet)
        return self._estimates[-1]

    def _solved(self, frames: list[StereoFrame], values: gtsam.Values) -> Smoothed:
        """Take the one step; landmarks are moved in the images of the cameras that saw them first."""
        motion, increments = self._motion_factors()
        order_of = cheaper_order(motion, frames)
        frames = placed_by_stereo(self._plausible(without_those_behind(frames, values, self._rig), values))
        graph = with_sightings(motion, frames, StereoFactors(self._rig))
        problem, start = MixedGraph(graph, increments), only_seen(values, frames)
        step = problem.linear(start).eliminateSequential(order_of(graph, frames)).optimize()
        there = FirstImages.of(frames, self._rig).taken(start, step)
        return Smoothed(Solution(there, problem.error(there), 1, converged=True), graph.linearize(start), frames)
