"""Errors over stretches of one recording: where there are no seeds to repeat it over, its stretches are compared."""

import numpy as np

from toolkit.geometry import Array, se3_inverse
from toolkit.metrics import Evaluation
from toolkit.metrics.parts.scores import Unavailable

# Equal stretches of time that a recording is divided into.
STRETCHES = 40


def no_stretches() -> Array:
    """Return errors over no stretch (40,): NaN."""
    return np.full(STRETCHES, np.nan)


def drift_over_stretches(evaluation: Evaluation) -> Array:
    """Return how far an estimate drifts against the truth over each stretch (40,) m, NaN where it lacks an end of it.

    That is the error of the motion from its first pose to its last, for which nothing is aligned.
    """
    try:
        pairs = evaluation.compared
    except Unavailable:
        return no_stretches()
    first_ns, last_ns = evaluation.sequence.frames_t_ns[[0, -1]].tolist()
    ends_ns = np.linspace(first_ns, last_ns, STRETCHES + 1)
    row = np.rint(np.interp(ends_ns, pairs.t_ns, np.arange(len(pairs)))).astype(int)
    near = np.abs(pairs.t_ns[row] - ends_ns) < 0.5 * (ends_ns[1] - ends_ns[0])
    true_step, step = (se3_inverse(poses[row[:-1]]) @ poses[row[1:]] for poses in (pairs.truth, pairs.estimate))
    drift_m = np.linalg.norm(step[:, :3, 3] - true_step[:, :3, 3], axis=1)
    return np.where(near[:-1] & near[1:], drift_m, np.nan)


def held_out_over_stretches(evaluation: Evaluation) -> Array:
    """Return the median error of withheld tracks in each stretch (40,) px, NaN where there is none."""
    rows, errors_px = evaluation.held_out_errors
    t_s = evaluation.sequence.frames_s
    stretch = (STRETCHES * t_s[evaluation.sequence.held_out.frame[rows]] / t_s[-1]).astype(int).clip(max=STRETCHES - 1)
    return np.array([np.median(errors_px[of]) if (of := stretch == k).any() else np.nan for k in range(STRETCHES)])
