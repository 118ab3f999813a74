"""Whether a noise of tracks that somebody states can be that of a recording's tracks, without truth.

About the camera's own best motion a point triangulated from one sighting and projected into the next frame misses the
sighting there by J e - e', which is little where both share their error and see the point alike (J near the identity).
Where it is far more than a stated noise allows, an estimator that is told the noise takes sound tracks for mismatches,
and what passes its gate for far more than it tells.
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

# Chosen by looking at recordings: they scatter 0.6 to 1.1 times as much as the noise that was drawn or fitted says, and
# 4.3 and 4.5 times as much as one that is not theirs.
MOST_SCATTER = 2.0
# A median of fewer neighbouring sightings says little.
FEWEST_PAIRS = 30
# What half of all chi-square variables of three degrees of freedom exceed.
_MEDIAN_CHI2 = 2.366


def scatter_over(noise: TrackNoise, sequence: Sequence) -> float | None:
    """Return how many times as much as a noise says the tracks scatter from frame to frame: 1 where it is theirs.

    By the median, which mismatches do not move. None where too few tracks determine the camera's motion, or where the
    recording cannot be run.
    """
    if not is_comparable(sequence):
        return None
    steps = one_step(sequence, camera_motion(sequence))
    if len(steps.before) < FEWEST_PAIRS:
        return None
    chi2 = mahalanobis_squared(steps.residual_px, _cov_px2(noise, sequence, steps))
    return float(np.sqrt(np.median(chi2) / _MEDIAN_CHI2))


def contradicted(noise: TrackNoise, sequence: Sequence) -> str | None:
    """Return how the tracks contradict a noise that is stated too small, in a line, or None."""
    scatter = scatter_over(noise, sequence)
    if scatter is None or scatter < MOST_SCATTER:
        return None
    return (
        f"from frame to frame the tracks scatter {scatter:.1f} times as much as the noise of tracks that was stated: "
        "estimators trust them far too much, and the filters' gate rejects most; noise.tracks=fitted finds their own"
    )


def _cov_px2(noise: TrackNoise, sequence: Sequence, steps: OneStep) -> Array:
    """Return the covariance (P, 3, 3) px^2 of the residuals: of what both sightings share, and what is new in each."""
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
