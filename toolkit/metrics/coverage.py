"""The share of the sequence over which the other metrics are computed."""

import numpy as np

from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable, evaluate

ORDER = 80
METRICS = (
    Metric(
        "coverage_percent",
        "frames with a finite pose, of those within the truth's time range if there is one (percent)",
        "%",
        ("cover", ""),
        name="coverage",
        best="most",
        table="where rows differ",
    ),
    Metric(
        "pairs",
        "matched pairs of true and estimated poses (count)",
        "",
        ("pairs", ""),
        best="",
        table="where rows differ",
        count=True,
    ),
)


def score(evaluation: Evaluation) -> Scores:
    def coverage_percent() -> float:
        if not evaluation.counted_frames.any():
            raise Unavailable("no frame lies in the time range of the ground truth")
        return 100.0 * float(np.mean(evaluation.has_pose[evaluation.counted_frames]))

    return evaluate({"coverage_percent": coverage_percent, "pairs": lambda: len(evaluation.matched)})
