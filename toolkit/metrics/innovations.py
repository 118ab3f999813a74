"""Innovations: normalised and squared (NIS) against their stated covariance, and the share that the gate accepted.

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4. An
innovation that passes a chi-square gate is a truncated variable: the sum is divided by the mean of that
(:func:`toolkit.models.gating.mean_below_bound`) if the estimator reports it, and otherwise by the degrees of freedom.

The innovations that pass a gate look consistent however wrong the model is; a wrong model shows in the share that is
rejected. Without outliers, the gate of a consistent estimator accepts a share equal to its probability.
"""

import numpy as np

from toolkit.metrics.parts.consistency import INNOVATIONS_ARE_CAUSAL, nis_over_time
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable, evaluate

ORDER = 70
CAUSAL_ONLY = INNOVATIONS_ARE_CAUSAL
ACCEPTED = "gate_accepted_percent"
# Chosen by looking at sound runs (docs/metrics.md): simulated ones accept 94 % or more behind a gate of 99 %.
_LEAST_USUAL_PERCENT = 90.0
METRICS = (
    Metric(
        "nis_mean",
        "sum of the normalised innovations squared over what is expected behind the gate; 1 is consistent",
        "1",
        ("NIS", "mean"),
        best="one",
        over_seeds=True,
    ),
    Metric(
        ACCEPTED,
        "innovations that the outlier gate accepted, of those it tested (percent)",
        "%",
        ("gate", "accepts"),
        name="gate acceptance",
        best="",
    ),
)


def score(evaluation: Evaluation) -> Scores:
    return evaluate(
        {"nis_mean": lambda: nis_over_time(evaluation).mean, ACCEPTED: lambda: _accepted_percent(evaluation)}
    )


def refuses_much(accepted_percent: float) -> bool:
    """Say whether a gate rejected more measurements than a sound model and sound tracks explain."""
    return accepted_percent < _LEAST_USUAL_PERCENT


def _accepted_percent(evaluation: Evaluation) -> float:
    info = evaluation.run.info
    if not {"gate_tested", "gate_accepted"} <= info.keys():
        raise Unavailable("the estimator reports no gate")
    tested = float(np.nansum(info["gate_tested"]))
    if tested <= 0.0:
        raise Unavailable("the gate tested nothing")
    return 100.0 * float(np.nansum(info["gate_accepted"])) / tested
