"""How many sightings of one image err as one, by how alike the residuals of neighbouring tracks are.

What shifts one patch of an image shifts the patches beside it: patches that overlap, a surface that moves or shines,
what a calibration leaves of the lens. Where each error is correlated with those of its neighbours by s in sum, the sum
of n of them has 1 + s times the variance of n independent ones, and so many tell as much as one (Kish 1965, "Survey
sampling", chapter 5: the design effect of clusters). What a wrong pose makes of an image is alike as well, and no error
of tracks: so residuals are freed of the pose that explains them best, and with it of what all tracks of an image share,
which every estimator takes for motion.
"""

import numpy as np
from scipy.spatial import KDTree

from toolkit.geometry import Array, IntArray

# Neighbours are counted up to these distances (px): about the width of a tracker's patch, and its doubles. Where to end
# was chosen with three of the seven drives and MH_01 in view, beyond which nothing is alike.
_RADII_PX = np.array([20.0, 40.0, 80.0, 160.0])
# Sightings whose pairs are looked at together, up to the end of a frame: all pairs of a run can take 200 MB.
_AT_ONCE = 5000
# A sum of correlations is beyond chance from so many standard errors on.
_STANDARD_ERRORS = 4.0


class NeighbourCorrelation:
    """Measures over a run how many sightings of one image err as one."""

    def __init__(self) -> None:
        self._products, self._pairs = np.zeros(len(_RADII_PX)), np.zeros(len(_RADII_PX))
        self._squares, self._numbers = 0.0, 0

    def erring_as_one(self, correlation: float = 0.0) -> float:
        """Return how many sightings of an image tell as much as one: 1 where none is beyond what chance makes alike.

        ``correlation`` in [0, 1) is that of a residual with the next one of its track: so much the fewer of the pairs
        tell something new. Of the distances up to which neighbours are counted the one counts that has the most.
        """
        if not self._numbers:
            return 1.0
        shared = 2.0 * np.cumsum(self._products) / self._squares
        repeated = (1.0 + correlation**2) / (1.0 - correlation**2)
        chance = 2.0 * np.sqrt(np.cumsum(self._pairs) * repeated) / self._numbers
        return 1.0 + float(np.max(shared, where=shared > _STANDARD_ERRORS * chance, initial=0.0))

    def add(self, frames: IntArray, uvs_px: Array, whitened: Array) -> None:
        """Take in the whitened residuals (N, 3) of sightings (N, 3) px in frames (N,), without outliers."""
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
    """Return what residuals (N, 3) in frames (N,) leave once each frame's pose has taken up what it can.

    That is a Gauss-Newton step of the poses, to which the whitened Jacobians are ``H_pose`` (N, 3, 6).
    """
    count = int(frames.max(initial=-1)) + 1
    matrices, vectors = np.zeros((count, 6, 6)), np.zeros((count, 6))
    H_transposed = np.swapaxes(H_pose, 1, 2)
    np.add.at(matrices, frames, H_transposed @ H_pose)
    np.add.at(vectors, frames, (H_transposed @ whitened[..., None])[..., 0])
    steps = (np.linalg.pinv(matrices, hermitian=True) @ vectors[..., None])[frames]
    return np.asarray(whitened - (H_pose @ steps)[..., 0])
