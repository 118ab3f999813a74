"""How the figures lay estimates over the truth: with the metrics' own pairs and fits.

With an IMU the vertical is measured and only heading and position are fitted (the fit of ate_yaw_m); from twists
alone an estimator does not know the vertical, and a whole rigid motion is fitted (that of ate_se3_m).
"""

from typing import NamedTuple

import numpy as np

from toolkit.estimate import Output, Run, Trajectory
from toolkit.experiment.comparison import Comparison
from toolkit.geometry import Array, IntArray, yaw_of
from toolkit.metrics import Evaluation
from toolkit.metrics._shared.alignment import Alignment, fit_se3, fit_yaw
from toolkit.metrics._shared.association import associate, median_period_ns
from toolkit.metrics._shared.scores import Unavailable
from toolkit.sequence import Sequence, Truth

NOT_ALIGNED = Alignment(np.eye(3), np.zeros(3))


class Errors(NamedTuple):
    """Errors at stamps (N,) and paths (N,) m: distance (N,) m and heading (N,) degrees within +-180."""

    t_ns: IntArray
    path_m: Array
    position_m: Array
    heading_deg: Array


class Answer(NamedTuple):
    """A trajectory that others are measured against where there is no truth, and how to call it."""

    name: str
    trajectory: Trajectory


def last_good_answer(comparison: Comparison) -> Answer | None:
    """Return the last trajectory made here of a run that is ok: with the defaults, the smoother's.

    Only where there is none is it one that was read from a file; None where no run is ok.
    """
    made_here_last = sorted(comparison.rows, key=lambda row: row.run.timings is not None)
    for row in reversed(made_here_last):
        trajectory = row.run.trajectory(row.output)
        if row.status == "ok" and trajectory is not None:
            return Answer(f"{row.estimator} {row.output}", trajectory)
    return None


def truth_during(sequence: Sequence) -> Truth | None:
    """Return the truth while the camera ran, or None where there is none."""
    if sequence.truth is None:
        return None
    t_ns = sequence.truth.t_ns
    during = (t_ns >= sequence.frames_t_ns[0]) & (t_ns <= sequence.frames_t_ns[-1])
    return Truth(t_ns[during], sequence.truth.T_world_imu[during]) if during.any() else None


def onto_truth(run: Run, output: Output, sequence: Sequence) -> Alignment:
    """Return the fit of a run to the truth, or no alignment where there is no truth or no fit."""
    fit = fit_yaw if sequence.motion_kind == "imu" else fit_se3
    try:
        pairs = Evaluation(run, output, sequence).compared
        return fit(pairs.truth[:, :3, 3], pairs.estimate[:, :3, 3])
    except Unavailable:
        return NOT_ALIGNED


def alignment_words(sequence: Sequence) -> str:
    """Say how a figure's estimates are aligned."""
    if sequence.truth is None:
        return "There is no truth; every estimator starts from the same pose and nothing is aligned."
    how = "yaw and position" if sequence.motion_kind == "imu" else "SE(3)"
    return f"Estimates are aligned to the truth by {how}."


def errors_to(reference: Truth, trajectory: Trajectory, alignment: Alignment, sequence: Sequence) -> Errors | None:
    """Return the errors of an aligned trajectory at the reference's stamps, or None where it reaches none."""
    pairs = associate(trajectory, reference, median_period_ns(sequence.frames_t_ns))
    if not len(pairs):
        return None
    aligned = alignment.apply(pairs.estimate)
    heading = yaw_of(aligned[:, :3, :3]) - yaw_of(pairs.truth[:, :3, :3])
    return Errors(
        pairs.t_ns,
        pairs.path_m,
        np.linalg.norm(aligned[:, :3, 3] - pairs.truth[:, :3, 3], axis=1),
        np.degrees((heading + np.pi) % (2.0 * np.pi) - np.pi),
    )
