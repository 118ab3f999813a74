"""Normalised estimation error squared: compares the errors with the stated covariance.

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4.
"""

import numpy as np

from toolkit.metrics.parts.consistency import PLACED, POSE_DOF, nees_band, nees_over_time
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.scores import Metric, Scores

ORDER = 75
METRICS = (
    Metric(
        "nees_pose_mean",
        "mean normalised error squared of the pose over its 6 degrees of freedom; 1 is consistent",
        "1",
        ("NEES", "pose"),
        best="one",
        table="always",
        over_seeds=True,
        gate_name="consistency (NEES)",
        in_contract=True,
    ),
    Metric(
        "nees_ori_mean",
        "the same of the orientation alone, over its 3 degrees of freedom",
        "1",
        ("NEES", "rot"),
        best="one",
        over_seeds=True,
        in_contract=True,
    ),
    Metric(
        "nees_pos_mean",
        "the same of the position alone, over its 3 degrees of freedom",
        "1",
        ("NEES", "pos"),
        best="one",
        over_seeds=True,
        in_contract=True,
    ),
    Metric(
        "nees_pose_in_band_percent",
        "poses whose NEES is within the two-sided 95 % chi-square band of one run (percent)",
        "%",
        ("NEES", "in band"),
        best="most",
        in_contract=True,
    ),
)


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
    return scores.remarked(scores.values, PLACED if nees.placed else "")
