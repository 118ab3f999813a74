"""Correlated noise of tracks: residuals of a track's sightings are transformed so that they are independent.

A track's error in each channel (:data:`toolkit.track_noise.CHANNELS`) is ``white + b``. At the first sighting used,
``b`` is the offset plus the walk up to its age; from there it is a random walk from frame to frame. With the covariance
C = L L^T of a channel over the sightings of a track, ``L^-1`` maps its residuals to independent ones of unit variance.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models.left_only import applied, left_whitener
from toolkit.sequence import StereoRig, is_left_only
from toolkit.track_noise import CHANNELS, TrackNoise

# Least white noise (px) of a sighting, a fiftieth of a tracker's resolution. It keeps covariances positive definite.
LEAST_WHITE_PX = 0.01
_TO_UV = np.linalg.inv(CHANNELS)


def white_rig(noise: TrackNoise, rig: StereoRig) -> StereoRig:
    """Return a rig whose sightings have only the white part of the noise."""
    to_uv = np.linalg.inv(CHANNELS) * np.maximum(noise.white_px, LEAST_WHITE_PX)
    return replace(rig, cov_uv_px2=to_uv @ to_uv.T, track_noise=None)


def walked_variance(noise: TrackNoise, ages: IntArray) -> Array:
    """Return the variance (N, 3) px^2 of walk, offset and least white noise at ages (N,)."""
    walked = np.square(noise.walk_px) * ages[:, None].astype(float)
    return np.asarray(np.square(noise.offset_px) + walked + LEAST_WHITE_PX**2)


def decorrelation(
    noise: TrackNoise, rig: StereoRig, ages: IntArray, seen: BoolArray, left_only: BoolArray | None = None
) -> Array:
    """Return matrices (F, 3 W, 3 W) that make the residuals of F tracks independent; sightings (F, W) have given ages.

    They apply to residuals whitened as if the sightings were independent (``StereoRig.whitener``), stacked by sighting,
    and to their Jacobians. Rows of unseen places are not mixed with other rows, nor are rows of uR where a sighting is
    ``left_only`` (F, W). In a ``left_only`` sighting no channel but v is measured: there C is the covariance of uL, uR
    and v together.
    """
    tracks, window = seen.shape
    to_channels = CHANNELS @ np.linalg.inv(rig.whitener)
    mixed = np.einsum("fcwv,ck->fwcvk", _inverse_roots(noise, ages, seen), to_channels)
    mixed = mixed.reshape(tracks, 3 * window, 3 * window)
    some = _with_any(left_only)
    if some.size:
        assert left_only is not None
        units = np.where(
            left_only[some, :, None, None], np.linalg.pinv(left_whitener(rig)), np.linalg.inv(rig.whitener)
        )
        mixed[some] = _times_blocks(_inverse_root_of_all(noise, ages[some], seen[some], left_only[some]), units)
    return np.asarray(mixed)


class LastError(NamedTuple):
    """The error of F tracks due to walk and offset at their last sighting, px.

    ``cov`` (F, 3, 3) px^2 is its covariance in the channels, ``gain`` (F, 3, 3 W) that with the decorrelated residuals.
    """

    cov: Array
    gain: Array


def error_of_the_last(
    noise: TrackNoise, ages: IntArray, seen: BoolArray, left_only: BoolArray | None = None
) -> LastError:
    """Return the error due to walk and offset of F tracks at the last of W places, where all tracks are seen.

    ``ages`` (F, W) in frames; ``seen`` and ``left_only`` (F, W).
    """
    tracks, window = seen.shape
    walk, offset = np.square(noise.walk_px), np.square(noise.offset_px)
    shared = np.where(seen[:, None, :], walk[:, None] * ages[:, None, :] + offset[:, None], 0.0)
    with_residuals = np.einsum("fcwv,fcv->fcw", _inverse_roots(noise, ages, seen), shared)
    gain = np.einsum("fcw,ck->fcwk", with_residuals, np.eye(3)).reshape(tracks, 3, 3 * window)
    some = _with_any(left_only)
    if some.size:
        assert left_only is not None
        with_uv = np.einsum("fcw,ic->fcwi", shared[some], _TO_UV)
        with_uv[..., 1] = np.where(left_only[some, None, :], 0.0, with_uv[..., 1])
        roots = _inverse_root_of_all(noise, ages[some], seen[some], left_only[some])
        gain[some] = with_uv.reshape(some.size, 3, 3 * window) @ np.swapaxes(roots, 1, 2)
    return LastError(shared[:, :, -1, None] * np.eye(3), gain)


def _inverse_roots(noise: TrackNoise, ages: IntArray, seen: BoolArray) -> Array:
    """Return the inverse Cholesky factors (F, 3, W, W) of the sightings' covariances, one per channel."""
    both = seen[:, None, :, None] & seen[:, None, None, :]
    cov = np.where(both, _cov_of_channels(noise, ages), np.eye(seen.shape[1]))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))


