"""The sightings of a recording that its true poses explain, by track, decorrelated, and the landmarks that they show.

Under a stated noise of tracks (:class:`toolkit.track_noise.TrackNoise`) a track's sightings have the error
``CHANNELS^-1 e + white``; e, the sum of offset and walk, is common to them. With the covariance C of all sightings of a
track, in units of their white noise, and C = L L^T, ``L^-1`` maps residuals and Jacobians to those of independent
errors. L is lower triangular, so that each row is the innovation of a sighting after the ones before it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.linalg import solve_triangular

from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models import left_only, stereo
from toolkit.models.correlated_noise import white_rig
from toolkit.models.gating import chi2_bound
from toolkit.sequence import Packet, StereoRig, is_left_only
from toolkit.track_noise import CHANNELS, TrackNoise

# A sighting whose residual at the truth is this improbable is a mismatch and adds no information.
_MISMATCH_PROBABILITY = 1e-6
_POINT_ITERATIONS = 5
# Standard deviation of the image of a landmark that is unknown: more than tracks slip by.
_UNKNOWN_PX = 50.0
_TO_UV = np.linalg.inv(CHANNELS)


@dataclass(frozen=True, eq=False)
class SightingNoise:
    """The noise of sightings: the rig with their white noise, and that of walk and offset of tracks or None."""

    rig: StereoRig
    of_tracks: TrackNoise | None

    @classmethod
    def of(cls, rig: StereoRig) -> Self:
        """Return the noise that a rig states; a noise of tracks without walk and offset is white."""
        noise = rig.track_noise
        return cls(rig, None) if noise is None else cls(white_rig(noise, rig), noise if noise.is_correlated else None)

    def d_white_d_error(self, uvs_px: Array) -> Array:
        """Return the derivatives (N, 3, 3) of whitened sightings (N, 3) by the errors of their tracks in channels."""
        return np.broadcast_to(left_only.whitener(uvs_px, self.rig) @ _TO_UV, (len(uvs_px), 3, 3))


@dataclass(frozen=True, eq=False)
class SightingsByTrack:
    """N sightings by ascending track and then by time: frame number, (uL, uR, v) px and age of each; tracks (M,)."""

    track_ids: IntArray
    track: IntArray
    frame: IntArray
    uvs_px: Array
    ages: IntArray
    noise: SightingNoise

    @classmethod
    def of(cls, packets: Sequence[Packet], noise: SightingNoise) -> Self:
        """Return the sightings of packets."""
        frames = [packet.frame for packet in packets]
        ids = np.concatenate([frame.track_ids for frame in frames])
        order = np.argsort(ids, kind="stable")
        track_ids, track = np.unique(ids[order], return_inverse=True)
        number = np.repeat(np.arange(len(frames)), [frame.track_ids.size for frame in frames])[order]
        uvs_px, ages = np.concatenate([f.uvs_px for f in frames]), np.concatenate([f.ages for f in frames])
        return cls(track_ids, track, number, uvs_px[order], ages[order], noise)

    @cached_property
    def first(self) -> IntArray:
        """Return the row (M,) of each track's first sighting."""
        return np.searchsorted(self.track, np.arange(self.track_ids.size))

    @property
    def of_each_track(self) -> Iterator[slice]:
        """Yield the rows of each track."""
        return map(slice, self.first.tolist(), [*self.first[1:].tolist(), self.track.size])

    def predict(self, points: Array, poses: Array) -> stereo.StereoPrediction:
        """Predict the sightings of points (M, 3) from the poses (K, 4, 4) of the frames."""
        return stereo.predict(points[self.track], poses[self.frame], self.noise.rig)

    def residuals(self, predicted_px: Array) -> Array:
        """Return measured minus predicted (N, 3) in standard deviations of the white noise."""
        return left_only.whitened_residuals(self.uvs_px, predicted_px, self.noise.rig)

    def jacobian(self, jacobian_px: Array) -> Array:
        """Return derivatives (N, 3, k) of the sightings in standard deviations of the white noise."""
        return np.asarray(left_only.whitener(self.uvs_px, self.noise.rig) @ jacobian_px)

    def cov(self, rows: slice) -> Array:
        """Return the covariance (3 n, 3 n) of a track's n sightings, in units of their white noise."""
        noise, by_error = self.noise.of_tracks, self.noise.d_white_d_error(self.uvs_px[rows])
        size = 3 * len(by_error)
        if noise is None:
            return np.eye(size)
        shared = replace(noise, white_px=np.zeros(3)).cov(self.ages[rows].astype(float))
        return np.asarray(np.einsum("jac,cjk,kbc->jakb", by_error, shared, by_error).reshape(size, size) + np.eye(size))

    @cached_property
    def _roots(self) -> list[Array]:
        """Return the Cholesky factor (3 n, 3 n) of each track's covariance."""
        return [np.asarray(np.linalg.cholesky(self.cov(rows))) for rows in self.of_each_track]

    def decorrelated(self, track: int, values: Array) -> Array:
        """Return values (3 n, k) of a track, in standard deviations of the white noise, with independent errors."""
        return np.asarray(solve_triangular(self._roots[track], values, lower=True))

    def all_decorrelated(self, values: Array) -> Array:
        """Return values (N, 3, k) of all tracks, in standard deviations of the white noise, with independent errors."""
        if self.noise.of_tracks is None:
            return values
        of_each = [
            self.decorrelated(i, values[rows].reshape(-1, values.shape[2])) for i, rows in enumerate(self.of_each_track)
        ]
        return np.concatenate(of_each).reshape(values.shape) if of_each else values

    @cached_property
    def _nearest(self) -> IntArray:
        """Return the row (M,) of each track's sighting with the largest disparity: it has the most accurate depth."""
        return np.lexsort((-stereo.disparity_px(self.uvs_px), self.track))[self.first]

    def triangulated(self, poses: Array) -> Array:
        """Return the points (M, 3) that the sightings with the largest disparities show from their poses (K, 4, 4)."""
        return stereo.triangulate_world(self.uvs_px[self._nearest], poses[self.frame[self._nearest]], self.noise.rig)

    def landmarks(self, poses: Array) -> Array:
        """Return the points (M, 3) that best explain their sightings from the true poses (K, 4, 4)."""
        points = self.triangulated(poses)
        for _ in range(_POINT_ITERATIONS):
            seen = self.predict(points, poses)
            white = np.dstack([self.jacobian(seen.d_uv_d_point), self.residuals(seen.uv_px)])
            H_and_residuals = self.all_decorrelated(white)
            H, residuals = H_and_residuals[..., :3], H_and_residuals[..., 3:]
            H_transposed = np.swapaxes(H, 1, 2)
            information = np.add.reduceat(H_transposed @ H, self.first)
            score = np.add.reduceat(H_transposed @ residuals, self.first)
            points = points + np.linalg.solve(information, score)[..., 0]
        return points

    def explained(self, points: Array, poses: Array) -> BoolArray:
        """Say which sightings (N,) are no mismatches, given or linearised at the landmarks (M, 3) of their tracks.

        With white noise each is tested by itself, given its landmark. Under a noise of tracks each is tested given the
        sound ones of its track before it, its landmark unknown: a track that has slipped is off by less than what the
        offset and the landmark leave open, but by many standard deviations of a step.
        """
        seen = self.predict(points, poses)
        residuals = self.residuals(seen.uv_px)
        bound = chi2_bound(left_only.degrees_of_freedom(self.uvs_px), 1.0 - _MISMATCH_PROBABILITY)
        if self.noise.of_tracks is None:
            likely = np.square(residuals).sum(axis=1) < bound
        else:
            bounds, H = np.broadcast_to(bound, len(residuals)), self.jacobian(seen.d_uv_d_point)
            to_point = _UNKNOWN_PX * np.linalg.inv(seen.d_uv_d_point[self._nearest])
            likely = np.zeros(len(residuals), dtype=bool)
            for track, one in enumerate(self.of_each_track):
                spread = H[one].reshape(-1, 3) @ to_point[track]
                likely[one] = _explained_in_turn(residuals[one], self.cov(one) + spread @ spread.T, bounds[one])
        return np.asarray(likely & (seen.depth_m > 0.0))


