"""How many sightings of one image err together, estimated from the correlation of neighbouring tracks' residuals.

A cause that shifts one patch of an image shifts the patches beside it as well: overlapping patches, a surface that
moves or reflects, residual lens distortion. If the correlations of each error with those of its neighbours sum to s,
the sum of n errors has 1 + s times the variance of n independent ones, so that 1 + s sightings carry the information of
one (Kish 1965, "Survey sampling", chapter 5: the design effect of clusters). A wrong pose also makes the residuals of
an image alike, but is no error of tracks. Residuals are therefore projected off the pose that explains them best; this
also removes the error that all tracks of an image share, which every estimator attributes to motion.
"""

import numpy as np
from scipy.spatial import KDTree

from toolkit.geometry import Array, IntArray

# Neighbours are counted up to these distances (px): about the width of a tracker's patch, doubled again and again. The
# last one was chosen by looking at three of the seven drives and MH_01, where residuals farther apart are uncorrelated.
_RADII_PX = np.array([20.0, 40.0, 80.0, 160.0])
# Pairs are formed for this many sightings at a time, up to the end of a frame: all pairs of a run can take 200 MB.
_AT_ONCE = 5000
# A sum of correlations counts as significant beyond this many standard errors.
_STANDARD_ERRORS = 4.0


class NeighbourCorrelation:
    """Measures over a run how many sightings of one image err together."""

    def __init__(self) -> None:
        self._products, self._pairs = np.zeros(len(_RADII_PX)), np.zeros(len(_RADII_PX))
        self._squares, self._numbers = 0.0, 0

    def erring_as_one(self, correlation: float = 0.0) -> float:
        """Return how many sightings of an image carry the information of one: 1 if no correlation is significant.

        ``correlation`` in [0, 1) is that of a residual with the next one of its track; the larger it is, the fewer
        independent pairs there are. Of the distances up to which neighbours are counted, the one with the largest sum
        is used.
        """
        if not self._numbers:
            return 1.0
        shared = 2.0 * np.cumsum(self._products) / self._squares
        repeated = (1.0 + correlation**2) / (1.0 - correlation**2)
        chance = 2.0 * np.sqrt(np.cumsum(self._pairs) * repeated) / self._numbers
        return 1.0 + float(np.max(shared, where=shared > _STANDARD_ERRORS * chance, initial=0.0))

    def add(self, frames: IntArray, uvs_px: Array, whitened: Array) -> None:
        """Add the whitened residuals (N, 3) of sightings (N, 3) px in frames (N,), outliers left out."""
        if not len(frames):
            return
        order = np.argsort(frames, kind="stable")
        first_of_frame = np.flatnonzero(np.diff(frames[order], prepend=-1))
        begins = first_of_frame[np.flatnonzero(np.diff(first_of_frame // _AT_ONCE, prepend=-1))]
        for rows in np.split(order, begins[1:]):
            self._add_pairs(frames[rows], uvs_px[rows], whitened[rows])

    def _add_pairs(self, frames: IntArray, uvs_px: Array, whitened: Array) -> None:
        apart_px = (2.0 * _RADII_PX[-1] + float(np.ptp(uvs_px[:, 0]))) * frames
        places = np.column_stack([uvs_px[:, 0] + apart_px, uvs_px[:, 2]])
        one, other = KDTree(places).query_pairs(_RADII_PX[-1], output_type="ndarray").T
        ring = np.searchsorted(_RADII_PX[:-1], np.linalg.norm(places[one] - places[other], axis=1))
        self._products += np.bincount(ring, (whitened[one] * whitened[other]).sum(axis=1), minlength=len(_RADII_PX))
        self._pairs += 3 * np.bincount(ring, minlength=len(_RADII_PX))
        self._squares += float(np.square(whitened).sum())
        self._numbers += whitened.size


def freed_of_poses(frames: IntArray, whitened: Array, H_pose: Array) -> Array:
    """Return residuals (N, 3) in frames (N,) after one Gauss-Newton step of each frame's pose.

    ``H_pose`` (N, 3, 6) are their whitened Jacobians to these poses.
    """
    count = int(frames.max(initial=-1)) + 1
    matrices, vectors = np.zeros((count, 6, 6)), np.zeros((count, 6))
    H_transposed = np.swapaxes(H_pose, 1, 2)
    np.add.at(matrices, frames, H_transposed @ H_pose)
    np.add.at(vectors, frames, (H_transposed @ whitened[..., None])[..., 0])
    steps = (np.linalg.pinv(matrices, hermitian=True) @ vectors[..., None])[frames]
    return np.asarray(whitened - (H_pose @ steps)[..., 0])
