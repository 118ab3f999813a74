"""One output of one run and the sequence it was made from: what a metric is computed from."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from toolkit.answers import Output, Run
from toolkit.arrays import rows_of
from toolkit.estimate import Trajectory
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.metrics.parts.against_truth import (
    STAMP_TOLERANCE_NS,
    AgainstTruth,
    Matched,
    associate,
    finite_poses,
    median_period_ns,
)
from toolkit.metrics.parts.leave_one_out import errors_left_out
from toolkit.metrics.parts.scores import Unavailable
from toolkit.sequence import Sequence


@dataclass(frozen=True, eq=False)
class Evaluation(AgainstTruth):
    """One output of a run and its sequence; properties raise Unavailable where truth or pairs are missing."""

    run: Run
    output: Output
    sequence: Sequence

    @cached_property
    def estimate(self) -> Trajectory:
        trajectory = self.run.trajectory(self.output)
        if trajectory is None:
            raise ValueError(f"{self.run.estimator} has no {self.output} output to score")
        return trajectory

    @cached_property
    def matched(self) -> Matched:
        if self.sequence.truth is None:
            raise Unavailable("the sequence has no ground truth")
        return associate(self.estimate, self.sequence.truth, median_period_ns(self.sequence.frames_t_ns))

    @property
    def level(self) -> bool:
        return self.sequence.motion_kind == "imu"

    @cached_property
    def poses_of_frames(self) -> Array:
        """The estimated pose of every frame (K, 4, 4), NaN where there is none."""
        frames_t_ns, estimate = self.sequence.frames_t_ns, self.estimate
        poses = np.full((frames_t_ns.size, 4, 4), np.nan)
        row, answered = rows_of(frames_t_ns, estimate.t_ns)
        poses[answered] = estimate.T_world_imu[row[answered]]
        return poses

    @cached_property
    def has_pose(self) -> BoolArray:
        """Whether each frame (K,) has a finite pose."""
        return finite_poses(self.poses_of_frames)

    @cached_property
    def held_out_errors(self) -> tuple[IntArray, Array]:
        """Which sightings (M,) of withheld tracks have views enough, by track, and their errors (M,) px."""
        return errors_left_out(self.sequence.held_out, self.poses_of_frames, self.sequence.rig)

    @cached_property
    def counted_frames(self) -> BoolArray:
        """Which frames (K,) an estimate is due for: those in the truth's time range, or all without a truth."""
        frames_t_ns, truth = self.sequence.frames_t_ns, self.sequence.truth
        if truth is None or truth.t_ns.size == 0:
            return np.ones(frames_t_ns.size, dtype=bool)
        begins = frames_t_ns >= truth.t_ns[0] - STAMP_TOLERANCE_NS
        return np.asarray(begins & (frames_t_ns <= truth.t_ns[-1] + STAMP_TOLERANCE_NS))
