"""The first sightings of every visible track, in the channels (c, d, v), sorted by how many they are.

The camera of the channels stands half-way between the two of the rig: there a point (x, y, z) is seen in the mean
column ``c = fx x / z + cx``, at the disparity ``d = fx b / z``, in the row ``v = fy y / z + cy``, and a landmark, given
by its own (c, d, v) in the track's first frame, may be as far as it likes: d is an inverse depth (Civera, Davison &
Montiel, "Inverse depth parametrization for monocular SLAM", 2008).
"""

from dataclasses import dataclass, replace

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray, se3
from toolkit.models.gating import LEAST_DISPARITY_PX
from toolkit.sequence import Sequence, StereoRig, is_left_only
from toolkit.track_noise import CHANNELS

# A landmark has three unknowns, and so has a sighting: from the third on a walk can be told from white noise.
FEWEST_SIGHTINGS = 3
# Of longer tracks the first ones are used: they show a walk of twelve steps, and the time taken goes with the square.
MOST_SIGHTINGS = 12
# More tracks in a frame say nothing new about their noise; of more an even share is used.
MOST_A_FRAME = 80
# Of longer recordings stretches of so many frames, evenly spread, are used: an hour is fitted in seconds, too.
MOST_FRAMES, STRETCH_FRAMES = 1200, 100


@dataclass(frozen=True, eq=False)
class Tracklets:
    """B tracks of n sightings each, in successive frames.

    ``first_frame`` (B,), increasing; ``cdv_px`` (B, n, 3) measured channels; ``landmark_cdv_px`` (B, 3) the estimated
    landmark, as the channels would be in the first frame; ``track_id`` (B,).
    """

    first_frame: IntArray
    track_id: IntArray
    cdv_px: Array
    landmark_cdv_px: Array

    @property
    def sightings(self) -> int:
        """Return n."""
        return int(self.cdv_px.shape[1])

    @property
    def equations(self) -> int:
        """Return how many equations a track has left, the landmark's three unknowns eliminated."""
        return 3 * self.sightings - 3

    @property
    def frames(self) -> IntArray:
        """Return the frame (B, n) of each sighting."""
        return self.first_frame[:, None] + np.arange(self.sightings)

    def moved(self, by_px: Array) -> "Tracklets":
        """Return them with landmarks moved by (B, 3) px, none beyond infinity."""
        landmark = self.landmark_cdv_px + by_px
        landmark[:, 1] = np.maximum(landmark[:, 1], 0.0)
        return replace(self, landmark_cdv_px=landmark)

    def select(self, rows: BoolArray | IntArray | slice) -> "Tracklets":
        """Return those of a mask (B,) or an index (M,)."""
        return Tracklets(self.first_frame[rows], self.track_id[rows], self.cdv_px[rows], self.landmark_cdv_px[rows])


def tracklets(sequence: Sequence) -> tuple[Tracklets, ...]:
    """Return the tracks an estimator may see, a group for each number of sightings; none where none is long enough."""
    seen = sequence.visible
    # Disparities are what the noise is told by: a track ends where it lacks the right image.
    seen = seen.select(~is_left_only(seen.uv_px))
    order = np.lexsort((seen.frame, seen.track_id))
    frame, track_id, cdv_px = seen.frame[order], seen.track_id[order], seen.uv_px[order] @ CHANNELS.T
    first = np.flatnonzero(np.diff(track_id, prepend=track_id[:1] - 1) != 0)
    count = _unbroken(frame, track_id, first)
    # Selected by the first sighting: by all of them, noise of the later ones would decide who stays.
    usable = (cdv_px[first, 1] > LEAST_DISPARITY_PX) & (count >= FEWEST_SIGHTINGS)
    usable &= _in_stretches(frame[first], sequence.frame_count)
    frames = min(sequence.frame_count, MOST_FRAMES)
    usable &= _evenly(usable, float(np.minimum(count, MOST_SIGHTINGS)[usable].sum()) / max(frames, 1))
    groups = []
    for n in np.unique(count[usable]).tolist():
        begin = first[usable & (count == n)]
        begin = begin[np.argsort(frame[begin], kind="stable")]
        rows = begin[:, None] + np.arange(n)
        finite = np.isfinite(cdv_px[rows]).all(axis=(1, 2))
        begin, rows = begin[finite], rows[finite]
        if begin.size:
            groups.append(Tracklets(frame[begin], track_id[begin], cdv_px[rows], cdv_px[begin]))
    return tuple(groups)


def _unbroken(frame: IntArray, track_id: IntArray, first: IntArray) -> IntArray:
    """Return how many sightings (T,) each track, whose first row is given, has in successive frames from its first."""
    breaks = np.flatnonzero((np.diff(frame, prepend=-2) != 1) | (np.diff(track_id, prepend=-1) != 0))
    following = np.append(breaks, frame.size)[np.searchsorted(breaks, first, side="right")]
    return np.minimum(following - first, MOST_SIGHTINGS)


def _in_stretches(frame: IntArray, frame_count: int) -> BoolArray:
    """Say of frames (T,) whether they are in one of the stretches that are used."""
    if frame_count <= MOST_FRAMES:
        return np.ones(frame.size, dtype=bool)
    period = frame_count * STRETCH_FRAMES // MOST_FRAMES
    return np.asarray(frame % period < STRETCH_FRAMES)


def _evenly(usable: BoolArray, a_frame: float) -> BoolArray:
    """Say of tracks (T,) which to keep so that no more than MOST_A_FRAME are in a frame on average."""
    number = np.cumsum(usable) * min(MOST_A_FRAME / max(a_frame, 1.0), 1.0)
    return np.asarray(np.diff(np.floor(number), prepend=0.0) > 0.0)


def middle_of_pair(rig: StereoRig) -> Array:
    """Return T_cam_middle (4, 4): the left camera's pose of the camera half-way between left and right."""
    return se3(np.eye(3), np.array([0.5 * rig.baseline_m, 0.0, 0.0]))
