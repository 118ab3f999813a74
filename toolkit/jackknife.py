"""Standard errors of estimates from dependent data: the estimate is repeated with one stretch left out at a time.

Source: Shao & Tu, "The Jackknife and Bootstrap" (1995), section 2.3: the delete-d jackknife of dependent data.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from toolkit.geometry import Array

# Number of stretches of a recording, of which one at a time is left out. Errors that last for seconds stay within one.
STRETCHES = 10


def jackknife_error(estimate: Callable[..., float], *rows: Array) -> float:
    """Return the standard error of an estimate from arrays (M, ...) in time, leaving out each tenth."""
    return float(np.sqrt(jackknife_cov(lambda *some: np.array([estimate(*some)]), *rows)[0, 0]))


def jackknife_cov(estimate: Callable[..., Array], *rows: Array, stretches: int = STRETCHES) -> Array:
    """Return the covariance (m, m) of an estimate (m,) from arrays (M, ...) in time, M no less than the stretches."""
    ends = [-(-k * len(rows[0]) // stretches) for k in range(stretches + 1)]
    without = np.array(
        [estimate(*(np.concatenate([one[:begin], one[end:]]) for one in rows)) for begin, end in pairwise(ends)]
    )
    off_mean = without - without.mean(axis=0)
    return np.asarray((stretches - 1) / stretches * off_mean.T @ off_mean)
