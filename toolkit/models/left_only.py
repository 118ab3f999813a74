"""Sightings by the left image alone: which of (uL, uR, v) are measured then, and with which noise.

A missing uR (NaN) is treated as measured with an infinite variance: its rows of residual and Jacobian are zero, the
noise of uL and v does not depend on it, and the sighting has two degrees of freedom. A sighting thus keeps three rows,
one of them zero, and code that works on whole frames needs no second path. Where no right image is missing, every
function returns the rig's noise, and three degrees of freedom.
"""

from collections.abc import Callable

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.measurements import StereoRig, is_left_only

_U_RIGHT = 1
_SEEN = np.ix_([0, 2], [0, 2])


def any_missing(uvs_px: Array) -> bool:
    """Say whether any of the sightings (..., 3) px lacks the right image."""
    return bool(is_left_only(uvs_px).any())


def degrees_of_freedom(uvs_px: Array) -> int | IntArray:
    """Return how many coordinates sightings (..., 3) px have: 3 if all are complete, else 2 or 3 for each (...)."""
    missing = is_left_only(uvs_px)
    return 3 - missing.astype(np.int64) if missing.any() else 3


def residuals_px(uvs_px: Array, predicted_px: Array) -> Array:
    """Return measured minus predicted (..., 3) px, zero where uR is missing."""
    residuals: Array = uvs_px - predicted_px
    missing = is_left_only(uvs_px)
    if missing.any():
        residuals[..., _U_RIGHT] = np.where(missing, 0.0, residuals[..., _U_RIGHT])
    return residuals


def seen_rows(uvs_px: Array, jacobian: Array) -> Array:
    """Return Jacobians (..., 3, k) of predicted sightings with the row of uR zero where it is missing."""
    missing = is_left_only(uvs_px)
    if not missing.any():
        return jacobian
    result: Array = jacobian.copy()
    result[missing, _U_RIGHT] = 0.0
    return result


def noise_px2(uvs_px: Array, rig: StereoRig) -> Array:
    """Return the noise of sightings: the rig's (3, 3), or one each (..., 3, 3), uncorrelated with a missing uR.

    It is to be used with the rows of :func:`residuals_px` and :func:`seen_rows`, which are zero for a missing uR.
    """
    return _each(uvs_px, rig.cov_uv_px2, left_noise_px2, rig)


def whitener(uvs_px: Array, rig: StereoRig) -> Array:
    """Return the matrices, (3, 3) or (..., 3, 3), that whiten residuals and Jacobians and set a missing row to zero.

    They do not set a row of NaN to zero: residuals must be those of :func:`residuals_px`.
    """
    return _each(uvs_px, rig.whitener, left_whitener, rig)


def left_whitener(rig: StereoRig) -> Array:
    """Return the matrix (3, 3) that whitens a sighting without the right image, the row and column of uR zero."""
    result = np.zeros((3, 3))
    result[_SEEN] = np.linalg.inv(np.linalg.cholesky(left_noise_px2(rig)[_SEEN]))
    return result


def whitened_residuals(uvs_px: Array, predicted_px: Array, rig: StereoRig) -> Array:
    """Return measured minus predicted (..., 3) in standard deviations, zero where uR is missing."""
    return applied(whitener(uvs_px, rig), residuals_px(uvs_px, predicted_px))


def applied(matrix: Array, values: Array) -> Array:
    """Return the product of a matrix (3, 3), or one each (..., 3, 3), with values (..., 3)."""
    return np.asarray(values @ matrix.T if matrix.ndim == 2 else (matrix @ values[..., None])[..., 0])


def left_cov_px2(rig: StereoRig) -> Array:
    """Return the covariance (2, 2) px^2 of (uL, v) in a sighting by the left image alone."""
    return np.asarray(left_noise_px2(rig)[_SEEN])


def left_noise_px2(rig: StereoRig) -> Array:
    """Return the noise (3, 3) with uR uncorrelated. If v is the mean of two rows, one row has the variance of uL."""
    cov_px2 = rig.cov_uv_px2.copy()
    cov_px2[_U_RIGHT, [0, 2]] = cov_px2[[0, 2], _U_RIGHT] = 0.0
    cov_px2[2, 2] = max(cov_px2[2, 2], cov_px2[0, 0])
    return cov_px2


def _each(uvs_px: Array, whole: Array, left: Callable[[StereoRig], Array], rig: StereoRig) -> Array:
    """Return ``whole`` if no right image is missing; else one each, for left-only sightings that of ``left``."""
    missing: BoolArray = is_left_only(uvs_px)
    return np.where(missing[..., None, None], left(rig), whole) if missing.any() else whole
