"""Tracks whose sightings do not err each by itself: a corner that drifts, or a stereo match that is off for good.

Between three sightings of a track lie two one-step residuals about the camera's own motion. Where sightings err by
themselves, the second's error is in both with opposite signs, and their correlation is -1/2. Where errors are a random
walk, what is new in each is its own, and it is 0; a wrong disparity makes wrong depths, whose residuals are alike. It
is white noise that estimators are told unless a setting or the recording says otherwise.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.intervals import LEAST_INTERVALS
from toolkit.audit.parts.robust import MAD_TO_SIGMA
from toolkit.geometry import Array
from toolkit.jackknife import jackknife_error

# -1 / (2 + w), w a walk's variance a frame over that of the white part: beyond it the walk has more than twice that.
# Simulated white tracks have -0.40 to -0.48, for the camera's motion is fitted to them; real ones 0.1 to 0.9.
MOST_CORRELATION, SIGMAS = -0.25, 5.0
# Residuals beyond so many robust standard deviations are left out: mismatches and what moves are no noise.
USUAL = 3.0
LEAST_TRIPLES = 300
# Of a standard deviation: with less, tracks are without errors.
_NO_ERROR = 1e-6


def check(evidence: Evidence) -> Symptom | None:
    """Tell the correlation of neighbouring one-step residuals where it is not that of independent errors."""
    sequence = evidence.sequence
    if evidence.spoilt_by or sequence.rig.track_noise is not None:
        return None
    if evidence.camera_motion.known.sum() < LEAST_INTERVALS:
        return None
    found = step_correlation(evidence)
    if found is None:
        return None
    value, error = found
    if value < MOST_CORRELATION + SIGMAS * error:
        return None
    return Symptom.information(
        count=1,
        detail=(
            f"the errors of a track's sightings go together: from one step to the next their correlation is "
            f"{value:+.2f} +- {error:.2f}, where it is -0.5 if each errs by itself; to count them as white is too sure"
        ),
        treatment="'vislam card' shows how, noise.tracks=fitted tells them",
    )


def step_correlation(evidence: Evidence) -> tuple[float, float] | None:
    """Return the correlation of neighbouring one-step residuals and its standard error; None of too few, or of none."""
    first, second = _neighbouring_residuals(evidence)
    if len(first) < LEAST_TRIPLES or not (first.any() and second.any()):
        return None
    return _correlation(first, second), jackknife_error(_correlation, first, second)


def err_by_themselves(evidence: Evidence) -> bool:
    """Say whether the sightings of a track err each by itself, beyond doubt."""
    found = step_correlation(evidence)
    return found is not None and found[0] + SIGMAS * found[1] < MOST_CORRELATION


def _neighbouring_residuals(evidence: Evidence) -> tuple[Array, Array]:
    """Return whitened residuals (T, 3), the usual ones, of the two steps between three sightings of a track."""
    steps = evidence.one_step
    whitened = np.linalg.solve(np.linalg.cholesky(steps.cov_px2), steps.residual_px[:, :, None])[..., 0]
    sigma = MAD_TO_SIGMA * np.median(np.abs(whitened), axis=0)
    scaled = whitened / np.maximum(sigma, _NO_ERROR)
    step_from = np.full(len(evidence.sequence.observations), -1)
    step_from[steps.before] = np.arange(len(steps.before))
    following = step_from[steps.after]
    first = np.flatnonzero(following >= 0)
    pair = np.stack([scaled[first], scaled[following[first]]])
    return tuple(pair[:, (np.abs(pair) < USUAL).all(axis=(0, 2))])


def _correlation(first: Array, second: Array) -> float:
    return float((first * second).sum() / (0.5 * (first**2 + second**2).sum()))


FAULT = Fault(
    "correlated-tracks",
    "tracks whose sightings do not err each by itself, as estimators are told unless a setting says otherwise",
    check,
    after=("track-scatter",),
)
