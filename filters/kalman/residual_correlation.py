"""How much a sighting of a track counts for, by how alike the residuals of its successive sightings are.

A tracker takes its error along from image to image, and an estimator told white noise takes every sighting of such a
track for new. That it does shows in residuals that are correlated from one sighting to the next, by rho beyond what
chance makes of white ones. From then on every track corrects with a share of its information; what is an outlier stays
a matter of the stated noise. The share is one over the larger of two design effects, either of which misses some of it:

- that of long tracks whose errors are an autoregression of first order: with v times the stated variance a sighting
  tells (1 - rho) / (1 + rho) / v of what it is stated to (Bayley & Hammersley 1946, "The 'effective' number of
  independent observations in an autocorrelated time series"). Poses that few tracks have corrected take up much of
  what these are off by;
- that of what tracks say of a drift (:mod:`filters.kalman.track_scores`), of those that have ended, at poses that will
  hardly change any more. Early in a run these are the short ones, and there is none until there are enough.

Where the first is not beyond 1, noise was stated large enough for such tracks, and they count in full: what they say of
a drift all the same is the motion's error, not theirs (kitti00, dataset3).

Where residuals of neighbours in an image are known as well, and alike beyond chance, the share is smaller by as many as
err as one (:mod:`filters.kalman.neighbour_correlation`). Not so beside odometry whose white noise is smaller than what
lasts of any odometry's errors: the less tracks count for, the more the way is left to it. White errors have residuals
that are correlated negatively, by the landmark that was fitted to them, and count in full: a filter whose noise is as
stated stays, to the bit, what it is without.
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

# Chance makes white residuals look correlated once in a thousand: beyond so many standard errors of none they are.
_STANDARD_ERRORS = 3.0
# What counts for less than a hundredth would be no measurement; beyond that another cause is likelier.
_MOST_CORRELATED = 0.98
# Odometry with less white noise (m/s/sqrt(Hz)) is stated to be off after a second by less than wheels and cameras are
# calibrated to, 1 % of 5 m/s. Chosen between what is assumed of odometry that looks free of noise (0.016 at 10 Hz) and
# the noise of the course's (0.17).
_LEAST_WHITE_NOISE = 0.05
# What rounds to the full information is none to speak of.
_MOST_REPORTED = 0.95
# Gates, robust weights and linearisation leave residuals of white landmarks correlated, however many there are: by up
# to 0.07 where there are thousands, on drive, flight and exports of OpenVINS. Tracks that walk are beyond 0.5.
_LEAST_OF_LANDMARKS = 0.15


class ResidualCorrelation:
    """Measures over a run the correlation of a track's residuals from one sighting to the next, if it ``matches``."""

    _of, _least = "tracks", 0.0

    def __init__(self, rig: StereoRig, matches: bool = True, counts_neighbours: bool = True) -> None:
        # Where noise of tracks is stated, their sightings correct with its covariance, which is whole.
        self._rig, self.matches = rig, matches and rig.track_noise is None
        self._counts_neighbours = counts_neighbours
        self._products, self._squares, self._pairs = 0.0, 0.0, 0
        self._neighbours, self._scores = NeighbourCorrelation(), TrackScores(rig)

    @classmethod
    def of(cls, setup: Setup) -> Self:
        """Return what the settings and the motion of a run ask for."""
        return cls(setup.rig, setup.settings.noise.match_tracks, not _is_calibration_larger(setup.noise))

    @property
    def correlation(self) -> float:
        """Return the correlation so far, 0 unless it is beyond what chance, or the filter, makes of white residuals."""
        if not self._pairs:
            return 0.0
        found = self._products / max(self._squares, np.finfo(float).tiny)
        chance = max(self._least, _STANDARD_ERRORS / np.sqrt(self._pairs))
        return float(min(found, _MOST_CORRELATED)) if found > chance else 0.0

    @property
    def share(self) -> float:
        """Return the share of its information that a track counts for: all where residuals along it are not alike."""
        along = self._effect_along_tracks
        if along <= 1.0:
            return 1.0
        return 1.0 / (max(along, self._scores.design_effect or 0.0) * self._neighbours.erring_as_one(self.correlation))

    @property
    def _effect_along_tracks(self) -> float:
        """Return how many times the stated variance the mean of a long track has: 0 where residuals are not alike."""
        rho = self.correlation
        return (1.0 + rho) / (1.0 - rho) * self._squares / self._pairs if rho > 0.0 else 0.0

    @property
    def messages(self) -> tuple[str, ...]:
        """Return what a user should know, a line, where tracks do not count in full."""
        if self.share > _MOST_REPORTED:
            return ()
        together = self._neighbours.erring_as_one(self.correlation)
        neighbours = f" {together:.1f} neighbours as one," if together > 1.0 else ""
        return (
            f"residuals along {self._of} are correlated, {self.correlation:.2f} from frame to frame,{neighbours} and "
            f"not white as stated: {self._of} came to count for {self.share:.2f} of their information",
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

    def settle(self, frame: StereoFrame, T_world_imu: Array) -> None:
        """Take in the next frame whose pose (4, 4) will hardly change any more."""
        # Tracks are scored of frames that follow one another: once begun, none is left out.
        if self._effect_along_tracks > 1.0 or self._scores.sightings:
            self._scores.add(frame, T_world_imu)

    def settle_last(self) -> None:
        """Take in the tracks that are seen to the end."""
        self._scores.finish()

    def add_images(self, frames: IntArray, uvs_px: Array, whitened: Array, H_pose: Array) -> None:
        """Take in what images show together: whitened residuals (N, 3) of sightings (N, 3) px in frames (N,).

        ``H_pose`` (N, 3, 6) are their whitened Jacobians to the poses of the frames.
        """
        if self.matches and self._counts_neighbours:
            self._neighbours.add(frames, uvs_px, freed_of_poses(frames, whitened, H_pose))


class LandmarkCorrelation(ResidualCorrelation):
    """The same of the landmarks in a filter's state, by what the corrected state leaves of their sightings.

    Such a landmark collects sightings for as long as it is seen, not for a window, and what its track has come to be
    off by stays in it: its residuals are correlated for longer than those of tracks that correct once, and it counts
    for less. White ones are hardly correlated: what an optimal filter leaves of a sighting is its innovation times a
    gain, and innovations are white.
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
        """Take in a frame's sightings of landmarks (L, 3) m with ids (L,), all as they have corrected its pose (4, 4).

        Outliers by the stated noise are left out.
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
        """Take in what one image shows together, where sightings have come to count for less."""
        if not self._counts_neighbours or self.share == 1.0 or not len(points):
            return
        there = images.linearised(points, T_world_imu[None], self._rig)
        H_pose = left_only.whitener(uvs_px, self._rig) @ left_only.seen_rows(uvs_px, there.d_uv_d_pose[:, 0])
        self.add_images(np.zeros(len(points), dtype=np.int64), uvs_px, whitened, H_pose)


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


def _is_calibration_larger(noise: MotionNoise) -> bool:
    """Return whether odometry's white noise is smaller than what lasts of its errors."""
    return isinstance(noise, TwistNoise) and float(noise.velocity_noise_density.max()) < _LEAST_WHITE_NOISE
