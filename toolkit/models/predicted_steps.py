"""The steps of a trajectory between neighbouring frames, beside what the measured motion makes of their starts."""

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from toolkit.estimate import Trajectory
from toolkit.geometry import Array
from toolkit.measured_motion import Motion, with_noise_scaled
from toolkit.models.motion import belief_at, integrated, motion_model
from toolkit.models.state import Belief, Layout, Prediction
from toolkit.sequence import Sequence


class PredictedStep(NamedTuple):
    """A step between the rows ``start`` and ``end``: the state at its start, its length and what the motion predicts.

    The belief has no covariance: what the trajectory states may not fit the layout of the state.
    """

    start: int
    end: int
    belief: Belief
    dt_s: float
    prediction: Prediction


def layout_of(sequence: Sequence) -> Layout:
    """Return where the blocks of the error state stand that the kind of motion of a sequence needs."""
    return motion_model(sequence.noise, sequence.gravity_world).layout


def predicted_steps(
    trajectory: Trajectory, sequence: Sequence, noise_scale: Array | None = None
) -> Iterator[PredictedStep]:
    """Yield the steps between neighbouring frames of which the trajectory has both. Its stamps must be frames'.

    ``noise_scale`` (N,) is how many times its stated variance the noise of the motion up to each row is taken for.
    """
    model = motion_model(sequence.noise, sequence.gravity_world)
    intervals = list(_intervals(trajectory, sequence))
    if noise_scale is not None:
        intervals = [(start, end, with_noise_scaled(motion, noise_scale[end])) for start, end, motion in intervals]
    beliefs = [belief_at(trajectory, start, model) for start, *_ in intervals]
    increments = integrated(model, [motion for *_, motion in intervals], [belief.bias for belief in beliefs])
    for (start, end, motion), belief, increment in zip(intervals, beliefs, increments, strict=True):
        yield PredictedStep(start, end, belief, float(np.sum(motion.dt_s)), increment.predict(belief))


def _intervals(trajectory: Trajectory, sequence: Sequence) -> Iterator[tuple[int, int, Motion]]:
    """Yield the motions between neighbouring frames of which the trajectory has both, with the rows of these."""
    row_of = {int(t_ns): row for row, t_ns in enumerate(trajectory.t_ns)}
    for before, packet in pairwise(sequence.packets()):
        start, end = row_of.get(before.frame.t_ns), row_of.get(packet.frame.t_ns)
        if start is not None and end is not None and packet.motion is not None:
            yield start, end, packet.motion