def _explained_in_turn(residuals: Array, cov: Array, bounds: Array) -> BoolArray:
    """Say which of a track's n sightings (n, 3) chance explains, each given the sound ones before it.

    ``cov`` (3 n, 3 n) is that of the residuals. From the first one beyond its bound (n,) on, all that are improbable
    given those before it are left out; the rest is tested again.
    """
    kept = np.arange(len(residuals))
    while kept.size:
        rows = (3 * kept[:, None] + np.arange(3)).ravel()
        own, root = residuals[kept].ravel(), np.linalg.cholesky(cov[np.ix_(rows, rows)])
        innovations = solve_triangular(root, own, lower=True).reshape(-1, 3)
        improbable = np.flatnonzero(np.square(innovations).sum(axis=1) >= bounds[kept])
        if not improbable.size:
            break
        before, after = rows[: 3 * improbable[0]], kept[improbable[0] :]
        gain = np.linalg.solve(cov[np.ix_(before, before)], cov[before])
        error = (residuals.ravel() - gain.T @ residuals.ravel()[before]).reshape(-1, 3)[after]
        spread = (cov - cov[:, before] @ gain).reshape(len(residuals), 3, len(residuals), 3)[after, :, after]
        off = (error * np.linalg.solve(spread, error[..., None])[..., 0]).sum(axis=1) >= bounds[after]
        off[0] = True  # as its innovation says, whatever the rounding
        kept = np.concatenate([kept[: improbable[0]], after[~off]])
    sound = np.zeros(len(residuals), dtype=bool)
    sound[kept] = True
    return sound