def _cov_of_channels(noise: TrackNoise, ages: IntArray) -> Array:
    """Return the covariances (F, 3, W, W) px^2 of sightings of given ages (F, W), one per channel."""
    white = np.maximum(LEAST_WHITE_PX**2 - noise.white_px**2, 0.0)[:, None, None] * np.eye(ages.shape[1])
    return np.asarray(noise.cov(ages.astype(float)) + white)


def _with_any(left_only: BoolArray | None) -> IntArray:
    """Return the tracks that lack a right image."""
    return np.flatnonzero(np.zeros(0) if left_only is None else left_only.any(axis=1))


def _inverse_root_of_all(noise: TrackNoise, ages: IntArray, seen: BoolArray, left_only: BoolArray) -> Array:
    """Return the inverse Cholesky factors (F, 3 W, 3 W) of the measured ones of (uL, uR, v) in all sightings."""
    tracks, window = seen.shape
    cov = np.einsum("ic,fcwv,jc->fwivj", _TO_UV, _cov_of_channels(noise, ages), _TO_UV)
    measured = np.repeat(seen[:, :, None], 3, axis=2)
    measured[..., 1] &= ~left_only
    measured = measured.reshape(tracks, 3 * window)
    both = measured[:, :, None] & measured[:, None, :]
    cov = np.where(both, cov.reshape(tracks, 3 * window, 3 * window), np.eye(3 * window))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))


def _times_blocks(mixing: Array, units: Array) -> Array:
    """Return matrices (F, 3 W, 3 W) multiplied by the matrix (F, W, 3, 3) of each sighting."""
    tracks, window = units.shape[:2]
    by_sighting = mixing.reshape(tracks, 3 * window, window, 3)
    return np.asarray(np.einsum("frwi,fwij->frwj", by_sighting, units).reshape(mixing.shape))


def channels_of(uv_px: Array) -> Array:
    """Return the channels of sightings (N, 3): (3, 3), or (N, 3, 3) with uL, zero and v where uR is missing."""
    left = is_left_only(uv_px)
    every: Array = np.where(left[:, None, None], np.diag([1.0, 0.0, 1.0]), CHANNELS)
    return every if left.any() else CHANNELS


def in_channels(channels: Array, values: Array) -> Array:
    """Return values (N, 3) of (uL, uR, v), or their derivatives (N, 3, k), in channels (3, 3) or (N, 3, 3)."""
    return applied(channels, values) if values.ndim == 2 else np.asarray(channels @ values)


def _with_left_only(variance: Array, left: BoolArray, of_none: float = 0.0) -> Array:
    """Return variances (N, 3) of the channels c, d, v, or for left-only rows of uL = c + d / 2, ``of_none``, v."""
    if not left.any():
        return variance
    of_left = np.stack([variance[:, 0] + 0.25 * variance[:, 1], np.full(len(left), of_none), variance[:, 2]], axis=1)
    return np.where(left[:, None], of_left, variance)


