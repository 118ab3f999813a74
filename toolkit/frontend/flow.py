"""Points followed from one image to another: pyramidal Lucas-Kanade, there and back (Bouguet 2001)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from toolkit.frontend.cameras import Image
from toolkit.geometry import Array, BoolArray

_ITERATIONS, _STOP_PX = 30, 0.01
# Near the true place already: no pyramid is needed on the way back.
_LEVELS_BACK = 1


@dataclass(frozen=True)
class Flow:
    """How points are followed: side of the window (px), halvings of the image, error allowed there and back (px)."""

    window_px: int
    levels: int
    forward_backward_px: float

    def follow(self, before: Image, after: Image, points_px: Array, guesses_px: Array) -> tuple[Array, BoolArray]:
        """Return where points (N, 2) of an image are in another, sought from guesses (N, 2), and whether found (N,).

        Found is what leads back to where it came from.
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
