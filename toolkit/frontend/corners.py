"""Where new tracks may begin: corners spread over a grid, away from the tracks there are (Shi & Tomasi 1994)."""

import numpy as np

from toolkit.frontend.cameras import Image
from toolkit.geometry import Array, BoolArray, IntArray

# Corners weaker than this share of the image's strong ones are edges and noise.
_LEAST_OF_STRONG, _STRONG_PERCENTILE = 0.01, 99.0
# An eigenvalue below this (of gradients a pixel, grey values of 256) is the noise of the sensor.
_LEAST_STRENGTH = 1e-4
_BLOCK_PX = 5


def corners(image: Image, free: BoolArray, present: IntArray, spacing_px: float, most: int) -> Array:
    """Return at most so many corners (N, 2) px, first those of the emptiest cells, and in a cell the strongest.

    ``free`` says for each pixel whether a track may begin there, ``present`` (rows, columns) how many tracks each cell
    of the grid holds. No two corners are nearer than the spacing.
    """
    import cv2

    strength = np.asarray(cv2.cornerMinEigenVal(image, _BLOCK_PX, ksize=3))
    reach = 2 * int(spacing_px) + 1
    highest = cv2.dilate(strength, np.ones((reach, reach), np.uint8))
    strong = float(np.percentile(strength[::4, ::4], _STRONG_PERCENTILE))
    least = max(_LEAST_OF_STRONG * strong, _LEAST_STRENGTH)
    peaks = np.flatnonzero(strength == highest)
    peaks = peaks[(strength.ravel()[peaks] > least) & free.ravel()[peaks]]
    rows, columns = np.divmod(peaks, image.shape[1])
    points = np.stack([columns, rows], axis=1).astype(np.float64)
    cells = cells_of(points, (image.shape[1], image.shape[0]), (present.shape[0], present.shape[1]))
    by_cell = np.lexsort((-strength[rows, columns], cells))
    in_order = cells[by_cell]
    place = np.arange(cells.size) - np.searchsorted(in_order, in_order) + present.ravel()[in_order]
    chosen = by_cell[np.lexsort((-strength[rows, columns][by_cell], place))]
    return points[chosen[:most]]


def grid_of(size_px: tuple[int, int], tracks: int) -> tuple[int, int]:
    """Return rows and columns of a grid of nearly square cells, so many that each holds about four tracks."""
    width, height = size_px
    rows = max(round(float(np.sqrt(0.25 * tracks * height / width))), 2)
    return rows, max(round(rows * width / height), 2)


def count_in_cells(points_px: Array, size_px: tuple[int, int], grid: tuple[int, int]) -> IntArray:
    """Return how many points (N, 2) lie in each cell (rows, columns)."""
    cells = cells_of(points_px, size_px, grid)
    return np.bincount(cells, minlength=grid[0] * grid[1]).reshape(grid)


def cells_of(points_px: Array, size_px: tuple[int, int], grid: tuple[int, int]) -> IntArray:
    """Return the cell (N,) of each point (N, 2), counted row by row."""
    column = np.clip(points_px[:, 0] * grid[1] / size_px[0], 0, grid[1] - 1).astype(np.int64)
    row = np.clip(points_px[:, 1] * grid[0] / size_px[1], 0, grid[0] - 1).astype(np.int64)
    return row * grid[1] + column
