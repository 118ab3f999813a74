"""What measurements made of a state, against the covariance that they took away.

A consistent estimator's correction of the predicted state has the covariance of the prediction less that of the answer,
and is independent of the corrections before: its estimates are a martingale (for innovations Mehra and Peschon 1971,
"An innovations approach to fault detection and diagnosis in dynamic systems"). So the sum of several corrections has
the sum of what they took away, in whatever direction the state was moved and however its error is carried on.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from toolkit.geometry import Array
from toolkit.models.state import Belief

# Directions in which a correction takes away less of the variance than this are told by rounding, and in smoothers by
# what is linearised anew: of six tests that made a sound IMU doubtful all had their length from shares below 4e-4.
LEAST_TAKEN = 1e-3


class CorrectionTest(NamedTuple):
    """The squared Mahalanobis length of a correction and its degrees of freedom: of what was corrected at all."""

    nis: float
    dof: int


@dataclass(frozen=True, eq=False)
class Correction:
    """The error (d,) that a state was moved by, or the sum of several, and the covariance (d, d) taken away."""

    moved: Array
    taken: Array

    @classmethod
    def of(cls, before: Belief, after: Belief) -> Self:
        """Return what measurements made of the belief before them."""
        return cls(before.error_to(after), before.cov - after.cov)

    def __add__(self, other: "Correction") -> "Correction":
        return Correction(self.moved + other.moved, self.taken + other.taken)

    def test(self, sigma: Array) -> CorrectionTest:
        """Test the correction, its entries in units of ``sigma`` (d,); an entry whose sigma is zero is left out."""
        per_sigma = 1.0 / np.where(sigma > 0.0, sigma, np.inf)
        shares, axes = np.linalg.eigh(per_sigma[:, None] * self.taken * per_sigma)
        # What is linearised anew may add to a covariance; less taken away than was added elsewhere tells nothing.
        observed = shares > max(LEAST_TAKEN, -shares[0])
        length = axes[:, observed].T @ (per_sigma * self.moved)
        return CorrectionTest(float((length**2 / shares[observed]).sum()), int(observed.sum()))


def correction_test(before: Belief, after: Belief) -> CorrectionTest:
    """Test what measurements made of a belief against the covariance that they took away."""
    return Correction.of(before, after).test(np.sqrt(np.diag(before.cov)))
