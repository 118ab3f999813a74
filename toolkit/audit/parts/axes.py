"""Conventions of axes: the ways to exchange and negate three channels, and their names in words."""

import itertools

import numpy as np

from toolkit.geometry import Array

# A mirror image of the scene reverses the turns about two axes and the motion along the third.
MIRRORED = "; mirrored images have the same effect"


def signed_axes() -> Array:
    """Return the matrices (48, 3, 3) that exchange and negate axes, the identity first."""
    return np.stack(
        [
            np.eye(3)[list(order)] * np.array(signs)[:, None]
            for order in itertools.permutations(range(3))
            for signs in itertools.product((1.0, -1.0), repeat=3)
        ]
    )


def right_handed_axes() -> Array:
    """Return the rotations (24, 3, 3) that map axes to axes, the identity first."""
    signed = signed_axes()
    return np.asarray(signed[np.linalg.det(signed) > 0.0])


def axes_named(turn: Array) -> str:
    """Return in words which axes the rows of a matrix (3, 3) of `signed_axes` pick, for example "y, x, -z"."""
    largest = np.argmax(np.abs(turn), axis=1)
    return ", ".join(("-" if turn[row, axis] < 0 else "") + "xyz"[axis] for row, axis in enumerate(largest))
