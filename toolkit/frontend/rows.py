"""A new corner's place in the right image: normalised correlation along its row, at half the resolution."""

import numpy as np

from toolkit.frontend.cameras import Image
from toolkit.geometry import Array, BoolArray

_HALF_PX = 5  # the template is 11 x 11 px of the halved image
_ROWS_PX = 1  # rows searched above and below
_LEAST_CORRELATION = 0.7


def halved(image: Image) -> Image:
    """Return an image of half the width and height."""
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
