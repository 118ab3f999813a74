"""How much a sighting of a track counts for, by how alike the residuals of its successive sightings are.

A tracker takes its error along from image to image, and a filter told white noise takes every sighting of such a track
for new. Residuals that are correlated by rho from one sighting to the next carry, as a sum, as much as (1 - rho) /
(1 + rho) times as many independent ones (Bayley & Hammersley 1946, "The 'effective' number of independent observations
in an autocorrelated time series"): for long tracks whose errors are an autoregression of first order that is exact. So
with a variance that is v times the stated one a sighting tells (1 - rho) / (1 + rho) / v of what it is stated to, and
where that is less than all of it, every track corrects with that share of its information; what is an outlier stays a
matter of the stated noise. Noise that was stated large enough for such tracks counts in full. White errors have
residuals that are correlated negatively, by the landmark that was fitted to them, and count in full: a filter whose
noise is as stated stays, to the bit, what it is without.
"""

import numpy as np

from filters.kalman import multiview
from filters.kalman.multiview import TrackSightings
from toolkit.geometry import Array
from toolkit.sequence import StereoRig

# Of three sightings the landmark takes up too much for what is left to say how successive ones are related.
FEWEST_SIGHTINGS = 4
# Chance makes white residuals look correlated once in a thousand: beyond so many standard errors of none they are.
_STANDARD_ERRORS = 3.0
# What counts for less than a hundredth would be no measurement; beyond that another cause is likelier.
_MOST_CORRELATED = 0.98
# What rounds to the full information is none to speak of.
_MOST_TOLD = 0.95


class ResidualCorrelation:
    """Measures over a run the correlation of a track's residuals from one sighting to the next, if it ``matches``."""

    def __init__(self, rig: StereoRig, matches: bool = True) -> None:
        # Where noise of tracks is stated, their sightings correct with its covariance, which is whole.
        self._rig, self.matches = rig, matches and rig.track_noise is None
        self._products, self._squares, self._pairs = 0.0, 0.0, 0

    @property
    def correlation(self) -> float:
        """Return the correlation so far, 0 unless it is positive beyond chance."""
        if not self._pairs:
            return 0.0
        found = self._products / max(self._squares, np.finfo(float).tiny)
        return float(min(found, _MOST_CORRELATED)) if found > _STANDARD_ERRORS / np.sqrt(self._pairs) else 0.0

    @property
    def share(self) -> float:
        """Return the share of its information that a track counts for: all of it where residuals are not correlated."""
        rho = self.correlation
        return min(1.0, (1.0 - rho) / (1.0 + rho) * self._pairs / self._squares) if rho > 0.0 else 1.0

    @property
    def told(self) -> tuple[str, ...]:
        """Return what a user should know, a line, where tracks do not count in full."""
        if self.share > _MOST_TOLD:
            return ()
        return (
            f"residuals along tracks are correlated, {self.correlation:.2f} from frame to frame, and not white as "
            f"stated: tracks came to count for {self.share:.2f} of their information",
        )

    def learn(self, sightings: TrackSightings, points: Array, poses: Array) -> None:
        """Take in tracks of points (F, 3) that have corrected W poses, as they are corrected (W, 4, 4)."""
        long_enough = sightings.seen.sum(axis=1) >= FEWEST_SIGHTINGS
        if not self.matches or not long_enough.any():
            return
        sightings = sightings.select(long_enough)
        left = residuals_left(sightings, points[long_enough], poses, self._rig)
        both = sightings.seen[:, 1:] & sightings.seen[:, :-1]
        self.add(left[:, :-1][both], left[:, 1:][both])

    def add(self, before: Array, after: Array) -> None:
        """Take in whitened residuals (n, 3) of n sightings, and those of the same tracks a frame later."""
        if not self.matches:
            return
        self._products += float((before * after).sum())
        self._squares += 0.5 * float(np.square(before).sum() + np.square(after).sum())
        self._pairs += 3 * len(before)


def residuals_left(sightings: TrackSightings, points: Array, poses: Array, rig: StereoRig) -> Array:
    """Return the whitened residuals (F, W, 3) of tracks once their landmarks have taken up what they can.

    That is a Gauss-Newton step of the points (F, 3) to first order, the poses (W, 4, 4) as they are.
    """
    seen = multiview.linearise(sightings, points, poses, poses, rig)
    count, window = sightings.seen.shape
    H, residuals = seen.H_point.reshape(count, 3 * window, 3), seen.residuals.reshape(count, 3 * window, 1)
    H_transposed = np.swapaxes(H, 1, 2)
    step = np.linalg.solve(H_transposed @ H, H_transposed @ residuals)
    return np.asarray((residuals - H @ step).reshape(count, window, 3))
