"""Normalised innovation squared: compares the innovations with their stated covariance.

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4. An
innovation that passes a chi-square gate is a truncated variable: the sum is divided by the mean of that
(:func:`toolkit.models.gating.mean_below_bound`) if the estimator reports it, and otherwise by the degrees of freedom.
"""

from toolkit.metrics.parts.consistency import INNOVATIONS_ARE_CAUSAL, nis_over_time
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.scores import Metric, Scores, evaluate

ORDER = 70
CAUSAL_ONLY = INNOVATIONS_ARE_CAUSAL
METRICS = (
    Metric(
        "nis_mean",
        "sum of the normalised innovations squared over what is expected behind the gate; 1 is consistent",
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
    return evaluate({"nis_mean": lambda: nis_over_time(evaluation).mean})
