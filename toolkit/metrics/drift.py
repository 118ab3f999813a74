"""End drift: the distance between the last true and estimated positions, over the path."""

import numpy as np

from toolkit.metrics.parts.evaluation import AgainstTruth
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable

ORDER = 40
METRICS = (
    Metric(
        "end_drift_percent",
        "position error at the end with only the first pose placed, over the true path (percent)",
        "%",
        ("end", "drift"),
    ),
)


def score(evaluation: AgainstTruth) -> Scores:
    matched = evaluation.compared
    length_m = float(matched.path_m[-1] - matched.path_m[0])
    if length_m == 0.0:
        raise Unavailable("the matched path has no length")
    off_m = float(np.linalg.norm(evaluation.placed[-1, :3, 3] - matched.truth[-1, :3, 3]))
    return Scores({"end_drift_percent": 100.0 * off_m / length_m})
