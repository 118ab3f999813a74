"""The chained sightings of a smoother that keeps every state: linearised as they arrive, relinearised as they move.

The graph holds their linearisations: residuals about the estimates, and Jacobians at the tree's own linearisation
points of the variables. The reason for the latter: a direction that neither motion nor vision observes, such as an
exchange of tilt and accelerometer bias, is in the null space of both only if both are linearised at the same point.
With Jacobians at the estimates, less than 0.01 rad away, the standard deviation of a tilt came out as a seventh of the
right one (:mod:`~filters.smoothing.chained_window` of fixed-lag follows the same rule).

Recent states are therefore relinearised together. The linearisation of a sighting in a recent frame is replaced when
its innovation has changed, when the loss gives it another weight, or when the tree relinearises one of its variables.
Linearisations of older frames, and the linearisation points of their landmarks, stay fixed until the final solve. Until
then a track that was lost for longer than that starts again at its age.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np

from filters.smoothing.track_chain import ChainedFactors, LinearInnovations, SightingRows
from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse, se3_log
from toolkit.models.factors import L
from toolkit.sequence import StereoFrame, StereoRig

# A linearisation is replaced when its innovation is off by this many sigmas, which is a hundredth of the variance, or
# when its weight has changed by this share.
RENEW_BEYOND = 0.1
# In m, and in entries of a rotation matrix: linearisation points closer than this are the same.
ROUNDING = 1e-9

Read = Callable[[list[int]], "Places"]


class Places(NamedTuple):
    """The estimates of variables, and the tree's linearisation points of them."""

    estimates: gtsam.Values
    linearised_at: gtsam.Values


class Renewal(NamedTuple):
    """New factors, and the slots of the factors that they replace, with the keys of their landmarks."""

    factors: gtsam.NonlinearFactorGraph
    replaced: Mapping[int, int]


class _LinearisationPoints(NamedTuple):
    """Poses (N, 4, 4) of N sightings and of the sightings before them, and points (N, 3) m."""

    own: Array
    before: Array
    points: Array

    @classmethod
    def at(cls, chained: ChainedFactors, values: gtsam.Values) -> "_LinearisationPoints":
        """Return poses and points of sightings at values."""
        poses, points = chained.sightings.places(values)
        return cls(poses, poses[chained.sightings.chain.before], points)

    def differ_from(self, other: "_LinearisationPoints") -> BoolArray:
        """Say which rows (N,) differ by more than rounding."""
        pairs = ((ours - theirs).reshape(len(self.own), -1) for ours, theirs in zip(self, other, strict=True))
        return np.asarray(np.abs(np.hstack(list(pairs))).max(axis=1) > ROUNDING)


@dataclass(frozen=True, eq=False)
class _Linearised:
    """N sightings linearised about the estimates, with Jacobians at other points, and their weights (N,)."""

    about: _LinearisationPoints
    jacobians_at: _LinearisationPoints
    weight: Array
    linear: LinearInnovations

    @classmethod
    def none(cls) -> "_Linearised":
        """Return no rows."""
        poses, blocks = np.empty((0, 4, 4)), np.empty((0, 3, 6))
        nowhere = _LinearisationPoints(poses, poses, np.empty((0, 3)))
        linear = LinearInnovations(np.empty((0, 3)), blocks, blocks, np.empty((0, 3, 3)))
        return cls(nowhere, nowhere, np.empty(0), linear)

    @classmethod
    def at(cls, chained: ChainedFactors, places: Places) -> "_Linearised":
        """Linearise sightings."""
        linear = chained.linear(*places)
        about, jacobians_at = (_LinearisationPoints.at(chained, values) for values in places)
        return cls(about, jacobians_at, chained.weights(linear.innovation), linear)

    def differs_from(self, old: "_Linearised") -> BoolArray:
        """Say where (N,) an old linearisation is off, has another weight, or has Jacobians at other points."""
        now, then = self.about, old.about
        steps = _step(then.own, now.own), _step(then.before, now.before), now.points - then.points
        predicted = sum((by @ step[..., None])[..., 0] for by, step in zip(old.linear[1:], steps, strict=True))
        off = np.linalg.norm(old.linear.innovation - predicted - self.linear.innovation, axis=1)
        off_or_heavier = (off > RENEW_BEYOND) | (np.abs(self.weight / old.weight - 1.0) > RENEW_BEYOND)
        return np.asarray(off_or_heavier | self.jacobians_at.differ_from(old.jacobians_at))

    def select(self, rows: BoolArray) -> "_Linearised":
        """Return the rows of a mask (N,)."""
        return self._of(column[rows] for column in self._columns())

    def last(self, count: int) -> "_Linearised":
        """Return the last rows."""
        return self._of(column[len(column) - count :] for column in self._columns())

    def followed_by(self, new: "_Linearised") -> "_Linearised":
        """Return the rows with those of new sightings appended."""
        return self._of(np.concatenate(pair) for pair in zip(self._columns(), new._columns(), strict=True))

    def with_rows(self, rows: BoolArray, new: "_Linearised") -> "_Linearised":
        """Return the rows, those of a mask (N,) replaced."""
        pairs = zip(self._columns(), new._columns(), strict=True)
        return self._of(np.where(rows.reshape(-1, *(1,) * (old.ndim - 1)), other, old) for old, other in pairs)

    def _columns(self) -> list[Array]:
        return [*self.about, *self.jacobians_at, self.weight, *self.linear]

    @staticmethod
    def _of(columns: Iterable[Array]) -> "_Linearised":
        rows = list(columns)
        return _Linearised(
            _LinearisationPoints(*rows[:3]), _LinearisationPoints(*rows[3:6]), rows[6], LinearInnovations(*rows[7:])
        )


