"""The correlation of the two one-step residuals between three sightings of a track, about the camera's own motion."""

import numpy as np

from toolkit.audit.parts.one_step import OneStep
from toolkit.audit.parts.robust import MAD_TO_SIGMA, Scalar
from toolkit.geometry import Array
from toolkit.jackknife import jackknife_error
from toolkit.sequence import Sequence

# Residuals beyond so many robust standard deviations are left out: mismatches and what moves are no noise.
USUAL = 3.0
LEAST_TRIPLES = 300
# Of a standard deviation: with less, tracks are without errors.
_NO_ERROR = 1e-6


def step_correlation(sequence: Sequence, steps: OneStep) -> Scalar | None:
    """Return the correlation of neighbouring one-step residuals and its standard error; None of too few, or of none."""
    first, second = _neighbouring_residuals(sequence, steps)
    if len(first) < LEAST_TRIPLES or not (first.any() and second.any()):
        return None
    return Scalar(_correlation(first, second), jackknife_error(_correlation, first, second))


def _neighbouring_residuals(sequence: Sequence, steps: OneStep) -> tuple[Array, Array]:
    """Return whitened residuals (T, 3), the usual ones, of the two steps between three sightings of a track."""
    whitened = np.linalg.solve(np.linalg.cholesky(steps.cov_px2), steps.residual_px[:, :, None])[..., 0]
    sigma = MAD_TO_SIGMA * np.median(np.abs(whitened), axis=0)
    scaled = whitened / np.maximum(sigma, _NO_ERROR)
    step_from = np.full(len(sequence.observations), -1)
    step_from[steps.before] = np.arange(len(steps.before))
    following = step_from[steps.after]
    first = np.flatnonzero(following >= 0)
    pair = np.stack([scaled[first], scaled[following[first]]])
    return tuple(pair[:, (np.abs(pair) < USUAL).all(axis=(0, 2))])


def _correlation(first: Array, second: Array) -> float:
    return float((first * second).sum() / (0.5 * (first**2 + second**2).sum()))
