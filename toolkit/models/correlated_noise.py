"""The errors of a track's sightings made independent: what correlated noise of tracks does to residuals.

A track's error in each channel (:data:`toolkit.track_noise.CHANNELS`) is ``white + b``, where ``b`` begins as the
offset, with the walk to the first sighting at hand, and walks on from frame to frame. With the covariance C = L L^T of
a channel over the sightings of a track, ``L^-1`` takes its residuals to independent ones of unit variance.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.sequence import StereoRig
from toolkit.track_noise import CHANNELS, TrackNoise

# Part of every sighting's error whatever is stated, a fiftieth of what a tracker resolves: a covariance needs some.
LEAST_WHITE_PX = 0.01


def white_rig(noise: TrackNoise, rig: StereoRig) -> StereoRig:
    """Return a rig whose sightings err by the white part alone, each by itself."""
    to_uv = np.linalg.inv(CHANNELS) * np.maximum(noise.white_px, LEAST_WHITE_PX)
    return replace(rig, cov_uv_px2=to_uv @ to_uv.T, track_noise=None)


def walked_variance(noise: TrackNoise, ages: IntArray) -> Array:
    """Return the variance (N, 3) px^2 that the walk and the offset have at ages (N,), with the least white noise."""
    walked = np.square(noise.walk_px) * ages[:, None].astype(float)
    return np.asarray(np.square(noise.offset_px) + walked + LEAST_WHITE_PX**2)


def decorrelation(noise: TrackNoise, rig: StereoRig, ages: IntArray, seen: BoolArray) -> Array:
    """Return what makes the residuals of F tracks independent, (F, 3 W, 3 W), of sightings (F, W) of given ages.

    It applies to residuals that are whitened as if each sighting stood for itself (``StereoRig.whitener``), stacked
    by sighting, and to their Jacobians. Rows of what was not seen mix with no others.
    """
    tracks, window = seen.shape
    to_channels = CHANNELS @ np.linalg.inv(rig.whitener)
    mixed = np.einsum("fcwv,ck->fwcvk", _inverse_roots(noise, ages, seen), to_channels)
    return np.asarray(mixed.reshape(tracks, 3 * window, 3 * window))


class LastError(NamedTuple):
    """The walked error of F tracks at their last sighting: its covariance (F, 3, 3) in the channels, px^2, and
    ``gain`` (F, 3, 3 W), its covariance with the decorrelated residuals.
    """

    cov: Array
    gain: Array


def error_of_the_last(noise: TrackNoise, ages: IntArray, seen: BoolArray) -> LastError:
    """Return what the walk and the offset have come to in F tracks at the last of W places, where all are seen."""
    tracks, window = seen.shape
    walk, offset = np.square(noise.walk_px), np.square(noise.offset_px)
    shared = np.where(seen[:, None, :], walk[:, None] * ages[:, None, :] + offset[:, None], 0.0)
    with_residuals = np.einsum("fcwv,fcv->fcw", _inverse_roots(noise, ages, seen), shared)
    gain = np.einsum("fcw,ck->fcwk", with_residuals, np.eye(3)).reshape(tracks, 3, 3 * window)
    return LastError(shared[:, :, -1, None] * np.eye(3), gain)


def _inverse_roots(noise: TrackNoise, ages: IntArray, seen: BoolArray) -> Array:
    """Return the inverse Cholesky factors (F, 3, W, W) of the sightings' covariances, a channel each."""
    window = seen.shape[1]
    both = seen[:, None, :, None] & seen[:, None, None, :]
    white = np.maximum(LEAST_WHITE_PX**2 - noise.white_px**2, 0.0)[:, None, None] * np.eye(window)
    cov = np.where(both, noise.cov(ages.astype(float)) + white, np.eye(window))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))


@dataclass(frozen=True, eq=False)
class Chain:
    """How the errors of N sightings follow from those before them in their tracks, a channel each.

    ``e_k = carried_k e_before + n_k`` with independent n_k of standard deviations ``sigma_px``; ``before`` (N,) is the
    row of the sighting before, -1 where there is none, ``carried`` and ``sigma_px`` are (N, 3).
    """

    before: IntArray
    carried: Array
    sigma_px: Array

    @classmethod
    def of(cls, noise: TrackNoise, track: IntArray, ages: IntArray) -> "Chain":
        """Return the chain of sightings of tracks (N,) with ages (N,), those of a track in the order of time.

        It is the Markov chain whose sightings have their variances, and whose successive ones their covariances:
        exact for noise that is all white, and for a walk and an offset without white noise. In between it forgets a
        part of the offset at every step: the share of the white variance in that of the sighting.
        """
        order = np.argsort(track, kind="stable")
        follows = np.zeros(track.size, dtype=bool)
        follows[1:] = track[order][1:] == track[order][:-1]
        before = np.full(track.size, -1)
        before[order[follows]] = order[np.flatnonzero(follows) - 1]
        common = np.square(noise.offset_px) + np.square(noise.walk_px) * ages[:, None].astype(float)
        variance = common + np.square(np.maximum(noise.white_px, LEAST_WHITE_PX))
        with_before = np.where(before[:, None] >= 0, common[before], 0.0)
        carried = with_before / variance[before]
        return cls(before, carried, np.sqrt(variance - carried * with_before))

    @classmethod
    def without_memory(cls, count: int) -> "Chain":
        """Return the chain of sightings that err each by itself, with unit variance in their channels."""
        return cls(np.full(count, -1), np.zeros((count, 3)), np.ones((count, 3)))

    def of_tracks(self, kept: BoolArray) -> "Chain":
        """Return the chain of the sightings kept (N,), which must be all or none of each track."""
        rows = np.append(np.cumsum(kept) - 1, -1)
        return Chain(rows[self.before[kept]], self.carried[kept], self.sigma_px[kept])

    def innovations(self, residual_px: Array) -> Array:
        """Return residuals (N, 3) of (uL, uR, v), px, as independent ones of unit variance, in the channels."""
        return self.whitened(residual_px @ CHANNELS.T, (residual_px @ CHANNELS.T)[self.before])

    def whitened(self, own: Array, before: Array) -> Array:
        """Return what is left of values (N, 3, ...) in the channels, less what was carried on, in sigmas."""
        shape = (-1, 3) + (1,) * (own.ndim - 2)
        return np.asarray((own - self.carried.reshape(shape) * before) / self.sigma_px.reshape(shape))
