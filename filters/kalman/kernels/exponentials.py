"""The motions of some twists compiled: ``toolkit.geometry.se3_exp``."""

import numpy as np

from filters.kalman.kernels.compiling import MATRIX, kept, what_was_compiled
from filters.kalman.kernels.rigid_motions import exponential
from toolkit.geometry import Array

SIGNATURE = (MATRIX,)


@kept(SIGNATURE)
def exponentials(twists: Array) -> Array:
    """Return the motions (N, 4, 4) of twists (N, 6), [rotation, translation]."""
    motions = np.empty((twists.shape[0], 4, 4))
    for k in range(twists.shape[0]):
        exponential(twists[k], motions[k : k + 1])
    return motions


COMPILED = what_was_compiled(exponentials, "what moves poses was")