def _row_before(track: IntArray) -> IntArray:
    """Return the row (N,) of the sighting before each of its track (N,), -1 where there is none."""
    order = np.argsort(track, kind="stable")
    follows = np.zeros(track.size, dtype=bool)
    follows[1:] = track[order][1:] == track[order][:-1]
    before = np.full(track.size, -1)
    before[order[follows]] = order[np.flatnonzero(follows) - 1]
    return before


@dataclass(frozen=True, eq=False)
class Chain:
    """The Markov chain of the errors of N sightings along their tracks, one per channel.

    ``e_k = carried_k e_before + n_k`` with independent n_k of standard deviations ``sigma_px``; ``before`` (N,) is the
    row of the sighting before, -1 where there is none, ``carried`` and ``sigma_px`` are (N, 3).
    """

    before: IntArray
    carried: Array
    sigma_px: Array

    @classmethod
    def of(cls, noise: TrackNoise, track: IntArray, ages: IntArray, left_only: BoolArray | None = None) -> "Chain":
        """Return the chain of sightings of tracks (N,) with ages (N,), those of a track in the order of time.

        The Markov chain has the right variance of every sighting and the right covariance of every two successive ones.
        It is exact for purely white noise, and for a walk and an offset without white noise. In between it loses a part
        of the offset at every step: the share of the white variance in that of the sighting.

        A ``left_only`` (N,) sighting follows the sighting before it in uL and v (:func:`channels_of`). A sighting by
        both images follows the last one by both, because no disparity was measured in between. The walk of uL over such
        a gap counts twice.
        """
        left = np.zeros(track.size, dtype=bool) if left_only is None else left_only
        before, both = _row_before(track), np.flatnonzero(~left)
        if left.any():
            before[both] = np.append(both, -1)[_row_before(track[both])]
        common = np.square(noise.offset_px) + np.square(noise.walk_px) * ages[:, None].astype(float)
        variance = common + np.square(np.maximum(noise.white_px, LEAST_WHITE_PX))
        with_before = np.where(before[:, None] >= 0, _with_left_only(common[before], left), 0.0)
        carried = with_before / _with_left_only(variance[before], left, of_none=1.0)
        return cls(before, carried, np.sqrt(_with_left_only(variance, left, of_none=1.0) - carried * with_before))

    @classmethod
    def without_memory(cls, count: int) -> "Chain":
        """Return the chain of sightings with independent errors of unit variance in their channels."""
        return cls(np.full(count, -1), np.zeros((count, 3)), np.ones((count, 3)))

    def of_tracks(self, kept: BoolArray) -> "Chain":
        """Return the chain of the sightings kept (N,), which must be all or none of each track."""
        rows = np.append(np.cumsum(kept) - 1, -1)
        return Chain(rows[self.before[kept]], self.carried[kept], self.sigma_px[kept])

    def innovations(self, residual_px: Array, channels: Array = CHANNELS) -> Array:
        """Return the independent innovations of unit variance, in channels, of residuals (N, 3) px in (uL, uR, v)."""
        return self.whitened(in_channels(channels, residual_px), self.of_before(channels, residual_px))

    def of_before(self, channels: Array, values: Array) -> Array:
        """Return values (N, 3, ...) of the preceding sightings, in the channels of the sightings that follow them.

        ``channels`` is (3, 3) or (N, 3, 3).
        """
        if channels.ndim == 2:
            return np.asarray(in_channels(channels, values)[self.before])
        return np.asarray(in_channels(channels, values[self.before]))

    def whitened(self, own: Array, before: Array) -> Array:
        """Return values (N, 3, ...) in the channels, minus their prediction from the preceding sighting, in sigmas."""
        shape = (-1, 3) + (1,) * (own.ndim - 2)
        return np.asarray((own - self.carried.reshape(shape) * before) / self.sigma_px.reshape(shape))
