"""Normalised innovation squared: are the innovations as large as their stated covariance expects?

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4.
"""

import numpy as np

from toolkit.metrics._shared.evaluation import Evaluation
from toolkit.metrics._shared.scores import Metric, Scores, Unavailable, evaluate

ORDER = 70
CAUSAL_ONLY = "innovations belong to the causal output"
METRICS = (
    Metric(
        "nis_mean",
        "sum of the normalised innovations squared over their degrees of freedom; 1 is consistent",
        "1",
        ("NIS", "mean"),
        best="one",
        over_seeds=True,
        gate_name="consistency (NIS)",
        in_contract=True,
    ),
)


def score(evaluation: Evaluation) -> Scores:
    """Score the innovations a causal output reports."""
    return evaluate({"nis_mean": lambda: _nis_per_dof(evaluation)})


def _nis_per_dof(evaluation: Evaluation) -> float:
    nis, dof = evaluation.run.info.get("nis"), evaluation.run.info.get("nis_dof")
    if nis is None or dof is None:
        raise Unavailable("the estimator reports no innovations")
    given = np.isfinite(nis) & np.isfinite(dof) & (dof > 0.0)
    if not given.any():
        raise Unavailable("no step reports an innovation")
    return float(nis[given].sum() / dof[given].sum())
