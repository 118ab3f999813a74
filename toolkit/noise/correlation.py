"""The weight of a track's sightings, from how the residuals of an adjustment correlate.

A tracker drifts: the error of one image persists in the next, and whatever shifts a patch of an image shifts the
patches beside it. If every sighting counted in full, an estimator would take the same error for ever new information.
Two design effects, the ratios of the actual to the stated variance of a mean, say for how much it should count:

- along tracks, errors that are a first-order autoregression with correlation rho from frame to frame and v times the
  stated variance have the effect ``v (1 + rho) / (1 - rho)`` (Bayley & Hammersley 1946, "The 'effective' number of
  independent observations in an autocorrelated time series");
- in an image, if the correlations of each error with those of its neighbours sum to s, the sum of n errors has 1 + s
  times the variance of n independent ones (Kish 1965, "Survey sampling", chapter 5). A wrong pose makes the residuals
  of an image alike too, so they are projected off the pose that explains them best.

White errors leave residuals that correlate negatively, because the landmark was fitted to them: their weight is 1. So
is that of tracks whose stated noise is large enough to cover the correlation.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from toolkit.geometry import Array, IntArray
from toolkit.jackknife import STRETCHES, jackknife_error
from toolkit.noise.stretches import SoundResiduals

# With three sightings, the fitted landmark absorbs too much of the residuals to show how successive ones correlate.
FEWEST_SIGHTINGS = 4
# A correlation counts as significant beyond this many standard errors: chance exceeds it once in a thousand.
_STANDARD_ERRORS = 3.0
# Largest correlation: it gives a sighting a weight of a hundredth. Beyond it another cause is likelier.
_MOST_CORRELATED = 0.98
# Neighbours are counted up to these distances (px): about the width of a tracker's patch, doubled again and again. The
# last one was chosen by looking at three of the seven UTIAS drives and MH_01: farther apart residuals are uncorrelated.
_RADII_PX = np.array([20.0, 40.0, 80.0, 160.0])
# A sum of correlations with neighbours counts beyond this many standard errors, the largest of four being taken.
_NEIGHBOUR_ERRORS = 4.0
_RINGS = len(_RADII_PX)


@dataclass(frozen=True)
class TrackWeight:
    """The share of its stated information that a sighting carries, with its standard error, and the evidence.

    ``correlation`` is that of residuals from one sighting to the next, 0 where it is not significant; ``variance`` the
    ratio of their variance to the stated one; ``neighbours`` how many sightings of an image carry the information of
    one. ``pairs`` is the number of successive sightings.
    """

    value: float = 1.0
    error: float = 0.0
    correlation: float = 0.0
    variance: float = 1.0
    neighbours: float = 1.0
    pairs: int = 0


def track_weight(parts: Iterable[tuple[SoundResiduals, float]]) -> TrackWeight:
    """Return the weight of tracks by the residuals of adjusted stretches, each with the share of its tracks in use."""
    by_frame = [_sums_by_frame(residuals, used) for residuals, used in parts]
    sums = np.concatenate([np.empty((0, 5 + 2 * _RINGS)), *by_frame])
    found = _weight_of(sums)
    if found.value == 1.0 or len(sums) < STRETCHES:
        return found
    error = jackknife_error(lambda some: _weight_of(some).value, sums)
    return TrackWeight(found.value, error, found.correlation, found.variance, found.neighbours, found.pairs)


def _weight_of(sums: Array) -> TrackWeight:
    products, squares, pairs, all_squares, numbers, *rings = sums.sum(axis=0).tolist()
    if not pairs:
        return TrackWeight()
    rho, variance = min(products / max(squares, 1e-300), _MOST_CORRELATED), squares / pairs
    if rho < _STANDARD_ERRORS / float(np.sqrt(pairs)):
        return TrackWeight(variance=variance, pairs=int(pairs) // 3)
    repeated = (1.0 + rho**2) / (1.0 - rho**2)
    together = 2.0 * np.cumsum(rings[:_RINGS]) / all_squares
    by_chance = 2.0 * np.sqrt(np.cumsum(rings[_RINGS:]) * repeated) / numbers
    neighbours = 1.0 + float(np.max(together, where=together > _NEIGHBOUR_ERRORS * by_chance, initial=0.0))
    along = variance * (1.0 + rho) / (1.0 - rho)
    value = 1.0 if along <= 1.0 else 1.0 / (along * neighbours)
    return TrackWeight(value, 0.0, float(rho), variance, neighbours, int(pairs) // 3)


def _sums_by_frame(residuals: SoundResiduals, used: float) -> Array:
    """Return for each frame (K, 5 + 2 R) what the correlations are made of.

    Along tracks: products with the next residual, mean squares and number of these; in the image: squares, their
    number, then products and number of pairs in each ring of distances. If a share of the tracks is ``used``, each has
    that share of its neighbours.
    """
    frame, track, uv_px, whitened, H_pose = residuals
    count = int(frame.max(initial=-1)) + 1
    order = np.lexsort((frame, track))
    now, then = order[:-1], order[1:]
    pairs = (track[now] == track[then]) & (frame[then] == frame[now] + 1)
    now, then = now[pairs], then[pairs]
    product = (whitened[now] * whitened[then]).sum(axis=1)
    square = 0.5 * (np.square(whitened[now]) + np.square(whitened[then])).sum(axis=1)
    along = [np.bincount(frame[now], values, count) for values in (product, square, np.full(now.size, 3.0))]
    freed = _freed_of_poses(frame, whitened, H_pose, count)
    squares = [np.bincount(frame, values, count) for values in (np.square(freed).sum(axis=1), np.full(frame.size, 3.0))]
    products, numbers = _neighbours(frame, uv_px, freed, count)
    return np.column_stack([*along, *squares, products / used, numbers / used**2])


def _neighbours(frame: IntArray, uv_px: Array, freed: Array, count: int) -> tuple[Array, Array]:
    """Return the products (K, R) of residuals of neighbours in K frames, by ring of distances, and their numbers."""
    if not frame.size:
        return np.zeros((count, _RINGS)), np.zeros((count, _RINGS))
    apart_px = (2.0 * _RADII_PX[-1] + float(np.ptp(uv_px[:, 0]))) * frame
    places = np.column_stack([uv_px[:, 0] + apart_px, uv_px[:, 2]])
    from scipy.spatial import KDTree  # 7 MB, which no process that only runs estimators needs

    one, other = KDTree(places).query_pairs(_RADII_PX[-1], output_type="ndarray").T
    ring = np.searchsorted(_RADII_PX[:-1], np.linalg.norm(places[one] - places[other], axis=1))
    cell, cells = frame[one] * _RINGS + ring, count * _RINGS
    values = (freed[one] * freed[other]).sum(axis=1), np.full(cell.size, 3.0)
    products, numbers = (np.asarray(np.bincount(cell, each, cells), dtype=float) for each in values)
    return products.reshape(count, _RINGS), numbers.reshape(count, _RINGS)


def _freed_of_poses(frame: IntArray, whitened: Array, H_pose: Array, count: int) -> Array:
    """Return residuals (N, 3) in frames (N,) after one Gauss-Newton step of each frame's pose."""
    matrices, vectors = np.zeros((count, 6, 6)), np.zeros((count, 6))
    H_transposed = np.swapaxes(H_pose, 1, 2)
    np.add.at(matrices, frame, H_transposed @ H_pose)
    np.add.at(vectors, frame, (H_transposed @ whitened[..., None])[..., 0])
    steps = (np.linalg.pinv(matrices, hermitian=True) @ vectors[..., None])[frame]
    return np.asarray(whitened - (H_pose @ steps)[..., 0])
