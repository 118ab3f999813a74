"""How much of the sequence the other numbers speak of."""

import numpy as np

from toolkit.metrics.common.judged import Judged
from toolkit.metrics.common.scores import Scores, Unavailable, evaluate

ORDER = 80
METRICS = {
    "coverage_percent": "frames with a finite pose, of those within the truth's time range if there is one (percent)",
    "pairs": "matched pairs of true and estimated poses (count)",
}


def score(judged: Judged) -> Scores:
    """Score coverage and count the matched pairs."""
    return evaluate({"coverage_percent": lambda: _coverage_percent(judged), "pairs": lambda: len(judged.matched)})


def _coverage_percent(judged: Judged) -> float:
    if not judged.counted_frames.any():
        raise Unavailable("no frame lies in the time range of the ground truth")
    return 100.0 * float(np.mean(judged.has_pose[judged.counted_frames]))
