"""The exponential map that a joint belief moves its poses by, by the compiled kernel; imported only where that runs."""

import numpy as np

from filters.kalman.kernels import exponentials as kernel
from toolkit.geometry import Array

COMPILED = kernel.COMPILED


def exponentials(twists: Array) -> Array:
    """Return the motions (N, 4, 4) of twists (N, 6): ``geometry.se3_exp``, compiled."""
    motions: Array = kernel.exponentials(np.ascontiguousarray(twists))
    return motions
