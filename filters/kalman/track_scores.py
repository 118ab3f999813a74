"""How much less information tracks carry about a drift than their stated noise says: the design effect of their scores.

Errors of tracks do harm where they look like motion. A constant error ``eta`` (6,) of the twist during the life of a
track moves the pose of its k-th sighting by ``a_k eta``, where a_k is the number of frames from the middle of its life.
Let ``r`` be the track's residuals, whitened by the stated noise and projected off its landmark, and ``H`` their
Jacobian to ``eta``. The score of the track is ``H^T r``, and its covariance is ``H^T H`` if the noise is as stated.
Over tracks with independent errors,

    trace((sum H^T H)^-1 sum H^T r r^T H) / 6

is then 1; otherwise it is the ratio of actual to stated variance of the tracks' estimate of a drift (Liang & Zeger
1986, "Longitudinal data analysis using generalized linear models", for the sandwich estimator whose middle this is;
Kish 1965, "Survey sampling", for the term design effect). It assumes no model of the correlation along tracks and no
length of them: for white noise it is 1 for tracks of any length, for a random walk it grows with their length.
"""

from typing import NamedTuple, Self

import numpy as np

from filters.kalman import multiview
from filters.kalman.multiview import Linearised, TrackSightings
from filters.kalman.triangulation import triangulate
from toolkit.arrays import is_among, rows_of
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models.gating import chi2_bound
from toolkit.sequence import StereoFrame, StereoRig

# With three sightings, the fitted landmark absorbs too much of the residuals to show how successive ones correlate.
FEWEST_SIGHTINGS = 4
# Probability of the chi-square bound beyond which, by the stated noise, a sighting is an outlier and not used.
SOUND = 0.999
# Longer tracks are scored in parts, which bounds the memory of a track that never ends and lets it be scored.
_MOST_SIGHTINGS = 64
# This many ended tracks are scored at once, which takes little longer than scoring one.
_SCORED_TOGETHER = 40
# Fewer tracks do not determine a variance.
_FEWEST_TRACKS = 20
# With fewer tracks at once the poses err by more than the tracks do: on dataset3, with 4 tracks whose errors are below
# the stated noise, the design effect was 30 at the poses of fixed-lag and below 1 at those of batch.
_FEWEST_AT_ONCE = 20


