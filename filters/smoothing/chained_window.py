"""The chained sightings of an incremental smoother: frames come, states and landmarks leave, and factors are renewed.

The graph has their linearisations, in every frame new ones about the latest estimates: the residuals are then exact,
and the weights of the loss are those of the residuals. A variable that a marginal holds where it was linearised has its
Jacobians from there, as GTSAM's own factors do: what no sighting can tell, neither sightings nor marginal then claim.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from filters.smoothing.robust_loss import Huber, Loss, Squares
from filters.smoothing.track_chain import ChainedFactors, ChainedSightings
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models.correlated_noise import Chain
from toolkit.models.factors import L, X
from toolkit.sequence import StereoFrame, StereoRig


@dataclass(frozen=True, eq=False)
class SightingRows:
    """N sightings in the order of time: frame (N,) by number, its stamp, track id, (uL, uR, v) (N, 3) px, age.

    ``begins`` (N,) says which were the first of a landmark in the graph.
    """

    pose: IntArray
    t_ns: IntArray
    track_id: IntArray
    uv_px: Array
    age: IntArray
    begins: BoolArray

    @classmethod
    def none(cls) -> "SightingRows":
        """Return no rows."""
        empty = np.empty(0, dtype=np.int64)
        return cls(empty, empty, empty, np.empty((0, 3)), empty, np.empty(0, dtype=bool))

    def followed_by(self, frame: StereoFrame, k: int) -> "SightingRows":
        """Return the rows with those of frame k behind them."""
        count = frame.track_ids.size
        return SightingRows(
            np.concatenate([self.pose, np.full(count, k)]),
            np.concatenate([self.t_ns, np.full(count, frame.t_ns)]),
            np.concatenate([self.track_id, frame.track_ids]),
            np.concatenate([self.uv_px, frame.uvs_px]),
            np.concatenate([self.age, frame.ages]),
            np.concatenate([self.begins, ~np.isin(frame.track_ids, self.track_id)]),
        )

    def select(self, rows: BoolArray) -> "SightingRows":
        """Return the rows of a mask (N,)."""
        return SightingRows(*(column[rows] for column in vars(self).values()))


class ChainedWindow:
    """The sightings of the frames in a window, and the slots of their factors in the graph that has them."""

    def __init__(self, rig: StereoRig, huber: float | None) -> None:
        self._rig = rig
        self._loss: Loss = Squares() if huber is None else Huber(huber)
        self._rows = SightingRows.none()
        self._since_ns: list[int] = []
        self._slots: list[int] = []

    @property
    def slots(self) -> list[int]:
        """Return where in the graph the factors are."""
        return self._slots

    def add(self, frame: StereoFrame, k: int) -> None:
        """Take in what frame k sees of landmarks."""
        self._rows = self._rows.followed_by(frame, k)

    def drop(self, track_ids: Iterable[int]) -> None:
        """Let the sightings of some landmarks go."""
        self._rows = self._rows.select(~np.isin(self._rows.track_id, list(track_ids)))

    def placed(self, slots: Iterable[int]) -> None:
        """Take down where the factors that were returned last have their places."""
        self._slots = list(slots)

    def forget(self, oldest_ns: int) -> None:
        """Let older frames go, with the factors on them, which a marginal has taken up.

        Such are the innovations of the next sightings, too. Those that follow go on from the sightings that stay.
        """
        self._rows = self._rows.select(self._rows.t_ns >= oldest_ns)
        kept = [since_ns >= oldest_ns for since_ns in self._since_ns]
        self._slots = [slot for slot, stays in zip(self._slots, kept, strict=True) if stays]
        self._since_ns = [since_ns for since_ns in self._since_ns if since_ns >= oldest_ns]

    def keys(self) -> list[int]:
        """Return the keys of the poses and landmarks of all sightings."""
        poses, tracks = np.unique(self._rows.pose).tolist(), np.unique(self._rows.track_id).tolist()
        return [*map(X, poses), *map(L, tracks)]

    def factors(self, values: gtsam.Values, jacobians_at: gtsam.Values) -> gtsam.NonlinearFactorGraph:
        """Return what is new in each sighting, linear about the values; their slots are to be told."""
        if not self._rows.pose.size:
            self._since_ns = []
            return gtsam.NonlinearFactorGraph()
        sightings = self._sightings()
        before = np.where(sightings.chain.before >= 0, sightings.chain.before, np.arange(sightings.pose.size))
        chained = ChainedFactors(sightings, self._rig, self._loss)
        in_front = chained.predicted(values).depth_m > 0.0
        counted = sightings.counted & in_front & in_front[before]
        self._since_ns = self._rows.t_ns[before[counted]].tolist()
        return replace(chained, sightings=replace(sightings, counted=counted)).linearised(values, jacobians_at)

    def _sightings(self) -> ChainedSightings:
        """Return all sightings; what was new in those whose predecessor has left, a marginal counts."""
        rows, noise = self._rows, self._rig.track_noise
        assert noise is not None
        ids, point = np.unique(rows.track_id, return_inverse=True)
        chain = Chain.of(noise, point.astype(np.int64), rows.age)
        counted = rows.begins | (chain.before >= 0)
        return ChainedSightings(rows.pose, point.astype(np.int64), rows.uv_px, chain, counted, ids)
