"""Where the run ends: the distance between the last true and estimated positions, over the path."""

import numpy as np

from toolkit.metrics.common.judged import Judged
from toolkit.metrics.common.scores import Scores, Unavailable, evaluate

ORDER = 40
METRICS = {
    "end_drift_percent": "position error at the end with only the first pose placed, over the true path (percent)"
}


def score(judged: Judged) -> Scores:
    """Score the drift at the last matched pair."""
    return evaluate({"end_drift_percent": lambda: _end_drift_percent(judged)})


def _end_drift_percent(judged: Judged) -> float:
    matched = judged.compared
    length_m = float(matched.path_m[-1] - matched.path_m[0])
    if length_m == 0.0:
        raise Unavailable("the matched path has no length")
    return 100.0 * float(np.linalg.norm(judged.placed[-1, :3, 3] - matched.truth[-1, :3, 3])) / length_m
