"""Does a track still show what it began with? Its first patch, fitted into today's image by an affine warp.

Frame-to-frame tracking drifts from one structure to the next in small steps that look right one by one; against the
first patch the sum of them shows (Shi & Tomasi 1994), and can be taken out. Inverse compositional (Baker & Matthews
2004) on patches of zero mean and unit norm, which takes out gain and bias of the exposure; the gradients of the first
patch serve for all time.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from toolkit.frontend.cameras import Image
from toolkit.geometry import Array, BoolArray, IntArray

_HALF_PX = 7
_ITERATIONS = 4
_DAMPING = 1e-3
# A corner detector is not off by more; further away another structure may be the better one.
_FARTHEST_PX = 3.0
# The lattice of a patch, (2, P) px about its centre.
_LATTICE = np.stack(np.meshgrid(*2 * [np.arange(-_HALF_PX, _HALF_PX + 1)], indexing="xy")).reshape(2, -1).astype(float)


@dataclass(frozen=True, eq=False)
class Patches:
    """First patches of N tracks: normalised values (N, P), pseudo-inverses (N, 6, P), and today's warps (N, 2, 2)."""

    values: Array
    solvers: Array
    warps: Array

    @classmethod
    def none(cls) -> Self:
        """Return the patches of no track."""
        size = _LATTICE.shape[1]
        return cls(np.empty((0, size)), np.empty((0, 6, size)), np.empty((0, 2, 2)))

    @classmethod
    def taken(cls, image: Array, points_px: Array) -> Self:
        """Return the patches around points (N, 2) of an image of 32-bit floats."""
        warps = np.tile(np.eye(2), (len(points_px), 1, 1))
        values, norms = _normalised(_sampled(image, points_px, warps))
        steps = np.eye(2)
        gradients = np.stack(
            [0.5 * (_sampled(image, points_px + d, warps) - _sampled(image, points_px - d, warps)) for d in steps], 1
        )
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
        solvers = np.asarray(np.linalg.inv(normal) @ jacobian, dtype=np.float64)
        return cls(values, solvers, warps)

    @property
    def best_places(self) -> Array:
        """Return which point of each first patch (N, 2) px from its centre a fit to the same image places best.

        A step of the fit moves the point x by t + W x. With the covariance of both, that of its place is least where
        the derivative of its trace by x is zero. It is the tip of a corner, which looks alike at every scale: any
        other point would move with the scale that the fit makes up.
        """
        of_steps = self.solvers @ np.swapaxes(self.solvers, 1, 2)
        of_warp = of_steps[:, :2, :2] + of_steps[:, 2:4, 2:4] + 1e-9 * np.eye(2)  # a flat patch takes no steps
        with_shift = of_steps[:, :2, 4] + of_steps[:, 2:4, 5]
        places = -np.linalg.solve(of_warp, with_shift[:, :, None])[:, :, 0]
        return np.asarray(np.clip(places, -_FARTHEST_PX, _FARTHEST_PX))

    def select(self, rows: BoolArray | IntArray) -> "Patches":
        """Return the patches of some tracks."""
        return Patches(self.values[rows], self.solvers[rows], self.warps[rows])

    def joined(self, others: "Patches") -> "Patches":
        """Return these patches and others behind them."""
        mine, theirs = vars(self), vars(others)
        return Patches(**{name: np.concatenate([mine[name], theirs[name]]) for name in mine})

    def fitted(self, image: Array, points_px: Array) -> tuple["Patches", Array, Array]:
        """Fit each patch to an image of 32-bit floats, from points (N, 2) and the last warps on.

        Return the patches with their new warps, where they fit best (N, 2) px, and the correlation there (N,).
        """
        warps, centres = self.warps, points_px
        for _ in range(_ITERATIONS):
            values, _ = _normalised(_sampled(image, centres, warps))
            change = (self.solvers @ (values - self.values)[:, :, None])[:, :, 0]
            step = np.eye(2) + change[:, :4].reshape(-1, 2, 2)
            warps = warps @ np.linalg.inv(step)
            centres = centres - np.einsum("nij,nj->ni", warps, change[:, 4:])
        values, _ = _normalised(_sampled(image, centres, warps))
        return Patches(self.values, self.solvers, warps), centres, (values * self.values).sum(axis=1)


def _sampled(image: Array, centres_px: Array, warps: Array) -> Array:
    """Return the image (N, P) on the lattice about centres (N, 2), warped; beyond its border 0."""
    import cv2

    if len(centres_px) == 0:
        return np.empty((0, _LATTICE.shape[1]))
    places = (centres_px[:, :, None] + warps @ _LATTICE).astype(np.float32)
    return np.asarray(
        cv2.remap(image, np.ascontiguousarray(places[:, 0]), np.ascontiguousarray(places[:, 1]), cv2.INTER_LINEAR),
        dtype=np.float64,
    )


def _normalised(values: Array) -> tuple[Array, Array]:
    """Return patches (N, P) with zero mean and unit norm, and the norms (N,)."""
    centred = values - values.mean(axis=1, keepdims=True)
    norms = np.maximum(np.linalg.norm(centred, axis=1), 1e-6)
    return centred / norms[:, None], norms


def as_floats(image: Image) -> Array:
    """Return an image as 32-bit floats, which are interpolated without rounding."""
    return image.astype(np.float32)