class TrackScores:
    """Measures over a run the ratio of actual to stated variance of what tracks say of a drift.

    Sightings are kept until their tracks have ended. There are N of them; each has the number of its track, which is
    new if an id returns, and its column among the poses (W, 4, 4).
    """

    def __init__(self, rig: StereoRig) -> None:
        self._rig = rig
        self._information, self._squares, self._tracks = np.zeros((6, 6)), np.zeros((6, 6)), 0
        self._frames, self._seen = 0, 0
        self._numbers, self._columns = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        self._uvs_px, self._poses = np.empty((0, 3)), np.empty((0, 4, 4))
        self._in_view, self._begun, self._ended = _InView.nothing(), 0, 0

    @property
    def design_effect(self) -> float | None:
        """Return the design effect so far; None with too few tracks, or too few at once."""
        if self._tracks < _FEWEST_TRACKS or self._seen < _FEWEST_AT_ONCE * self._frames:
            return None
        return float(np.trace(np.linalg.solve(self._information, self._squares))) / 6.0

    @property
    def sightings(self) -> int:
        """Return how many sightings are kept because their tracks have not ended."""
        return len(self._numbers)

    def add(self, frame: StereoFrame, T_world_imu: Array) -> None:
        """Add the next frame, with its pose (4, 4), which will hardly change any more."""
        self._frames, self._seen = self._frames + 1, self._seen + len(frame.track_ids)
        before, self._in_view = self._in_view, self._in_view.at(frame.track_ids, self._begun)
        numbers = self._in_view.numbers
        new = int((numbers >= self._begun).sum())
        self._ended += len(before.numbers) - (len(numbers) - new)
        self._begun += new
        self._numbers = np.concatenate([self._numbers, numbers])
        self._columns = np.concatenate([self._columns, np.full(len(numbers), len(self._poses))])
        self._uvs_px = np.concatenate([self._uvs_px, frame.uvs_px[self._in_view.order]])
        self._poses = np.concatenate([self._poses, T_world_imu[None]])
        if self._ended >= _SCORED_TOGETHER:
            self._score()

    def finish(self) -> None:
        """Score the tracks that are still in view."""
        self._in_view = _InView.nothing()
        self._score()

    def _score(self) -> None:
        """Score the tracks that have ended, and drop their sightings and the poses that only they need."""
        rows = ~is_among(self._numbers, self._in_view.numbers)
        self._add_scores(self._tracks_of(rows))
        self._numbers, self._columns, self._uvs_px = self._numbers[~rows], self._columns[~rows], self._uvs_px[~rows]
        first = int(self._columns.min(initial=len(self._poses)))
        self._columns, self._poses, self._ended = self._columns - first, self._poses[first:], 0

    def _tracks_of(self, rows: BoolArray) -> TrackSightings:
        """Return the tracks of sightings (N,) that are long enough, one column per pose."""
        numbers, track = np.unique(self._numbers[rows], return_inverse=True)
        shape = (len(numbers), len(self._poses))
        uvs_px, seen = np.zeros((*shape, 3)), np.zeros(shape, dtype=bool)
        places = track, self._columns[rows]
        uvs_px[places], seen[places] = self._uvs_px[rows], True
        ages: IntArray = np.zeros(shape, dtype=np.int64)
        tracks = TrackSightings(numbers, uvs_px, seen, ages)
        return tracks.select(_are_long_enough(tracks))

    def _add_scores(self, sightings: TrackSightings) -> None:
        points, reliable = triangulate(sightings.uvs_px, sightings.seen, self._poses, self._rig)
        sightings, points = sightings.select(reliable), points[reliable]
        here = multiview.linearise(sightings, points, self._poses, self._poses, self._rig)
        sound = sightings.seen & (np.square(here.residuals).sum(axis=2) < chi2_bound(3, SOUND))
        sightings = sightings._replace(seen=sound)
        rows = _are_long_enough(sightings)
        if rows.any():
            information, scores = _scores(sightings.select(rows), here.select(rows))
            self._information += information.sum(axis=0)
            self._squares += scores.T @ scores
            self._tracks += len(scores)


class _InView(NamedTuple):
    """The tracks of a frame by ascending id (A,): numbers (A,), lengths (A,), and the order of their sightings."""

    track_ids: IntArray
    numbers: IntArray
    lengths: IntArray
    order: IntArray

    @classmethod
    def nothing(cls) -> Self:
        return cls(*(np.empty(0, dtype=np.int64) for _ in range(4)))

    def at(self, track_ids: IntArray, begun: int) -> "_InView":
        """Return the tracks of the next frame; new ones, and parts of long ones, are numbered from ``begun`` on."""
        order = np.argsort(track_ids)
        rows, known = rows_of(track_ids[order], self.track_ids)
        known[known] = self.lengths[rows[known]] < _MOST_SIGHTINGS
        numbers, lengths = np.empty_like(order), np.ones_like(order)
        numbers[known], lengths[known] = self.numbers[rows[known]], self.lengths[rows[known]] + 1
        numbers[~known] = begun + np.arange((~known).sum())
        return _InView(track_ids[order], numbers, lengths, order)


def _are_long_enough(sightings: TrackSightings) -> BoolArray:
    return np.asarray(sightings.seen.sum(axis=1) >= FEWEST_SIGHTINGS)


def _scores(sightings: TrackSightings, here: Linearised) -> tuple[Array, Array]:
    """Return the information (F, 6, 6) of tracks about a drift, and their scores (F, 6)."""
    count, window = sightings.seen.shape
    seen, frames = sightings.seen, np.arange(window)
    levers = np.where(seen, frames - ((seen * frames).sum(axis=1) / seen.sum(axis=1))[:, None], 0.0)
    H = (levers[..., None, None] * here.H_pose).reshape(count, 3 * window, 6)
    reached = np.linalg.qr(np.where(seen[..., None, None], here.H_point, 0.0).reshape(count, 3 * window, 3)).Q
    H -= reached @ (np.swapaxes(reached, 1, 2) @ H)
    residuals = np.where(seen[..., None], here.residuals, 0.0).reshape(count, 3 * window, 1)
    H_transposed = np.swapaxes(H, 1, 2)
    return H_transposed @ H, (H_transposed @ residuals)[..., 0]
