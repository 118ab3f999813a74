"""Who may speak: the chi-square gate at its 95 % quantile, and the weights of those who speak too loudly."""

import numpy as np
from scipy.special import chdtri

from toolkit.geometry import Array, IntArray

GATE_QUANTILE = 0.95
STEREO_GATE = float(chdtri(3, 1.0 - GATE_QUANTILE))


def gate_at(dof: IntArray) -> Array:
    """Return the chi-square quantile of the gate at each number of degrees of freedom (N,)."""
    return np.asarray(chdtri(dof, 1.0 - GATE_QUANTILE), dtype=float)


# Huber's threshold on the norm of a whitened (uL, uR, v): the median of its chi distribution is 1.54.
HUBER_THRESHOLD = 1.5


def mahalanobis_squared(residuals: Array, covs: Array) -> Array:
    """Return r^T S^-1 r (N,) of residuals (N, d) with covariances (N, d, d)."""
    solved = np.linalg.solve(covs, residuals[..., None])[..., 0]
    distance: Array = np.einsum("ni,ni->n", residuals, solved)
    return distance


def huber_weights(distances_squared: Array) -> Array:
    """Return the weight (N,) in (0, 1] that Huber's loss gives squared whitened residual norms (N,)."""
    weights: Array = np.minimum(1.0, HUBER_THRESHOLD / np.sqrt(np.maximum(distances_squared, 1e-12)))
    return weights