def without_mismatches(
    packets: tuple[Packet, ...], poses: Array, noise: SightingNoise
) -> tuple[tuple[Packet, ...], SightingsByTrack, Array]:
    """Return the packets without mismatched sightings, the rest by track, and their landmarks (M, 3).

    Under a noise of tracks all are tested again with the landmarks of the sound ones. Landmarks fitted to all sightings
    are no start there: they are wrong where a track has slipped.
    """
    white, tested = noise.of_tracks is None, _placed_by_stereo(packets)
    sightings = SightingsByTrack.of(tested, noise)
    points = sightings.landmarks(poses) if white else sightings.triangulated(poses)
    for _ in range(2):
        sound = sightings.explained(points, poses)
        kept = _placed_by_stereo(tuple(_only(packet, sightings, sound) for packet in tested))
        left = SightingsByTrack.of(kept, noise)
        refined = left.landmarks(poses)
        if white:
            tested, sightings, points = kept, left, refined
        else:
            points[np.searchsorted(sightings.track_ids, left.track_ids)] = refined
    return kept, left, refined


def _only(packet: Packet, sightings: SightingsByTrack, sound: BoolArray) -> Packet:
    """Return a packet with only the sound ones of the sightings (N,)."""
    here = sightings.track_ids[sightings.track[sound & (sightings.frame == packet.index)]]
    return replace(packet, frame=packet.frame.select(np.isin(packet.frame.track_ids, here)))


def _placed_by_stereo(packets: tuple[Packet, ...]) -> tuple[Packet, ...]:
    """Return the packets without left-only sightings of tracks that both images have not shown before."""
    if not any(is_left_only(packet.frame.uvs_px).any() for packet in packets):
        return packets
    placed, kept = np.empty(0, dtype=np.int64), []
    for packet in packets:
        frame, left = packet.frame, is_left_only(packet.frame.uvs_px)
        placed = np.union1d(placed, frame.track_ids[~left])
        kept.append(replace(packet, frame=frame.select(np.isin(frame.track_ids, placed))))
    return tuple(kept)
