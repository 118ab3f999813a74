"""A trajectory beside the measured motion, and its corrections tested against the covariance that they removed.

A consistent estimator's correction of the predicted state has the covariance of the prediction minus that of the
answer, and is independent of earlier corrections: its estimates are a martingale (for innovations Mehra and Peschon
1971, "An innovations approach to fault detection and diagnosis in dynamic systems"). So the sum of several corrections
has as its covariance the sum of their reductions.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np

from toolkit.estimate import Trajectory
from toolkit.geometry import Array, IntArray
from toolkit.measurements import Motion
from toolkit.models.graph_state import MotionModel
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief, Prediction
from toolkit.sequence import Sequence

# Directions in which a correction reduces the variance by less than this share are not tested: there rounding
# dominates, and in smoothers relinearisation. Six tests wrongly rejected a sound IMU, all by directions with shares
# below 4e-4.
LEAST_TAKEN = 1e-3


@dataclass(frozen=True, eq=False)
class Correction:
    """The error (d,) by which a state was moved, or the sum of several, and the reduction (d, d) of its covariance."""

    moved: Array
    taken: Array

    @classmethod
    def of(cls, before: Belief, after: Belief) -> Self:
        """Return the correction from the belief before the measurements to the one after."""
        return cls(before.error_to(after), before.cov - after.cov)

    def test(self, sigma: Array) -> tuple[float, int]:
        """Return the squared Mahalanobis length of the correction and how many directions were corrected.

        Entries are in units of ``sigma`` (d,); an entry whose sigma is zero is left out.
        """
        per_sigma = 1.0 / np.where(sigma > 0.0, sigma, np.inf)
        shares, axes = np.linalg.eigh(per_sigma[:, None] * self.taken * per_sigma)
        # Relinearisation may increase a variance. Directions whose reduction is smaller than that are not tested.
        observed = shares > max(LEAST_TAKEN, -shares[0])
        length = axes[:, observed].T @ (per_sigma * self.moved)
        return float((length**2 / shares[observed]).sum()), int(observed.sum())


def belief_at(trajectory: Trajectory, rows: int | IntArray, model: MotionModel) -> Belief:
    """Return a state of the trajectory as a belief, or several, stacked; a missing velocity or bias is zero.

    The covariance is zero, because that of the trajectory may have another layout.
    """
    many, d = np.shape(rows), model.layout.size
    v_world = np.zeros((*many, 3)) if trajectory.v_world is None else trajectory.v_world[rows]
    bias = np.zeros((*many, 6)) if trajectory.bias is None else trajectory.bias[rows]
    return Belief(model.layout, trajectory.T_world_imu[rows], v_world, bias, np.zeros((*many, d, d)))


class PredictedSteps(NamedTuple):
    """Steps between the rows ``start`` (S,) and ``end`` (S,): their lengths (S,) and, stacked, the predicted motions.

    ``beliefs`` are the states at their starts, without covariances.
    """

    start: IntArray
    end: IntArray
    dt_s: Array
    beliefs: Belief
    predictions: Prediction


def predicted_steps(trajectory: Trajectory, sequence: Sequence) -> PredictedSteps | None:
    """Return the steps between neighbouring frames of which the trajectory has both, None where there are none.

    Its stamps must be those of frames.
    """
    intervals = list(_intervals(trajectory, sequence))
    if not intervals:
        return None
    model = motion_model(sequence.noise, sequence.gravity_world)
    starts, ends, motions = zip(*intervals, strict=True)
    start, beliefs = np.array(starts), belief_at(trajectory, np.array(starts), model)
    dt_s = np.array([np.sum(motion.dt_s) for motion in motions])
    return PredictedSteps(start, np.array(ends), dt_s, beliefs, model.predict_each(list(motions), beliefs))


def _intervals(trajectory: Trajectory, sequence: Sequence) -> Iterator[tuple[int, int, Motion]]:
    """Yield the motions between neighbouring frames if the trajectory has both, with the rows of these."""
    row_of = {t_ns: row for row, t_ns in enumerate(trajectory.t_ns.tolist())}
    for ends_ns, motion in zip(pairwise(sequence.frames_t_ns.tolist()), sequence.motions(), strict=True):
        start, end = map(row_of.get, ends_ns)
        if start is not None and end is not None:
            yield start, end, motion