def _step(start: Array, end: Array) -> Array:
    return se3_log(se3_inverse(start) @ end)


class ChainedPast:
    """The sightings of all frames, the linearisations of recent ones, and the slots of their factors."""

    def __init__(self, rig: StereoRig, huber: float | None, recent_frames: int) -> None:
        self._rig, self._huber, self._recent_frames = rig, huber, recent_frames
        self._rows, self._linearised = SightingRows.none(), _Linearised.none()
        # The slot of each sighting's factor, -1 if it has none.
        self._slot = np.empty(0, dtype=np.int64)
        self._older: list[tuple[SightingRows, IntArray]] = []
        self._settled = set[int]()

    def add(self, frame: StereoFrame, k: int) -> None:
        """Add the sightings of frame k; the linearisations of frames that are no longer recent stay."""
        stay = self._rows.pose > k - self._recent_frames
        self._older.append((self._rows.select(~stay), self._slot[~stay]))
        self._settled.update(map(L, self._rows.track_id[~stay].tolist()))
        self._rows, self._linearised = self._rows.select(stay).followed_by(frame, k), self._linearised.select(stay)
        self._slot = np.concatenate([self._slot[stay], np.full(frame.track_ids.size, -1)])

    @property
    def settled(self) -> set[int]:
        """Return the keys of landmarks with sightings whose linearisation is fixed."""
        return self._settled

    def renewal(self, read: Read, first_slot: int) -> Renewal:
        """Return the factors of new and relinearised sightings; their slots start at ``first_slot``.

        ``read`` returns the estimates of the variables of keys, and their linearisation points with these factors.
        """
        if not self._rows.pose.size:
            return Renewal(gtsam.NonlinearFactorGraph(), {})
        places = read(self._rows.keys())
        chained = ChainedFactors.of(self._rows, self._rig, self._huber).in_front(places.estimates)
        now = _Linearised.at(chained, places)
        known = self._linearised.followed_by(now.last(len(now.weight) - len(self._linearised.weight)))
        stale = chained.sightings.counted & ((self._slot < 0) | now.differs_from(known))
        landmarks = map(L, self._rows.track_id[stale].tolist())
        replaced = {slot: key for slot, key in zip(self._slot[stale].tolist(), landmarks, strict=True) if slot >= 0}
        self._linearised = known.with_rows(stale, now)
        self._slot[stale] = first_slot + np.arange(stale.sum())
        return Renewal(chained.factors(now.linear, places.estimates, stale), replaced)

    def drop(self, track_ids: Iterable[int]) -> None:
        """Drop the sightings of some landmarks."""
        ids = list(track_ids)
        self._settled.difference_update(map(L, ids))
        kept = ~np.isin(self._rows.track_id, ids)
        self._rows, self._linearised = self._rows.select(kept), self._linearised.select(kept)
        self._slot = self._slot[kept]
        older = ((rows, slots, ~np.isin(rows.track_id, ids)) for rows, slots in self._older)
        self._older = [(rows.select(kept), slots[kept]) for rows, slots, kept in older]

    def move(self, slot_of: Mapping[int, int]) -> None:
        """Record that the factors have moved to other slots."""

        def moved(slots: IntArray) -> IntArray:
            return np.array([slot_of.get(slot, -1) for slot in slots.tolist()], dtype=np.int64)

        self._slot, self._older = moved(self._slot), [(rows, moved(slots)) for rows, slots in self._older]

    def slots(self) -> list[int]:
        """Return the slots of all factors."""
        slots = np.concatenate([*(slots for _, slots in self._older), self._slot])
        return [slot for slot in slots.tolist() if slot >= 0]

    def whole(self) -> ChainedFactors:
        """Return all sightings, to be linearised together."""
        rows = SightingRows.joined([*(rows for rows, _ in self._older), self._rows])
        return ChainedFactors.of(rows, self._rig, self._huber)
