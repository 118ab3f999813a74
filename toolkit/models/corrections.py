"""Corrections of a state by measurements, tested against the covariance by which they reduced the state's.

A consistent estimator's correction of the predicted state has the covariance of the prediction minus that of the
answer, and is independent of earlier corrections: its estimates are a martingale (for innovations Mehra and Peschon
1971, "An innovations approach to fault detection and diagnosis in dynamic systems"). So the sum of several corrections
has as its covariance the sum of their reductions.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from toolkit.geometry import Array
from toolkit.models.state import Belief

# Directions in which a correction reduces the variance by less than this share are not tested: there rounding
# dominates, and in smoothers relinearisation. Six tests wrongly rejected a sound IMU, all by directions with shares
# below 4e-4.
LEAST_TAKEN = 1e-3


class CorrectionTest(NamedTuple):
    """The squared Mahalanobis length of a correction; its degrees of freedom are the directions that were corrected."""

    nis: float
    dof: int


@dataclass(frozen=True, eq=False)
class Correction:
    """The error (d,) by which a state was moved, or the sum of several, and the reduction (d, d) of its covariance."""

    moved: Array
    taken: Array

    @classmethod
    def of(cls, before: Belief, after: Belief) -> Self:
        """Return the correction from the belief before the measurements to the one after."""
        return cls(before.error_to(after), before.cov - after.cov)

    def __add__(self, other: "Correction") -> "Correction":
        return Correction(self.moved + other.moved, self.taken + other.taken)

    def test(self, sigma: Array) -> CorrectionTest:
        """Test the correction, its entries in units of ``sigma`` (d,); an entry whose sigma is zero is left out."""
        per_sigma = 1.0 / np.where(sigma > 0.0, sigma, np.inf)
        shares, axes = np.linalg.eigh(per_sigma[:, None] * self.taken * per_sigma)
        # Relinearisation may increase a variance. Directions whose reduction is smaller than that are not tested.
        observed = shares > max(LEAST_TAKEN, -shares[0])
        length = axes[:, observed].T @ (per_sigma * self.moved)
        return CorrectionTest(float((length**2 / shares[observed]).sum()), int(observed.sum()))


def correction_test(before: Belief, after: Belief) -> CorrectionTest:
    """Test the correction of a belief by measurements against the reduction of its covariance."""
    return Correction.of(before, after).test(np.sqrt(np.diag(before.cov)))
