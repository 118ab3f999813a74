"""The robust schedule of a batch solve: a convex loss to get near, a redescending one to settle."""

from dataclasses import dataclass

import gtsam

from filters.graph.levenberg_marquardt import Solution, Stopping, solve
from toolkit.models.factors import StereoFactors
from toolkit.sequence import StereoFrame, StereoRig


@dataclass(frozen=True)
class Stage:
    """One solve of the schedule: its robust loss and when it stops."""

    loss: gtsam.noiseModel.mEstimator.Base
    stopping: Stopping


# Huber first brings every landmark near, mismatched or not; Cauchy then lets the mismatched ones go.
SCHEDULE = (
    Stage(gtsam.noiseModel.mEstimator.Huber.Create(1.5), Stopping(1e-2, 20)),
    Stage(gtsam.noiseModel.mEstimator.Cauchy.Create(2.0), Stopping(1e-4, 60)),
)


def solve_in_stages(
    motion: gtsam.NonlinearFactorGraph, frames: list[StereoFrame], rig: StereoRig, start: gtsam.Values
) -> Solution:
    """Solve the motion factors together with the frames' sightings, once for each stage of the schedule.

    Frame k observes from pose X(k). The solution is that of the last stage; it converged when that stage did.
    """
    values = start
    for stage in SCHEDULE:
        graph = gtsam.NonlinearFactorGraph(motion)
        maker = StereoFactors(rig, stage.loss)
        for k, frame in enumerate(frames):
            for factor in maker.of(frame, k):
                graph.add(factor)
        solution = solve(graph, values, stage.stopping)
        values = solution.values
    return solution
