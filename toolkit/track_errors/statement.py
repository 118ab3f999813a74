"""Tests whether a stated noise of tracks can be that of a recording's tracks, without truth.

A point is triangulated from one sighting and projected into the next frame by the camera's own best motion. It differs
from the sighting there by J e - e', with the errors e and e' of both sightings. This is small where the errors are the
same and J is near the identity. Where it is far larger than a stated noise allows, an estimator that uses this noise
rejects sound tracks as mismatches, and gives too much weight to tracks that pass its gate.
"""

import numpy as np

from toolkit.audit.parts.intervals import is_comparable
from toolkit.audit.parts.one_step import OneStep, one_step
from toolkit.geometry import Array
from toolkit.models.camera_motion import camera_motion
from toolkit.models.correlated_noise import walked_variance
from toolkit.models.gating import mahalanobis_squared
from toolkit.sequence import Sequence
from toolkit.track_noise import CHANNELS, TrackNoise

# Chosen by looking at recordings: tracks scatter 0.6 to 1.1 times as much as the drawn or fitted noise predicts, and
# 4.3 and 4.5 times as much as the noise of another recording predicts.
MOST_SCATTER = 2.0
# With fewer neighbouring sightings their median is too uncertain.
FEWEST_PAIRS = 30
# Median of a chi-square variable with three degrees of freedom.
_MEDIAN_CHI2 = 2.366


def scatter_over(noise: TrackNoise, sequence: Sequence) -> float | None:
    """Return the ratio of the tracks' scatter from frame to frame to that of a noise; 1 for their own noise.

    The ratio is that of the medians, which mismatches do not change. None where too few tracks determine the camera's
    motion, or where the recording cannot be run.
    """
    if not is_comparable(sequence):
        return None
    steps = one_step(sequence, camera_motion(sequence))
    if len(steps.before) < FEWEST_PAIRS:
        return None
    chi2 = mahalanobis_squared(steps.residual_px, _cov_px2(noise, sequence, steps))
    return float(np.sqrt(np.median(chi2) / _MEDIAN_CHI2))


def contradicted(noise: TrackNoise, sequence: Sequence) -> str | None:
    """Return a line that says how the tracks contradict a stated noise that is too small, or None."""
    scatter = scatter_over(noise, sequence)
    if scatter is None or scatter < MOST_SCATTER:
        return None
    return (
        f"from frame to frame the tracks scatter {scatter:.1f} times as much as the noise of tracks that was stated: "
        "estimators give them far too much weight, and the filters' gate rejects most; noise.tracks=fitted finds "
        "their own"
    )


def _cov_px2(noise: TrackNoise, sequence: Sequence, steps: OneStep) -> Array:
    """Return the covariance (P, 3, 3) px^2 of the residuals: of both sightings' common error and their own errors."""
    seen = sequence.observations
    _, track, counts = np.unique(seen.track_id, return_inverse=True, return_counts=True)
    first = np.full(counts.size, np.iinfo(np.int64).max)
    np.minimum.at(first, track, seen.frame)
    shared = walked_variance(noise, (seen.frame - first[track])[steps.before])
    white, step = np.square(noise.white_px), np.square(noise.walk_px)
    to_uv = np.linalg.inv(CHANNELS)
    apart, alone = (np.eye(3) - steps.jacobian) @ to_uv, steps.jacobian @ to_uv
    return np.asarray(
        (apart * shared[:, None, :]) @ apart.swapaxes(1, 2)
        + (alone * white) @ alone.swapaxes(1, 2)
        + (to_uv * (white + step)) @ to_uv.T
    )
