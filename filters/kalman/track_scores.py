"""How much less tracks tell of a drift than their stated noise has it: the design effect of their scores.

Of what tracks are wrong by, that part does harm which looks like motion. A constant error ``eta`` (6,) of the twist
over the life of a track moves the pose of its k-th sighting by ``a_k eta``, a_k the frames from the middle of its life.
With its residuals ``r``, whitened as stated and freed of its landmark, and their Jacobian ``H`` to ``eta``, the score
of the track is ``H^T r``, and its covariance ``H^T H`` where the noise is as stated. Over tracks that err independently

    trace((sum H^T H)^-1 sum H^T r r^T H) / 6

is 1 then, and else how many times the stated variance what tracks say of a drift has (Liang & Zeger 1986,
"Longitudinal data analysis using generalized linear models", for the sandwich this is the middle of; Kish 1965, "Survey
sampling", for the word). It assumes neither a shape of the correlation along tracks nor a length of them: white noise
comes to 1 for tracks of any length, a random walk to the more the longer they are.
"""

import numpy as np

from filters.kalman import multiview
from filters.kalman.multiview import TrackSightings
from filters.kalman.triangulation import triangulate
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models.gating import chi2_bound
from toolkit.sequence import StereoFrame, StereoRig

# Of three sightings the landmark takes up too much for what is left to say how successive ones are related.
FEWEST_SIGHTINGS = 4
# What chance explains less often, by the stated noise, is an outlier and says nothing of the others.
SOUND = 0.999
# Longer tracks are scored in parts, so that a landmark that is seen for ever is scored, and kept, for some time only.
_MOST_SIGHTINGS = 64
# Fewer tracks say too little of a variance.
_FEWEST_TRACKS = 20
# Poses that fewer tracks at once hold err by more than a track is asked to tell of: on dataset3, with 4, tracks better
# than stated came to a design effect of 30 at the poses of fixed-lag, and to less than 1 at those of batch.
_FEWEST_AT_ONCE = 20


class TrackScores:
    """Measures over a run how many times their stated variance what tracks say of a drift has."""

    def __init__(self, rig: StereoRig) -> None:
        self._rig = rig
        self._information, self._squares, self._tracks = np.zeros((6, 6)), np.zeros((6, 6)), 0
        self._frames, self._seen = 0, 0
        self._ids, self._columns = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        self._uvs_px, self._poses = np.empty((0, 3)), np.empty((0, 4, 4))

    @property
    def design_effect(self) -> float | None:
        """Return it so far; None of too few tracks, or of too few at once."""
        if self._tracks < _FEWEST_TRACKS or self._seen < _FEWEST_AT_ONCE * self._frames:
            return None
        return float(np.trace(np.linalg.solve(self._information, self._squares))) / 6.0

    @property
    def sightings(self) -> int:
        """Return how many sightings wait for their tracks to end."""
        return len(self._ids)

    def add(self, frame: StereoFrame, T_world_imu: Array) -> None:
        """Take in the next frame, with its pose (4, 4) as it will hardly change any more."""
        self._frames, self._seen = self._frames + 1, self._seen + len(frame.track_ids)
        begun, counts = np.unique(self._ids, return_counts=True)
        ended = begun[~np.isin(begun, frame.track_ids) | (counts >= _MOST_SIGHTINGS)]
        self._score(np.isin(self._ids, ended))
        self._columns = np.concatenate([self._columns, np.full(len(frame.track_ids), len(self._poses))])
        self._ids = np.concatenate([self._ids, frame.track_ids])
        self._uvs_px, self._poses = np.vstack([self._uvs_px, frame.uvs_px]), np.vstack([self._poses, T_world_imu[None]])

    def finish(self) -> None:
        """Score the tracks that are still seen."""
        self._score(np.ones(len(self._ids), dtype=bool))

    def _score(self, rows: BoolArray) -> None:
        """Score the tracks of these sightings (N,), all of each, and forget them."""
        self._add_scores(self._window_of(rows))
        self._ids, self._columns, self._uvs_px = self._ids[~rows], self._columns[~rows], self._uvs_px[~rows]
        first = int(self._columns.min(initial=len(self._poses)))
        self._columns, self._poses = self._columns - first, self._poses[first:]

    def _window_of(self, rows: BoolArray) -> TrackSightings:
        """Return the tracks of sightings (N,) that are long enough, one column a pose."""
        track_ids, track = np.unique(self._ids[rows], return_inverse=True)
        shape = (len(track_ids), len(self._poses))
        uvs_px, seen = np.zeros((*shape, 3)), np.zeros(shape, dtype=bool)
        places = track, self._columns[rows]
        uvs_px[places], seen[places] = self._uvs_px[rows], True
        ages: IntArray = np.zeros(shape, dtype=np.int64)
        return _long_enough(TrackSightings(track_ids, uvs_px, seen, ages))

    def _add_scores(self, sightings: TrackSightings) -> None:
        points, reliable = triangulate(sightings.uvs_px, sightings.seen, self._poses, self._rig)
        sightings, points = sightings.select(reliable), points[reliable]
        left = multiview.linearise(sightings, points, self._poses, self._poses, self._rig).residuals
        sound = np.square(left).sum(axis=2) < chi2_bound(3, SOUND)
        sightings = sightings._replace(seen=sightings.seen & sound)
        rows = _is_long_enough(sightings)
        if rows.any():
            information, scores = _scores(sightings.select(rows), points[rows], self._poses, self._rig)
            self._information += information.sum(axis=0)
            self._squares += scores.T @ scores
            self._tracks += len(scores)


def _is_long_enough(sightings: TrackSightings) -> BoolArray:
    return np.asarray(sightings.seen.sum(axis=1) >= FEWEST_SIGHTINGS)


def _long_enough(sightings: TrackSightings) -> TrackSightings:
    return sightings.select(_is_long_enough(sightings))


def _scores(sightings: TrackSightings, points: Array, poses: Array, rig: StereoRig) -> tuple[Array, Array]:
    """Return the information (F, 6, 6) of tracks of points (F, 3) m about a drift, and their scores (F, 6)."""
    here = multiview.linearise(sightings, points, poses, poses, rig)
    count, window = sightings.seen.shape
    frames = np.arange(window)
    middle = (sightings.seen * frames).sum(axis=1) / sightings.seen.sum(axis=1)
    levers = frames - middle[:, None]
    H = (levers[..., None, None] * here.H_pose).reshape(count, 3 * window, 6)
    reached = np.linalg.qr(here.H_point.reshape(count, 3 * window, 3)).Q
    H -= reached @ (np.swapaxes(reached, 1, 2) @ H)
    H_transposed = np.swapaxes(H, 1, 2)
    return H_transposed @ H, (H_transposed @ here.residuals.reshape(count, 3 * window, 1))[..., 0]
