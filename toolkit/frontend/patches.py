"""Tests whether a track still shows its first patch, which is fitted into the present image by an affine warp.

Frame-to-frame tracking may drift from one structure to another in small steps that each look right; comparison with the
first patch shows their sum (Shi & Tomasi 1994), and can be taken out. Inverse compositional (Baker & Matthews 2004) on
patches of zero mean and unit norm, which takes out gain and bias of the exposure; the gradients of the first patch
serve for all time.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from toolkit.geometry import Array, BoolArray, IntArray

_HALF_PX = 7
_ITERATIONS = 4
_DAMPING = 1e-3
# A corner detector is not off by more; further away another structure may be the better one.
_FARTHEST_PX = 3.0
Floats = npt.NDArray[np.float32]
# The lattice of a patch, (2, P) px about its centre.
_LATTICE = np.indices(2 * (2 * _HALF_PX + 1,), dtype=np.float32)[::-1].reshape(2, -1) - np.float32(_HALF_PX)


@dataclass(frozen=True, eq=False)
class Patches:
    """First patches of N tracks: normalised values (N, P), pseudo-inverses (N, 6, P), and today's warps (N, 2, 2).

    Values and solvers are 32-bit floats, as the images are: of their megabytes copies are made all the time.
    """

    values: Floats
    solvers: Floats
    warps: Array

    @classmethod
    def none(cls) -> Self:
        size = _LATTICE.shape[1]
        return cls(np.empty((0, size), np.float32), np.empty((0, 6, size), np.float32), np.empty((0, 2, 2)))

    @classmethod
    def taken(cls, image: Floats, points_px: Array) -> Self:
        """Return the patches around points (N, 2) of an image of 32-bit floats."""
        warps = np.tile(np.eye(2), (len(points_px), 1, 1))
        values, norms = _normalised(_sampled(image, points_px, warps))
        steps = np.eye(2)
        gradients = np.stack(
            [0.5 * (_sampled(image, points_px + d, warps) - _sampled(image, points_px - d, warps)) for d in steps], 1
        ).astype(np.float64)
        # By the elements of the warp, row by row, then the shift: (N, 6, P).
        by_warp = gradients[:, :, None, :] * _LATTICE[None, None]
        jacobian = (
            np.concatenate([by_warp.reshape(len(points_px), 4, _LATTICE.shape[1]), gradients], axis=1)
            / norms[:, None, None]
        )
        jacobian -= jacobian.mean(axis=2, keepdims=True)
        jacobian -= (jacobian @ values[:, :, None]) * values[:, None, :]
        normal = jacobian @ np.swapaxes(jacobian, 1, 2)
        diagonal = np.einsum("nii->ni", normal)
        diagonal *= 1.0 + _DAMPING
        diagonal += 1e-12
        solvers = (np.linalg.inv(normal) @ jacobian).astype(np.float32)
        return cls(values, solvers, warps)

    @property
    def best_places(self) -> Array:
        """Return which point of each first patch (N, 2) px from its centre a fit to the same image places best.

        A step of the fit moves the point x by t + W x. With the covariance of both, that of its place is least where
        the derivative of its trace by x is zero. It is the tip of a corner, which looks alike at every scale: any
        other point would move with the scale that the fit makes up.
        """
        solvers = self.solvers.astype(np.float64)
        of_steps = solvers @ np.swapaxes(solvers, 1, 2)
        of_warp = of_steps[:, :2, :2] + of_steps[:, 2:4, 2:4] + 1e-9 * np.eye(2)  # a flat patch takes no steps
        with_shift = of_steps[:, :2, 4] + of_steps[:, 2:4, 5]
        places = -np.linalg.solve(of_warp, with_shift[:, :, None])[:, :, 0]
        return np.asarray(np.clip(places, -_FARTHEST_PX, _FARTHEST_PX))

    def __getitem__(self, rows: BoolArray | IntArray) -> "Patches":
        """Return the patches of the tracks of a mask or of some rows."""
        return Patches(self.values[rows], self.solvers[rows], self.warps[rows])

    def joined(self, others: "Patches") -> "Patches":
        mine, theirs = vars(self), vars(others)
        return Patches(**{name: np.concatenate([mine[name], theirs[name]]) for name in mine})

    def fitted(self, image: Floats, points_px: Array) -> tuple["Patches", Array, Array]:
        """Fit each patch to an image of 32-bit floats, from points (N, 2) and the last warps on.

        Return the patches with their new warps, where they fit best (N, 2) px, and the correlation there (N,).
        """
        warps, centres = self.warps, points_px
        for _ in range(_ITERATIONS):
            values, _ = _normalised(_sampled(image, centres, warps))
            change = (self.solvers @ (values - self.values)[:, :, None])[:, :, 0]
            warps = warps @ inverse(np.eye(2) + change[:, :4].reshape(-1, 2, 2))
            centres = centres - np.einsum("nij,nj->ni", warps, change[:, 4:])
        values, _ = _normalised(_sampled(image, centres, warps))
        correlation = np.einsum("np,np->n", values, self.values)
        return Patches(self.values, self.solvers, warps), centres, correlation.astype(np.float64)


def inverse(matrices: Array) -> Array:
    """Return the inverses of matrices (N, 2, 2); LAPACK, called for each, takes a hundred times as long."""
    (a, b), (c, d) = matrices[:, 0].T, matrices[:, 1].T
    adjugates = np.stack([d, -b, -c, a], axis=1).reshape(-1, 2, 2)
    return np.asarray(adjugates / (a * d - b * c)[:, None, None])


def _sampled(image: Floats, centres_px: Array, warps: Array) -> Floats:
    """Return the image (N, P) on the lattice about centres (N, 2), warped; beyond its border 0."""
    import cv2

    if len(centres_px) == 0:
        return np.empty((0, _LATTICE.shape[1]), np.float32)
    columns, rows = (
        warps[:, i].astype(np.float32) @ _LATTICE + centres_px[:, i, None].astype(np.float32) for i in range(2)
    )
    return np.asarray(cv2.remap(image, columns, rows, cv2.INTER_LINEAR), dtype=np.float32)


def _normalised(values: Floats) -> tuple[Floats, Floats]:
    """Return patches (N, P) with zero mean and unit norm, and the norms (N,)."""
    centred = values - values.mean(axis=1, keepdims=True)
    norms = np.maximum(np.sqrt(np.einsum("np,np->n", centred, centred)), np.float32(1e-6))
    centred /= norms[:, None]
    return centred, norms
