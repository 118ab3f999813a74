"""The figures of the KITTI odometry benchmark: drift over segments of 100 to 800 m.

Geiger, Lenz and Urtasun, "Are we ready for autonomous driving?" (CVPR 2012), as its development kit computes
them: segments start at every tenth pose, end at the first pose whose distance along the truth exceeds the length,
and their errors are divided by the nominal length; the mean is over all segments of all lengths.
"""

import numpy as np

from toolkit.geometry import Array
from toolkit.metrics.parts.against_truth import AgainstTruth, angles_deg, lengths, relative_errors
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable

ORDER = 30
METRICS = (
    Metric(
        "kitti_t_percent", "mean translation error over segments of 100 ... 800 m (percent)", "%", ("KITTI", "trans")
    ),
    Metric(
        "kitti_r_deg_per_m", "mean rotation error over segments of 100 ... 800 m (deg/m)", "deg/m", ("KITTI", "rot")
    ),
)
SEGMENT_LENGTHS_M = np.arange(100.0, 801.0, 100.0)
START_EVERY = 10


def score(evaluation: AgainstTruth) -> Scores:
    """Score both figures of the benchmark."""
    t_per_m, r_deg_per_m = _errors_per_m(evaluation)
    return Scores({"kitti_t_percent": 100.0 * float(t_per_m.mean()), "kitti_r_deg_per_m": float(r_deg_per_m.mean())})


def _errors_per_m(evaluation: AgainstTruth) -> tuple[Array, Array]:
    """Return translation (s,) m/m and rotation (s,) deg/m of every segment."""
    matched = evaluation.oriented
    starts = np.arange(0, len(matched), START_EVERY)
    first, length_m = (grid.ravel() for grid in np.meshgrid(starts, SEGMENT_LENGTHS_M, indexing="ij"))
    last = np.searchsorted(matched.path_m, matched.path_m[first] + length_m, side="right")
    complete = last < len(matched)
    if not complete.any():
        raise Unavailable(f"the matched path, {matched.path_m[-1] - matched.path_m[0]:.1f} m, has no segment of 100 m")
    errors = relative_errors(matched, first[complete], last[complete])
    return lengths(errors[:, :3, 3]) / length_m[complete], angles_deg(errors[:, :3, :3]) / length_m[complete]
