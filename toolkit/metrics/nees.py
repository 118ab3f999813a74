"""Normalised estimation error squared: is the error as large as the estimator says it is?

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4.
"""

import numpy as np

from toolkit.metrics._shared.consistency import POSE_DOF, nees_band, nees_over_time
from toolkit.metrics._shared.evaluation import Evaluation
from toolkit.metrics._shared.scores import Scores

ORDER = 75
METRICS = {
    "nees_pose_mean": "mean normalised error squared of the pose over its 6 degrees of freedom; 1 is consistent",
    "nees_ori_mean": "the same of the orientation alone, over its 3 degrees of freedom",
    "nees_pos_mean": "the same of the position alone, over its 3 degrees of freedom",
    "nees_pose_in_band_percent": "poses whose NEES is within the two-sided 95 % chi-square band of one run (percent)",
}
_PLACED = "the estimate's world is its own: its first pose was placed on the truth's, whose noise there counts in full"


def score(evaluation: Evaluation) -> Scores:
    """Score the stated covariances of poses against the truth."""
    nees = nees_over_time(evaluation)
    low, high = nees_band(POSE_DOF)
    scores = Scores(
        {
            "nees_pose_mean": float(nees.pose.mean()),
            "nees_ori_mean": float(nees.orientation.mean()),
            "nees_pos_mean": float(nees.position.mean()),
            "nees_pose_in_band_percent": 100.0 * float(np.mean((nees.pose >= low) & (nees.pose <= high))),
        }
    )
    return scores.remarked(METRICS, _PLACED if nees.placed else "")
