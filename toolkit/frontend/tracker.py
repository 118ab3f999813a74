"""Stereo tracks from one rectified pair of images to the next: track, verify, start new tracks where there is room.

A corner is matched along its row at birth; from then on it is followed in time in the left image and from left to
right, and measured in both where its first patch fits. It ends, and its id with it, where one of the tests says that
it is no longer the same point of the scene: KLT there and back, the motion most tracks agree on (RANSAC), the first
patch, the row and the sign of the disparity.

New corners are spread over a grid, away from existing tracks (Shi & Tomasi 1994); their match in the right image is
found by normalised correlation along the row, at half the resolution; from image to image they are tracked by pyramidal
Lucas-Kanade, forward and backward (Bouguet 2001).
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from toolkit.frontend.cameras import Image, RectifiedPair
from toolkit.frontend.motion import Rigidity, StereoMotion
from toolkit.frontend.patches import Floats, Patches, inverse
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.settings import Frontend

# Most corners are lost in the first match, so this many times the wanted number are matched.
_CANDIDATES = 3
# A corner without a match is not tried again for this many frames, within this many pixels.
_COOL_DOWN_FRAMES, _COOL_DOWN_PX = 5, 4
# Fewer than this share of the tracks found in the right image, and of no fewer tracks: it belongs to another instant.
_LEAST_PAIRED, _FEWEST_TO_TEST = 0.25, 20
_LEVELS_RIGHT = 1
_LEAST_DISPARITY_PX = 0.5
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


class TrackedCorners(NamedTuple):
    """The tracks of one pair: ids (N,) and corners (N, 4) px: uL, vL, uR, vR."""

    track_ids: IntArray
    corners_px: Array


@dataclass(frozen=True, eq=False)
class _Tracks:
    """Tracks as the last pair has them: ids (N,), places left and right (N, 2) px, and their first patches.

    ``right_warps`` (N, 2, 2) are those that fit the first patches into the right image. A track that is not ``sound``
    (N,) has left its point. It is still tracked, so that no new track starts in its place and leaves the point again.
    """

    ids: IntArray
    left_px: Array
    right_px: Array
    patches: Patches
    right_warps: Array
    sound: BoolArray

    def select(self, rows: BoolArray) -> "_Tracks":
        if rows.all():  # as most tests leave it; the patches are megabytes
            return self
        return _Tracks(**{name: values[rows] for name, values in vars(self).items()})

    def joined(self, others: "_Tracks") -> "_Tracks":
        if len(others.ids) == 0:
            return self
        both = {name: (mine, getattr(others, name)) for name, mine in vars(self).items() if name != "patches"}
        return _Tracks(patches=self.patches.joined(others.patches), **{k: np.concatenate(v) for k, v in both.items()})


_NO_TRACKS = _Tracks(
    *(np.empty(0, dtype=np.int64), np.empty((0, 2)), np.empty((0, 2)), Patches.none()),
    *(np.empty((0, 2, 2)), np.empty(0, dtype=bool)),
)


@dataclass(eq=False)
class Tracker:
    """Tracks over consecutive pairs of one rectified rig."""

    rig: RectifiedPair
    settings: Frontend
    _tracks: _Tracks = field(default=_NO_TRACKS, init=False)
    _before: Image | None = field(default=None, init=False)
    _next_id: int = field(default=0, init=False)
    _hopeless: list[Array] = field(default_factory=list, init=False)
    tried: int = field(default=0, init=False)  # corners that were looked for in a right image

    def __post_init__(self) -> None:
        requested = self.settings
        self._flow = Flow(requested.window_px, requested.levels, requested.forward_backward_px)
        self._across = Flow(requested.window_px, _LEVELS_RIGHT, 2.0 * requested.forward_backward_px)
        self._motion = StereoMotion(self.rig.stereo_rig, self.rig.size_px, requested.ransac_px)
        self._rigidity = Rigidity(self.rig.stereo_rig, requested.ransac_px)
        self._seen = self.rig.seen(0), self.rig.seen(1)
        # A grid of nearly square cells, such that each holds about four tracks.
        width, height = self.rig.size_px
        rows = max(round(float(np.sqrt(0.25 * requested.max_tracks * height / width))), 2)
        self._grid = rows, max(round(rows * width / height), 2)

    def step(self, left: Image, right: Image) -> TrackedCorners | None:
        """Follow the tracks into the next pair and begin new ones.

        Return None, and stay at the pair before, where the right image is not of the same instant as the left one.
        """
        floats, right_floats = (image.astype(np.float32) for image in (left, right))  # interpolated without rounding
        found, motion = self._followed(left, floats)
        paired = self._fitted_right(right_floats, self._paired(left, right, found))
        agrees = motion.agrees(paired.left_px, paired.right_px, paired.ids)
        if len(found.ids) >= _FEWEST_TO_TEST and agrees.sum() < _LEAST_PAIRED * len(found.ids):
            return None
        self._motion = motion
        tracks = paired.select(agrees)
        at_their_points = self._rigidity.agrees(tracks.left_px, tracks.right_px, tracks.ids)
        tracks = replace(tracks, sound=tracks.sound & at_their_points)
        tracks = tracks.joined(self._fitted_right(right_floats, self._begun(left, right, floats, tracks)))
        self._motion = self._motion.at(tracks.left_px, tracks.right_px, tracks.ids)
        self._tracks, self._before = tracks, left
        seen = tracks.ids[tracks.sound], tracks.left_px[tracks.sound], tracks.right_px[tracks.sound]
        self._rigidity = self._rigidity.after(*seen[1:], seen[0])
        return TrackedCorners(seen[0], np.hstack(seen[1:]))

    def _followed(self, left: Image, floats: Floats) -> tuple[_Tracks, StereoMotion]:
        """Return the tracks that are found in the left image, still paired as before, and how the camera moved."""
        before = self._tracks
        if self._before is None or len(before.ids) == 0:
            return _NO_TRACKS, self._motion
        guesses_px = self._motion.predicted(before.left_px)
        left_px, found = self._flow.follow(self._before, left, before.left_px, guesses_px)
        found &= self._inside(left_px, 0)
        rows = np.flatnonzero(found)
        motion, moved_alike = self._motion.moved(rows, left_px[rows])
        rows = rows[moved_alike]
        patches, fitted_px, same = self._same(before.patches[rows], floats, left_px[rows])
        # The position of a track is where its first patch fits: the accumulated errors of KLT would drift away from it.
        rows, patches, here_px = rows[same], patches[same], fitted_px[same]
        shift_px = here_px - before.left_px[rows]
        right_warps = before.right_warps[rows] @ inverse(before.patches.warps[rows]) @ patches.warps
        followed = _Tracks(
            *(before.ids[rows], here_px, before.right_px[rows] + shift_px, patches, right_warps, before.sound[rows])
        )
        return followed, motion

    def _same(self, patches: Patches, image: Floats, places_px: Array) -> tuple[Patches, Array, BoolArray]:
        """Fit first patches to an image from places (N, 2) px: return them, where they fit, and which still do."""
        fitted, fitted_px, correlation = patches.fitted(image, places_px)
        off_px = np.linalg.norm(fitted_px - places_px, axis=1)
        return fitted, fitted_px, (off_px < self.settings.patch_px) & (correlation > self.settings.patch_correlation)

    def _paired(self, left: Image, right: Image, tracks: _Tracks) -> _Tracks:
        right_px, found = self._found_right(left, right, tracks.left_px, tracks.right_px)
        return replace(tracks, right_px=right_px).select(found)

    def _fitted_right(self, right: Floats, tracks: _Tracks) -> _Tracks:
        """Return the tracks measured in the right image where their first patches fit it, without those that do not.

        The right camera sees a slanted surface under another angle: a window that only shifts would bias its disparity.
        """
        as_seen = replace(tracks.patches, warps=tracks.right_warps)
        patches, fitted_px, same = self._same(as_seen, right, tracks.right_px)
        same &= np.abs(tracks.left_px[:, 1] - fitted_px[:, 1]) < self.settings.epipolar_px
        same &= (tracks.left_px[:, 0] - fitted_px[:, 0] > _LEAST_DISPARITY_PX) & self._inside(fitted_px, 1)
        return replace(tracks, right_px=fitted_px, right_warps=patches.warps).select(same)

    def _found_right(self, left: Image, right: Image, left_px: Array, near_px: Array) -> tuple[Array, BoolArray]:
        """Return where points (N, 2) of the left image are in the right one, sought near (N, 2), and if found (N,)."""
        right_px, found = self._across.follow(left, right, left_px, near_px)
        disparity_px = left_px[:, 0] - right_px[:, 0]
        found &= np.abs(left_px[:, 1] - right_px[:, 1]) < self.settings.epipolar_px
        found &= (disparity_px > _LEAST_DISPARITY_PX) & (disparity_px < self._most_disparity_px)
        return right_px, found & self._inside(right_px, 1)

    @property
    def _most_disparity_px(self) -> float:
        return min(self.rig.fx_px * self.rig.baseline_m / self.settings.nearest_m, 0.5 * self.rig.size_px[0])

    def _begun(self, left: Image, right: Image, floats: Floats, tracks: _Tracks) -> _Tracks:
        wanted = self.settings.max_tracks - int(tracks.sound.sum())
        if wanted <= 0:
            return _NO_TRACKS
        cells = _cells_of(tracks.left_px, self.rig.size_px, self._grid)
        present = np.bincount(cells, minlength=self._grid[0] * self._grid[1]).reshape(self._grid)
        free = self._free(tracks.left_px)
        places_px = corners(left, free, present, self.settings.spacing_px, _CANDIDATES * wanted)
        self.tried += len(places_px)
        near_px, found = match_rows(left, right, places_px, self._most_disparity_px)
        rows = np.flatnonzero(found)
        right_px, paired = self._found_right(left, right, places_px[rows], near_px[rows])
        found[rows] = paired
        self._hopeless = [places_px[~found], *self._hopeless[: _COOL_DOWN_FRAMES - 1]]
        begun_px, right_px = places_px[found][:wanted], right_px[paired][:wanted]
        best_px = Patches.taken(floats, begun_px).best_places
        begun_px, right_px = begun_px + best_px, right_px + best_px
        new_ids = self._next_id + np.arange(len(begun_px))
        self._next_id += len(begun_px)
        identities = np.tile(np.eye(2), (len(begun_px), 1, 1))
        sound = np.ones(len(begun_px), dtype=bool)
        return _Tracks(new_ids, begun_px, right_px, Patches.taken(floats, begun_px), identities, sound)

    def _free(self, taken_px: Array) -> BoolArray:
        import cv2

        free = self._seen[0].astype(np.uint8)
        radius = int(self.settings.spacing_px)
        for points, r in ((taken_px, radius), *((hopeless, _COOL_DOWN_PX) for hopeless in self._hopeless)):
            for x, y in np.rint(points).astype(int).tolist():
                cv2.circle(free, (x, y), r, 0, -1)
        return np.asarray(free > 0)

    def _inside(self, points_px: Array, side: int) -> BoolArray:
        width, height = self.rig.size_px
        column, row = np.rint(points_px).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        return np.asarray(inside & self._seen[side][np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)])


# Corners -------------------------------------------------------------------------------------------------------------


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


def _cells_of(points_px: Array, size_px: tuple[int, int], grid: tuple[int, int]) -> IntArray:
    column = np.clip(points_px[:, 0] * grid[1] / size_px[0], 0, grid[1] - 1).astype(np.int64)
    row = np.clip(points_px[:, 1] * grid[0] / size_px[1], 0, grid[0] - 1).astype(np.int64)
    return row * grid[1] + column


def match_rows(left: Image, right: Image, points_px: Array, most_disparity_px: float) -> tuple[Array, BoolArray]:
    """Return where points (N, 2) px of a rectified left image are in the right one, to 2 px, and if found (N,).

    Both images are halved, and the best match in the row is sought.
    """
    import cv2

    left, right = (np.asarray(cv2.pyrDown(image), dtype=np.uint8) for image in (left, right))
    places, found = points_px.copy(), np.zeros(len(points_px), dtype=bool)
    search_px, (height, width) = int(np.ceil(0.5 * most_disparity_px)), left.shape
    for i, (x, y) in enumerate(np.rint(0.5 * points_px).astype(int).tolist()):
        lower, upper = y - _HALF_PX - _ROWS_PX, y + _HALF_PX + _ROWS_PX + 1
        first, last = max(x - search_px - _HALF_PX, 0), min(x + _HALF_PX + 1, width)
        if lower < 0 or upper > height or x - _HALF_PX < 0 or last - first < 2 * _HALF_PX + 1 or x + _HALF_PX >= width:
            continue
        template = left[y - _HALF_PX : y + _HALF_PX + 1, x - _HALF_PX : x + _HALF_PX + 1]
        alike = cv2.matchTemplate(right[lower:upper, first:last], template, cv2.TM_CCOEFF_NORMED)
        _, best, _, (column, _row) = cv2.minMaxLoc(alike)
        if best > _LEAST_CORRELATION:
            places[i, 0] += 2.0 * (first + column + _HALF_PX - x)
            found[i] = True
    return places, found


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
