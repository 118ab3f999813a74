"""The weight of a track's sightings, estimated from the correlation of its successive residuals.

A tracker drifts: the error of one image persists in the next. An estimator that assumes white noise takes every
sighting of such a track as new information. Its residuals then correlate from one sighting to the next, by rho, more
than chance makes white residuals correlate. Once that is detected, the information of every track is multiplied by a
share below 1; the outlier gate still uses the stated noise. The share is one over the larger of two design effects,
each of which misses some of the correlation:

- that of long tracks whose errors are a first-order autoregression. With v times the stated variance, a sighting
  carries (1 - rho) / (1 + rho) / v of its stated information (Bayley & Hammersley 1946, "The 'effective' number of
  independent observations in an autocorrelated time series"). It misses the part of the errors that the poses absorb
  where few tracks have corrected them;
- that of the tracks' scores for a drift (:mod:`filters.kalman.track_scores`), over tracks that have ended, at poses
  that will hardly change any more. Early in a run only short tracks have ended, and until there are enough of them
  this design effect is not defined.

If the first design effect does not exceed 1, the stated noise is large enough for such tracks, and they keep their full
weight: a drift in their scores is then the motion's error, not theirs (kitti00, dataset3).

If the residuals of neighbours in an image correlate significantly as well, the share is also divided by the number of
sightings that err together (:mod:`filters.kalman.neighbour_correlation`). This is not done with odometry whose stated
white noise is smaller than the lasting errors that any odometry has: the smaller the weight of the tracks, the more the
path would follow those errors. White errors leave residuals that correlate negatively, because the landmark was fitted
to them, and keep their full weight: where the noise is as stated, a filter's answers are bit-identical with and without
this.
"""

from typing import Self

import numpy as np

from filters.kalman import multiview
from filters.kalman.multiview import TrackSightings
from filters.kalman.neighbour_correlation import NeighbourCorrelation, freed_of_poses
from filters.kalman.track_scores import FEWEST_SIGHTINGS, SOUND, TrackScores
from toolkit.arrays import rows_of
from toolkit.estimator import Setup
from toolkit.geometry import Array, IntArray
from toolkit.measured_motion import MotionNoise, TwistNoise
from toolkit.models import left_only
from toolkit.models.gating import chi2_bound
from toolkit.sequence import StereoFrame, StereoRig

# The correlation counts as significant beyond this many standard errors; chance exceeds it once in a thousand.
_STANDARD_ERRORS = 3.0
# Largest correlation: it gives a sighting a weight of a hundredth. Beyond it another cause is likelier.
_MOST_CORRELATED = 0.98
# Odometry with less white noise (m/s/sqrt(Hz)) is stated to be more accurate over a second than wheels and cameras are
# calibrated, 1 % of 5 m/s. Chosen between the noise assumed for odometry that looks noise-free (0.016 at 10 Hz) and
# that of the course's odometry (0.17).
_LEAST_WHITE_NOISE = 0.05
# A larger share is not reported to the user.
_MOST_REPORTED = 0.95
# Least correlation that counts for landmarks in the state. Gates, robust weights and linearisation correlate the
# residuals of landmarks with white noise, however many there are: by up to 0.07 for thousands of residuals, on drive,
# flight and exports of OpenVINS. Tracks with a random-walk error are beyond 0.5.
_LEAST_OF_LANDMARKS = 0.15


class ResidualCorrelation:
    """Measures over a run the correlation of a track's residuals from one sighting to the next, if ``matches``."""

    _of, _least = "tracks", 0.0

    def __init__(self, rig: StereoRig, matches: bool = True, counts_neighbours: bool = True) -> None:
        # With a stated track noise model, sightings already correct with its full covariance.
        self._rig, self.matches = rig, matches and rig.track_noise is None
        self._counts_neighbours = counts_neighbours
        self._products, self._squares, self._pairs = 0.0, 0.0, 0
        self._neighbours, self._scores = NeighbourCorrelation(), TrackScores(rig)

    @classmethod
    def of(cls, setup: Setup) -> Self:
        """Return the measurement that the settings and the motion of a run ask for."""
        return cls(setup.rig, setup.settings.noise.match_tracks, not _has_small_white_noise(setup.noise))

    @property
    def correlation(self) -> float:
        """Return the correlation so far; 0 unless it exceeds what chance, or the filter, gives white residuals."""
        if not self._pairs:
            return 0.0
        found = self._products / max(self._squares, np.finfo(float).tiny)
        chance = max(self._least, _STANDARD_ERRORS / np.sqrt(self._pairs))
        return float(min(found, _MOST_CORRELATED)) if found > chance else 0.0

    @property
    def share(self) -> float:
        """Return the weight of a track, a factor in (0, 1] on its information: 1 if residuals are not correlated."""
        along = self._effect_along_tracks
        if along <= 1.0:
            return 1.0
        return 1.0 / (max(along, self._scores.design_effect or 0.0) * self._neighbours.erring_as_one(self.correlation))

    @property
    def _effect_along_tracks(self) -> float:
        """Return the ratio of actual to stated variance of a long track's mean; 0 if residuals are not correlated."""
        rho = self.correlation
        return (1.0 + rho) / (1.0 - rho) * self._squares / self._pairs if rho > 0.0 else 0.0

    @property
    def messages(self) -> tuple[str, ...]:
        """Return one log line if tracks have less than their full weight, else nothing."""
        if self.share > _MOST_REPORTED:
            return ()
        together = self._neighbours.erring_as_one(self.correlation)
        neighbours = f" {together:.1f} neighbours have a common error," if together > 1.0 else ""
        return (
            f"residuals along {self._of} are correlated, {self.correlation:.2f} from frame to frame,{neighbours} and "
            f"not white as stated: {self._of} were given {self.share:.2f} of their information in the end",
        )

    def learn(self, sightings: TrackSightings, points: Array, poses: Array) -> None:
        """Add tracks with points (F, 3) m that have corrected W poses; ``poses`` (W, 4, 4) are the corrected ones."""
        long_enough = sightings.seen.sum(axis=1) >= FEWEST_SIGHTINGS
        if not self.matches or not long_enough.any():
            return
        sightings = sightings.select(long_enough)
        left = residuals_left(sightings, points[long_enough], poses, self._rig)
        both = sightings.seen[:, 1:] & sightings.seen[:, :-1]
        self.add(left[:, :-1][both], left[:, 1:][both])

    def add(self, before: Array, after: Array) -> None:
        """Add whitened residuals (n, 3) of n sightings, and those of the same tracks one frame later (n, 3)."""
        if not self.matches:
            return
        self._products += float((before * after).sum())
        self._squares += 0.5 * float(np.square(before).sum() + np.square(after).sum())
        self._pairs += 3 * len(before)

    def settle(self, frame: StereoFrame, T_world_imu: Array) -> None:
        """Add the next frame whose pose (4, 4) will hardly change any more."""
        # Scores need successive frames: once begun, no frame is left out.
        if self._effect_along_tracks > 1.0 or self._scores.sightings:
            self._scores.add(frame, T_world_imu)

    def settle_last(self) -> None:
        """Score the tracks that are still in view at the end of the run."""
        self._scores.finish()

    def add_images(self, frames: IntArray, uvs_px: Array, whitened: Array, H_pose: Array) -> None:
        """Add residuals of the same images: whitened (N, 3), of sightings (N, 3) px in frames (N,).

        ``H_pose`` (N, 3, 6) are their whitened Jacobians to the poses of the frames.
        """
        if self.matches and self._counts_neighbours:
            self._neighbours.add(frames, uvs_px, freed_of_poses(frames, whitened, H_pose))


