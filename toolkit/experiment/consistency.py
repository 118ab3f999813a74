"""Says whether runs state more certainty than they have, or less: overconfident, timid or consistent.

The NEES of a pose against an independent truth is, in a consistent estimator, a chi-square variable over its 6 degrees
of freedom (Bar-Shalom, Li and Kirubarajan 2001, section 5.4). The poses of a run share their errors in a way nobody
knows, so the band of its mean is derived for the worst: poses that share one error, whose mean scatters as a single
NEES does. However they are correlated, a mean of equally distributed variables scatters no more than one of them
(it is smaller in convex order: Shaked and Shanthikumar, "Stochastic orders", 2007, theorem 3.A.36). Over N seeds,
which are independent, the mean has the band of N. Without such a truth the innovations speak, in the same way: those
of one frame share the error of its pose and count as one stereo sighting; those of different frames of a consistent
filter are independent. Both bands are wide on purpose; docs/metrics.md has what simulated consistent runs make of them.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from toolkit.experiment.units import Scored
from toolkit.metrics._shared.consistency import POSE_DOF, nees_band

Verdict = Literal["consistent", "overconfident", "timid"]
NEES, NIS = "nees_pose_mean", "nis_mean"


@dataclass(frozen=True)
class Consistency:
    """The mean over runs of a metric, 1 on average where consistent, and the band of 95 % of consistent estimators."""

    metric: str
    mean: float
    low: float
    high: float

    @property
    def verdict(self) -> Verdict:
        """Return what the mean says of the stated uncertainty."""
        if self.mean > self.high:
            return "overconfident"
        return "timid" if self.mean < self.low else "consistent"


def consistency_of(runs: Iterable[Scored]) -> Consistency | None:
    """Judge one kind of output of an estimator over one run or several: by NEES where there is one, else by NIS.

    Returns None where neither can be had: no covariance stated, or a final output without an independent truth.
    """
    scored = list(runs)
    nees = [value for one in scored if (value := one.scores.values.get(NEES)) is not None]
    if nees:
        return _judged(NEES, nees, float(POSE_DOF * len(nees)))
    nis = [(value, one.nis_dof) for one in scored if (value := one.scores.values.get(NIS)) is not None and one.nis_dof]
    if not nis:
        return None
    # A mean of n chi-square variables over their degrees of freedom d_i has the variance 2 sum(1 / d_i) / n^2.
    return _judged(NIS, [value for value, _ in nis], len(nis) ** 2 / sum(1.0 / dof for _, dof in nis))


def _judged(metric: str, values: list[float], dof: float) -> Consistency:
    return Consistency(metric, sum(values) / len(values), *nees_band(dof))
