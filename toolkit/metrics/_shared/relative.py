"""Errors of relative motion between pairs of stamps, and how they are summed up."""

import numpy as np

from toolkit.geometry import Array, IntArray, se3_inverse, so3_log
from toolkit.metrics._shared.association import Matched


def relative_errors(matched: Matched, first: IntArray, last: IntArray) -> Array:
    """Return E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) (p, 4, 4) for true poses Q, estimates P and index pairs (p,), (p,).

    Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems" (IROS 2012), eq. 2. Free of any gauge.
    """
    true_motion = se3_inverse(matched.truth[first]) @ matched.truth[last]
    estimated_motion = se3_inverse(matched.estimate[first]) @ matched.estimate[last]
    return se3_inverse(true_motion) @ estimated_motion


def lengths(vectors: Array) -> Array:
    """Return the Euclidean length (...,) of vectors (..., 3)."""
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def angles_deg(rotations: Array) -> Array:
    """Return the rotation angle (...,) in degrees, 0 to 180, of rotations (..., 3, 3)."""
    return np.degrees(lengths(so3_log(rotations)))


def rmse(errors: Array) -> float:
    """Return the root mean square of errors (N,)."""
    return float(np.sqrt(np.mean(errors**2)))
