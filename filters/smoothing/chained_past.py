"""The chained sightings of a smoother that keeps every state: linearised where they came in, renewed as they move.

The graph has their linearisations: residuals about estimates, and Jacobians where the tree linearises the variables at
the same time. What neither motion nor vision tells, such as how a tilt and the accelerometer's bias share an error, is
in the null space of both only at one place; with Jacobians at the estimates, less than 0.01 rad away, a tilt was told
to a seventh of the standard deviation it had (:mod:`~filters.smoothing.chained_window` of fixed-lag has the same rule).

Recent states are therefore linearised anew together. A linearisation of a recent frame is replaced once what is new in
its sighting is no longer what it says, once that weighs something else by the loss, and when the tree linearises one of
its variables elsewhere. Those of older frames stay as they are until the end, and their landmarks where they are
linearised. A track that was lost for longer than that starts anew at its age, until the end.
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

# A linearisation is replaced that is off by so much, in sigmas of what is new in the sighting, or whose weight by the
# loss has changed by this share: a hundredth of the variance.
RENEW_BEYOND = 0.1
# Of m and of a rotation's entries: what is not linearised elsewhere stays where it is to the last digits.
ROUNDING = 1e-9

Read = Callable[[list[int]], "Places"]


class Places(NamedTuple):
    """The estimates of variables, and where the tree linearises them."""

    estimates: gtsam.Values
    linearised_at: gtsam.Values


class Renewal(NamedTuple):
    """New factors, and the slots of those they stand for, with the keys of their landmarks."""

    factors: gtsam.NonlinearFactorGraph
    replaced: Mapping[int, int]


class _Between(NamedTuple):
    """Where N sightings have their poses (N, 4, 4), own and that of the one before, and points (N, 3)."""

    own: Array
    before: Array
    points: Array

    @classmethod
    def at(cls, chained: ChainedFactors, values: gtsam.Values) -> "_Between":
        """Return the places of sightings at values."""
        poses, points = chained.sightings.places(values)
        return cls(poses, poses[chained.sightings.chain.before], points)

    def differ_from(self, other: "_Between") -> BoolArray:
        """Say which (N,) differ by more than rounding."""
        pairs = ((ours - theirs).reshape(len(self.own), -1) for ours, theirs in zip(self, other, strict=True))
        return np.asarray(np.abs(np.hstack(list(pairs))).max(axis=1) > ROUNDING)


@dataclass(frozen=True, eq=False)
class _Linearised:
    """N sightings, linear about estimates with the Jacobians of other places, and their weights (N,)."""

    about: _Between
    jacobians_at: _Between
    weight: Array
    linear: LinearInnovations

    @classmethod
    def none(cls) -> "_Linearised":
        """Return no rows."""
        poses, blocks = np.empty((0, 4, 4)), np.empty((0, 3, 6))
        nowhere = _Between(poses, poses, np.empty((0, 3)))
        linear = LinearInnovations(np.empty((0, 3)), blocks, blocks, np.empty((0, 3, 3)))
        return cls(nowhere, nowhere, np.empty(0), linear)

    @classmethod
    def at(cls, chained: ChainedFactors, places: Places) -> "_Linearised":
        """Linearise sightings."""
        linear = chained.linear(*places)
        about, jacobians_at = (_Between.at(chained, values) for values in places)
        return cls(about, jacobians_at, chained.weights(linear.innovation), linear)

    def differs_from(self, old: "_Linearised") -> BoolArray:
        """Say where (N,) old linearisations are off by now, weigh something else, or have Jacobians of elsewhere."""
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
        """Return the rows with those of new sightings behind them."""
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
        return _Linearised(_Between(*rows[:3]), _Between(*rows[3:6]), rows[6], LinearInnovations(*rows[7:]))


def _step(start: Array, end: Array) -> Array:
    return se3_log(se3_inverse(start) @ end)


class ChainedPast:
    """The sightings of all frames, those of the latest with their linearisations, and the slots of their factors."""

    def __init__(self, rig: StereoRig, huber: float | None, recent_frames: int) -> None:
        self._rig, self._huber, self._recent_frames = rig, huber, recent_frames
        self._rows, self._linearised = SightingRows.none(), _Linearised.none()
        # Where the factor of each of these sightings is, -1 for nowhere.
        self._slot = np.empty(0, dtype=np.int64)
        self._older: list[tuple[SightingRows, IntArray]] = []
        self._settled = set[int]()

    def add(self, frame: StereoFrame, k: int) -> None:
        """Take in what frame k sees; what is no longer recent stays linearised as it is."""
        stay = self._rows.pose > k - self._recent_frames
        self._older.append((self._rows.select(~stay), self._slot[~stay]))
        self._settled.update(map(L, self._rows.track_id[~stay].tolist()))
        self._rows, self._linearised = self._rows.select(stay).followed_by(frame, k), self._linearised.select(stay)
        self._slot = np.concatenate([self._slot[stay], np.full(frame.track_ids.size, -1)])

    @property
    def settled(self) -> set[int]:
        """Return the keys of landmarks that older sightings are linear in, where they are linearised."""
        return self._settled

    def renewal(self, read: Read, first_slot: int) -> Renewal:
        """Return the factors of what is new and of what has moved, which get the slots from one on.

        ``read`` returns where the variables of keys are, and where they are linearised with these factors.
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
        """Let the sightings of some landmarks go."""
        ids = list(track_ids)
        self._settled.difference_update(map(L, ids))
        kept = ~np.isin(self._rows.track_id, ids)
        self._rows, self._linearised = self._rows.select(kept), self._linearised.select(kept)
        self._slot = self._slot[kept]
        older = ((rows, slots, ~np.isin(rows.track_id, ids)) for rows, slots in self._older)
        self._older = [(rows.select(kept), slots[kept]) for rows, slots, kept in older]

    def move(self, slot_of: Mapping[int, int]) -> None:
        """Take down that the factors have other slots."""

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
