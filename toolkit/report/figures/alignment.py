"""How the figures lay estimates over the truth: the metrics' own pairs and their fit of yaw and position."""

from typing import NamedTuple

import numpy as np

from toolkit.estimate import Output, Run, Trajectory
from toolkit.geometry import Array, IntArray, yaw_of
from toolkit.metrics import Judged
from toolkit.metrics.common.alignment import Alignment, fit_yaw
from toolkit.metrics.common.association import associate, median_period_ns
from toolkit.metrics.common.scores import Unavailable
from toolkit.sequence import Sequence, Truth

NOT_ALIGNED = Alignment(np.eye(3), np.zeros(3))


class Errors(NamedTuple):
    """Errors at stamps (N,): distance (N,) m and heading (N,) degrees within +-180."""

    t_ns: IntArray
    position_m: Array
    heading_deg: Array


def truth_during(sequence: Sequence) -> Truth | None:
    """Return the truth while the camera ran, or None where there is none."""
    if sequence.truth is None:
        return None
    t_ns = sequence.truth.t_ns
    during = (t_ns >= sequence.frames_t_ns[0]) & (t_ns <= sequence.frames_t_ns[-1])
    return Truth(t_ns[during], sequence.truth.T_world_imu[during]) if during.any() else None


def onto_truth(run: Run, output: Output, sequence: Sequence) -> Alignment:
    """Return the fit of yaw and position behind ate_yaw_m, or no alignment where it cannot be computed."""
    try:
        pairs = Judged(run, output, sequence).compared
        return fit_yaw(pairs.truth[:, :3, 3], pairs.estimate[:, :3, 3])
    except Unavailable:
        return NOT_ALIGNED


def errors_to(reference: Truth, trajectory: Trajectory, alignment: Alignment, sequence: Sequence) -> Errors | None:
    """Return the errors of an aligned trajectory at the reference's stamps, or None where it reaches none."""
    pairs = associate(trajectory, reference, median_period_ns(sequence.frames_t_ns))
    if not len(pairs):
        return None
    aligned = alignment.apply(pairs.estimate)
    heading = yaw_of(aligned[:, :3, :3]) - yaw_of(pairs.truth[:, :3, :3])
    return Errors(
        pairs.t_ns,
        np.linalg.norm(aligned[:, :3, 3] - pairs.truth[:, :3, 3], axis=1),
        np.degrees((heading + np.pi) % (2.0 * np.pi) - np.pi),
    )
