"""Runs that were made anew on both sides: the test for a system that answers differently each time.

Welch's test on logarithms, one-sided ("The generalization of 'Student's' problem when several different population
variances are involved", Biometrika 34, 1947). Identical runs have no spread to judge by; then the answer is certain.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr, stdtrit

from toolkit.gate.paired import POWER, log_of
from toolkit.geometry import Array

# Fewer runs than this on either side tell nothing of their spread, and are held to the bound alone.
FEWEST_RUNS = 3


@dataclass(frozen=True)
class Spread:
    """The change of the mean logarithm from some runs to others, its standard error and degrees of freedom."""

    change: float
    error: float
    dof: float

    @classmethod
    def of(cls, before: Array, after: Array) -> "Spread":
        """Return the spread between runs before (m,) and after (n,), each of at least FEWEST_RUNS."""
        sides = [log_of(side) for side in (before, after)]
        shares = np.array([0.0 if np.ptp(side) == 0.0 else side.var(ddof=1) / side.size for side in sides])
        of_each = np.array([side.size - 1 for side in sides])
        total = float(shares.sum())
        dof = total**2 / float((shares**2 / of_each).sum()) if total else float(of_each.sum())
        return cls(float(sides[1].mean() - sides[0].mean()), float(np.sqrt(total)), dof)

    def beyond_p(self, margin: float, sign: float) -> float:
        """Return the p-value that the change, up (1) or down (-1), exceeds a margin."""
        excess = sign * self.change - margin
        if self.error == 0.0:
            return 0.0 if excess > 0.0 else 1.0
        return float(stdtr(self.dof, -excess / self.error))

    def seen(self, margin: float, rate: float) -> float:
        """Return the change that one test at ``rate`` sees with 95 % power."""
        return margin + float(stdtrit(self.dof, 1.0 - rate) + stdtrit(self.dof, POWER)) * self.error