class LandmarkCorrelation(ResidualCorrelation):
    """The residual correlation of landmarks in a filter's state, from residuals at the corrected state.

    Such a landmark accumulates sightings for as long as it is seen, not only over a window, and accumulates its track's
    error with them. Its residuals are therefore correlated for longer than those of tracks that correct once, and its
    weight is smaller. With white noise they are hardly correlated: an optimal filter's residual is its innovation times
    a gain, and innovations are white.
    """

    _of, _least = "tracks of landmarks in the state", _LEAST_OF_LANDMARKS

    def __init__(self, rig: StereoRig, matches: bool = True, counts_neighbours: bool = True) -> None:
        super().__init__(rig, matches, counts_neighbours)
        self._before_ids: IntArray = np.empty(0, dtype=np.int64)
        self._before = np.empty((0, 3))

    def learn_frame(
        self,
        frame: StereoFrame,
        track_ids: IntArray,
        points: Array,
        T_world_imu: Array,
        images: multiview.Images = multiview.NUMPY,
    ) -> None:
        """Add a frame's sightings of landmarks (L, 3) m with ids (L,), after these have corrected its pose (4, 4).

        Outliers under the stated noise are left out.
        """
        if not self.matches:
            return
        order = np.argsort(frame.track_ids)
        places, seen = rows_of(track_ids, frame.track_ids[order])
        ids, uvs_px = track_ids[seen], frame.uvs_px[order[places[seen]]]
        predicted_px, _ = images.plain(points[seen], T_world_imu[None], self._rig)
        residuals = left_only.whitened_residuals(uvs_px, predicted_px[:, 0], self._rig)
        sound = np.square(residuals).sum(axis=1) < chi2_bound(3, SOUND)
        self._add_image(uvs_px[sound], residuals[sound], points[seen][sound], T_world_imu, images)
        ids, residuals = ids[sound], residuals[sound]
        order = np.argsort(ids)
        ids, residuals = ids[order], residuals[order]
        before, known = rows_of(ids, self._before_ids)
        self.add(self._before[before[known]], residuals[known])
        self._before_ids, self._before = ids, residuals

    def _add_image(
        self, uvs_px: Array, whitened: Array, points: Array, T_world_imu: Array, images: multiview.Images
    ) -> None:
        """Add the residuals of one image, if landmarks have come to have less than their full weight."""
        if not self._counts_neighbours or self.share == 1.0 or not len(points):
            return
        there = images.linearised(points, T_world_imu[None], self._rig)
        H_pose = left_only.whitener(uvs_px, self._rig) @ left_only.seen_rows(uvs_px, there.d_uv_d_pose[:, 0])
        self.add_images(np.zeros(len(points), dtype=np.int64), uvs_px, whitened, H_pose)


def residuals_left(sightings: TrackSightings, points: Array, poses: Array, rig: StereoRig) -> Array:
    """Return the whitened residuals (F, W, 3) of tracks after one Gauss-Newton step of their points (F, 3).

    The step is to first order; the poses (W, 4, 4) are fixed.
    """
    seen = multiview.linearise(sightings, points, poses, poses, rig)
    count, window = sightings.seen.shape
    H, residuals = seen.H_point.reshape(count, 3 * window, 3), seen.residuals.reshape(count, 3 * window, 1)
    H_transposed = np.swapaxes(H, 1, 2)
    step = np.linalg.solve(H_transposed @ H, H_transposed @ residuals)
    return np.asarray((residuals - H @ step).reshape(count, window, 3))


def _has_small_white_noise(noise: MotionNoise) -> bool:
    """Return whether odometry's white noise is smaller than its lasting errors, such as those of calibration."""
    return isinstance(noise, TwistNoise) and float(noise.velocity_noise_density.max()) < _LEAST_WHITE_NOISE
