"""Corners: detection for new tracks, matching in the right image, and tracking into the next image.

New corners are spread over a grid, away from existing tracks (Shi & Tomasi 1994); their match in the right image is
found by normalised correlation along the row, at half the resolution; from image to image they are tracked by pyramidal
Lucas-Kanade, forward and backward (Bouguet 2001).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from toolkit.frontend.cameras import Image
from toolkit.geometry import Array, BoolArray, IntArray

# Corners weaker than this share of the image's strong ones are edges and noise.
_LEAST_OF_STRONG, _STRONG_PERCENTILE = 0.01, 99.0
# An eigenvalue below this (of gradients a pixel, grey values of 256) is the noise of the sensor.
_LEAST_STRENGTH = 1e-4
_BLOCK_PX = 5
_HALF_PX = 5  # the template is 11 x 11 px of the halved image
_ROWS_PX = 1  # rows searched above and below
_LEAST_CORRELATION = 0.7
# Of Lucas-Kanade; backward tracking needs no pyramid, because it starts near the true place.
_ITERATIONS, _STOP_PX = 30, 0.01
_LEVELS_BACK = 1


def corners(image: Image, free: BoolArray, present: IntArray, spacing_px: float, most: int) -> Array:
    """Return ``most`` corners or fewer (N, 2) px, first those of the emptiest cells, and in a cell the strongest.

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
    cells = _cells_of(points, (image.shape[1], image.shape[0]), (present.shape[0], present.shape[1]))
    by_cell = np.lexsort((-strength[rows, columns], cells))
    in_order = cells[by_cell]
    place = np.arange(cells.size) - np.searchsorted(in_order, in_order) + present.ravel()[in_order]
    chosen = by_cell[np.lexsort((-strength[rows, columns][by_cell], place))]
    return points[chosen[:most]]


def grid_of(size_px: tuple[int, int], tracks: int) -> tuple[int, int]:
    """Return rows and columns of a grid of nearly square cells, such that each holds about four tracks."""
    width, height = size_px
    rows = max(round(float(np.sqrt(0.25 * tracks * height / width))), 2)
    return rows, max(round(rows * width / height), 2)


def count_in_cells(points_px: Array, size_px: tuple[int, int], grid: tuple[int, int]) -> IntArray:
    """Return how many points (N, 2) lie in each cell (rows, columns)."""
    cells = _cells_of(points_px, size_px, grid)
    return np.bincount(cells, minlength=grid[0] * grid[1]).reshape(grid)


def _cells_of(points_px: Array, size_px: tuple[int, int], grid: tuple[int, int]) -> IntArray:
    column = np.clip(points_px[:, 0] * grid[1] / size_px[0], 0, grid[1] - 1).astype(np.int64)
    row = np.clip(points_px[:, 1] * grid[0] / size_px[1], 0, grid[0] - 1).astype(np.int64)
    return row * grid[1] + column


def halved(image: Image) -> Image:
    import cv2

    return np.asarray(cv2.pyrDown(image), dtype=np.uint8)


def match_rows(left: Image, right: Image, points_px: Array, most_disparity_px: float) -> tuple[Array, BoolArray]:
    """Return where points (N, 2) px of a rectified left image are in the right one, to 2 px, and if found (N,).

    The images are halved ones, the points those of the whole left image.
    """
    places, found = points_px.copy(), np.zeros(len(points_px), dtype=bool)
    search_px = int(np.ceil(0.5 * most_disparity_px))
    for i, (x, y) in enumerate(np.rint(0.5 * points_px).astype(int).tolist()):
        match = _best(left, right, x, y, search_px)
        if match is not None:
            places[i, 0] += 2.0 * match
            found[i] = True
    return places, found


def _best(left: Image, right: Image, x: int, y: int, search_px: int) -> int | None:
    """Return by how many pixels the best match in the row lies off the point, or None where nothing is alike."""
    import cv2

    height, width = left.shape
    lower, upper = y - _HALF_PX - _ROWS_PX, y + _HALF_PX + _ROWS_PX + 1
    first, last = max(x - search_px - _HALF_PX, 0), min(x + _HALF_PX + 1, width)
    if lower < 0 or upper > height or x - _HALF_PX < 0 or last - first < 2 * _HALF_PX + 1 or x + _HALF_PX >= width:
        return None
    template = left[y - _HALF_PX : y + _HALF_PX + 1, x - _HALF_PX : x + _HALF_PX + 1]
    alike = cv2.matchTemplate(right[lower:upper, first:last], template, cv2.TM_CCOEFF_NORMED)
    _, best, _, (column, _row) = cv2.minMaxLoc(alike)
    return first + column + _HALF_PX - x if best > _LEAST_CORRELATION else None


@dataclass(frozen=True)
class Flow:
    """How points are followed: side of the window (px), halvings of the image, error allowed there and back (px)."""

    window_px: int
    levels: int
    forward_backward_px: float

    def follow(self, before: Image, after: Image, points_px: Array, guesses_px: Array) -> tuple[Array, BoolArray]:
        """Return where points (N, 2) of an image are in another, sought from guesses (N, 2), and whether found (N,).

        A point is found if backward tracking returns to it.
        """
        if len(points_px) == 0:  # of no points OpenCV gives back None
            return np.empty((0, 2)), np.zeros(0, dtype=bool)
        there, found = self._klt(before, after, points_px, guesses_px, self.levels)
        back, returned = self._klt(after, before, there, points_px, min(self.levels, _LEVELS_BACK))
        off_px = np.linalg.norm(back - points_px, axis=1)
        height, width = after.shape
        inside = (there >= 0.0).all(axis=1) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)
        return there, found & returned & inside & (off_px < self.forward_backward_px)

    def _klt(self, before: Image, after: Image, points: Array, guesses: Array, levels: int) -> tuple[Array, BoolArray]:
        import cv2

        there, status, _ = cv2.calcOpticalFlowPyrLK(
            before,
            after,
            _as_points(points),
            _as_points(guesses),
            winSize=(self.window_px, self.window_px),
            maxLevel=levels,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _ITERATIONS, _STOP_PX),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        return np.asarray(there, dtype=np.float64)[:, 0], np.asarray(status)[:, 0] > 0


def _as_points(points_px: Array) -> npt.NDArray[np.float32]:
    """Return points (N, 2) as OpenCV takes them: a contiguous copy (N, 1, 2), into which it may write."""
    return np.array(points_px, dtype=np.float32, order="C").reshape(-1, 1, 2)
