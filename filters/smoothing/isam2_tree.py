"""iSAM2 that recovers where GTSAM's raises: it drops the landmark, or solves by QR, and returns what it did.

Kaess et al. 2012, "iSAM2: Incremental smoothing and mapping using the Bayes tree", in GTSAM's implementation. Landmarks
are eliminated first and states in the order of time, the newest last: new sightings then change few cliques, and the
marginal of the newest state stands in the root. But a landmark eliminated first depends on the first state that saw it,
and each new sighting re-eliminates all states since then. A landmark that has long been in view is therefore eliminated
last, beside the newest state, where a sighting of it changes the root alone. A dummy variable follows the newest state,
for the condition number of the cliques (``indeterminate``).

GTSAM's Python binding passes a CustomFactor a copy of *all* values at each call, which grows with the graph until it
takes most of the time. Such a factor is therefore linearised at the values of its own keys, and the tree holds that
linearisation, which follows its states to first order (LinearContainerFactor). When one of its states is relinearised,
so is the factor, as iSAM2 does with every other factor (algorithm 5), with the same residual and the same noise.

iSAM2 traverses its whole tree once a frame, whatever the frame changes. Variables on which no recent frame has factors,
frozen ones, are therefore marginalised for speed, and kept for the final solve. The marginal of a variable that leaves
has the same information on the others as its factors, up to rounding (section 3.3: it is the cached factor on a
subtree's separator); GTSAM fixes the linearisation points of those others too.

States are relinearised by thresholds, landmarks by their image. The effect of a metre on an image falls with the square
of the depth: a threshold in metres that is small enough for near landmarks would relinearise far ones in every frame.
"""

from collections import deque
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from filters.smoothing.indeterminate import (
    LAST,
    Recovery,
    undetermined,
    variable_named,
    weak_prior,
    with_the_last_tied,
    without_gaps,
)
from toolkit.errors import EstimatorError
from toolkit.geometry import Array, BoolArray, se3_inverse, transform
from toolkit.measurements import StereoRig
from toolkit.models import stereo
from toolkit.models.factors import key_list, kind_of, python_factors
from toolkit.models.graph_state import MotionModel

# The states of this many frames are eliminated last, in the order of time, and after them landmarks with more sightings
# than this: a state costs as much as two landmarks, so a longer track is cheaper in the root than the states it spans.
RECENT_FRAMES, LONG_LIVED_SIGHTINGS = 100, 10
# A variable on which no frame has had factors for this many frames keeps its linearisation point, as do Python factors
# on it: a small change of heading moves the whole past, and a frame would cost as much as the run is long.
FROZEN_AFTER_FRAMES = 30
# A variable on which no frame has had factors for this many frames leaves the tree; this is done at this interval,
# because each time traverses the whole tree. Variables with a marginal of it keep their linearisation points too.
RETIRED_AFTER_FRAMES, RETIRING_EVERY_FRAMES = 60, 30
# After rounding has made Cholesky factorisation fail, it is tried again this many frames with vision later.
QR_FRAMES = 20
MOST_RECOVERIES = 20
# How far states may move from their linearisation points: rad; m/s, or the unit of a rate; m/s^2 and rad/s for a bias;
# and multiples of the baseline, which is the length scale of stereo: the image of a point 20 baselines away is then
# off by a tenth of a pixel. A change of velocity or accelerometer bias common to all states affects residuals only by
# the rotation between two frames. Coarser thresholds mix linearisation points: five times 0.01 rad, 0.1 baselines and
# 0.01 for the rest made a flight of two minutes five times less accurate.
ROTATION_THRESHOLD_RAD, VELOCITY_THRESHOLD, BIAS_THRESHOLD = 0.01, 0.1, (0.1, 0.01)
POSITION_THRESHOLD_BASELINES = 0.3
# In sigmas of a sighting.
LANDMARK_BEYOND_SIGMA = 0.1


@dataclass(frozen=True, eq=False)
class CachedLinearisation:
    """A Python factor and the values (of its keys) at which it was last linearised."""

    factor: gtsam.CustomFactor
    linearised_at: gtsam.Values

    @cached_property
    def keys(self) -> tuple[int, ...]:
        """Return the keys of the factor; GTSAM builds a new list at each call."""
        return tuple(self.factor.keys())

    def container(self) -> gtsam.LinearContainerFactor:
        return gtsam.LinearContainerFactor(self.factor.linearize(self.linearised_at), self.linearised_at)


class FrozenVariables:
    """Tracks which variables no recent frame has factors on; their linearisation points stay fixed.

    A variable that is seen again later stays frozen: its new factors are linearised at its fixed point.
    """

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._recent: deque[set[int]] = deque()
        self._last_frame: dict[int, int] = {}
        self._last_view: dict[int, int] = {}
        self.count = 0
        self._frozen: set[int] = set()
        # Those that recent frames have factors on, except those frozen before.
        self.others: set[int] = set()
        self.keys = gtsam.KeyList()

    def unused_for(self, frames: int) -> list[int]:
        """Return the listed keys that the last ``frames`` frames neither had in view nor have factors on."""
        oldest = self.count - frames
        return [key for key in self.keys if max(self._last_frame[key], self._last_view.get(key, 0)) < oldest]

    def see(self, landmarks: Iterable[int]) -> None:
        """Note the landmarks in view of the next frame, whether or not it has factors on them."""
        self._last_view |= dict.fromkeys(landmarks, self.count)

    def leave(self, keys: Collection[int]) -> None:
        """Remove keys from the list; they stay frozen."""
        self.keys = key_list(key for key in self.keys if key not in keys)

    def come_back(self, keys: Collection[int]) -> None:
        self.keys = key_list([*self.keys, *keys])

    def add_frame(self, keys: Iterable[int]) -> None:
        """Count a frame with factors on some variables; freeze the variables that no recent frame has factors on."""
        frame = set(keys)
        self._recent.append(frame)
        self._last_frame |= dict.fromkeys(frame, self.count)
        self.others |= frame - self._frozen
        if len(self._recent) > self._frames:
            oldest = self.count - self._frames
            for key in sorted(self._recent.popleft()):
                if self._last_frame[key] == oldest and key not in self._frozen:
                    self.keys.push_back(key)
                    self._frozen.add(key)
                    self.others.remove(key)
        self.count += 1


class RetiredVariables:
    """The variables that left a tree with their values and factors, and the slots of these and of the marginals."""

    def __init__(self) -> None:
        self.keys: set[int] = set()
        self.slots: set[int] = set()
        self._factors: dict[int, gtsam.NonlinearFactor] = {}
        self._marginals: set[int] = set()
        self.latest, self.linearised_at = gtsam.Values(), gtsam.Values()

    def take(self, tree: gtsam.ISAM2, leaving: list[int]) -> None:
        """Marginalise variables that are leaves of the tree; keep them and their factors."""
        before = gtsam.NonlinearFactorGraph(tree.getFactorsUnsafe())
        self.latest.insert(tree.calculateEstimate().extract(leaving))
        self.linearised_at.insert(tree.getLinearizationPoint().extract(leaving))
        marginals, removed = tree.marginalizeLeavesWithIndices(key_list(leaving))
        self._factors |= {slot: before.at(slot) for slot in removed if slot not in self._marginals}
        self._marginals = (self._marginals - set(removed)) | set(marginals)
        self.keys.update(leaving)
        self.slots = set(self._factors)

    def with_factors_of(self, tree: gtsam.ISAM2) -> gtsam.NonlinearFactorGraph:
        """Return the factors of a tree and of the variables that left it, each in its slot, and no marginals."""
        factors = gtsam.NonlinearFactorGraph(tree.getFactorsUnsafe())
        for slot in self._marginals:
            factors.remove(slot)
        for slot, factor in self._factors.items():
            factors.replace(slot, factor)
        return factors


def _joined(first: gtsam.Values, second: gtsam.Values) -> gtsam.Values:
    joined = gtsam.Values(first)
    joined.insert(second)
    return joined


class Isam2Tree:
    """A Bayes tree that adds frames, reads single variables and recovers from an indeterminate system."""

    def __init__(self, motion: MotionModel, baseline_m: float) -> None:
        self._motion = motion
        self._at_most = state_thresholds(motion, baseline_m)
        self._factorization, self._frames_by_qr = "CHOLESKY", 0
        self.isam = self._empty_tree()
        self._recent: deque[list[int]] = deque(maxlen=RECENT_FRAMES)
        self._frozen = FrozenVariables(FROZEN_AFTER_FRAMES)
        self._slot_count = 0
        self._cached: dict[int, CachedLinearisation] = {}
        self._sightings: dict[int, list[int]] = {}
        # The slots of the factors that tie the dummy variable to the newest state.
        self._tie_slots: list[int] = []
        # Whether variables may leave, and whether those that had left were taken back and leave with the next frame.
        self._retired, self._retires, self._taken_back = RetiredVariables(), True, False
        # The landmarks in the tree, and the variables to relinearise next.
        self._landmarks, self._to_relinearise = set[int](), set[int]()

    def add(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, state_keys: list[int]) -> Recovery:
        """Add a frame with the keys of its new state; return the recoveries, or raise EstimatorError if none helps."""
        has_landmarks = any(kind_of(key) == "l" for key in list(values.keys()))
        self._recent.append(state_keys)
        self._frozen.add_frame(factors.keyVector())
        self._to_relinearise = self._moved()
        cached, moved = self._linearisations(factors, values)
        factors = gtsam.NonlinearFactorGraph(factors)
        for place, linearisation in cached.items():
            factors.replace(place, linearisation.container())
        newest = {key: self._motion.variable_sizes[kind_of(key)] for key in state_keys}
        first_tie, old_ties = self._slot_count + factors.size(), self._tie_slots
        factors, values = with_the_last_tied(self.isam, factors, values, newest)
        self._tie_slots = list(range(first_tie, first_tie + len(newest)))
        added = self._update(factors, values, cached, moved, old_ties)
        # Only after the update: a landmark dropped by the return to Cholesky may be one of the frame's.
        back = self._back_to_cholesky(has_landmarks)
        return Recovery(added.log + back.log, added.dropped | back.dropped)

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Return all factors; Python factors themselves, not their linearisations."""
        factors = self._retired.with_factors_of(self.isam)
        for slot, cached in self._cached.items():
            factors.replace(slot, cached.factor)
        for slot in self._tie_slots:
            factors.remove(slot)
        return without_gaps(factors)

    def values(self) -> gtsam.Values:
        values = _joined(self.isam.calculateBestEstimate(), self._retired.latest)
        values.erase(LAST)
        return values

    def see(self, landmarks: list[int]) -> Recovery:
        """Keep landmarks that the next frame has in view; if any of them had left the tree, take all variables back.

        From then on none leaves: other tracks will return too, and rebuilding the tree for each would cost more than is
        saved.
        """
        self._frozen.see(landmarks)
        if self._retired.keys.isdisjoint(landmarks):
            return Recovery([], set())
        self._retires = False
        return self._restored()

    def _restored(self) -> Recovery:
        """Rebuild the tree with all variables that had left it; return the recoveries."""
        points = _joined(self.isam.getLinearizationPoint(), self._retired.linearised_at)
        try:
            self._rebuild(self._retired.with_factors_of(self.isam), points)
        except RuntimeError as refusal:
            return self._recovered(refusal)
        return Recovery([], set())

    def drop(self, landmarks: Iterable[int]) -> Recovery:
        """Remove landmarks with all their sightings; return the recoveries.

        If some sightings of a landmark had left the tree, a marginal contains their information, and the tree is
        rebuilt.
        """
        landmarks = list(landmarks)
        if any(not self._retired.slots.isdisjoint(self._sightings[key]) for key in landmarks):
            recovery = self._restored()
            kept = [key for key in landmarks if self.has(key)]
            again = self.drop(kept) if kept else Recovery([], set())
            return Recovery(recovery.log + again.log, recovery.dropped | again.dropped)
        self._landmarks.difference_update(landmarks)
        slots = [slot for key in landmarks for slot in self._sightings.pop(key)]
        return self._update(gtsam.NonlinearFactorGraph(), gtsam.Values(), {}, {}, slots)

    def has(self, key: int) -> bool:
        return bool(self.isam.valueExists(key))

    def landmarks(self) -> list[int]:
        return list(self._sightings)

    def read(self, keys: list[int]) -> gtsam.Values:
        """Return the latest values of states by their keys, without copying the other values."""
        of_vector, of_bias = self.isam.calculateEstimateVector, self.isam.calculateEstimateConstantBias
        bias = of_vector if self._motion.layout.accel_bias is None else of_bias
        readers, values = {"x": self.isam.calculateEstimatePose3, "v": of_vector, "b": bias}, gtsam.Values()
        for key in keys:
            values.insert(key, readers[kind_of(key)](key))
        return values

    def points(self, landmarks: Iterable[int]) -> Array:
        """Return the latest points (N, 3) m of landmarks in the world."""
        return np.array([self.isam.calculateEstimatePoint3(key) for key in landmarks]).reshape(-1, 3)

    def linearised_at(self, ascending: list[int]) -> Array:
        """Return the linearisation points (N, 3) m in the world of landmarks, by ascending key."""
        return gtsam.utilities.extractPoint3(self.isam.getLinearizationPoint().extract(ascending))

    def relinearise(self, landmarks: Iterable[int]) -> None:
        """Mark landmarks for relinearisation with the next frame, except frozen ones; others keep their points."""
        self._to_relinearise = set(landmarks)

    def _first_values(self, keys: list[int], new: gtsam.Values) -> gtsam.Values:
        """Return values of states and landmarks: initial values of new ones, the latest values of those in the tree."""
        known = [key for key in keys if not new.exists(key)]
        values = self.read([key for key in known if kind_of(key) != "l"])
        for key in known:
            if kind_of(key) == "l":
                values.insert(key, self.isam.calculateEstimatePoint3(key))
        values.insert(new.extract([key for key in keys if new.exists(key)]))
        return values

    def _moved(self) -> set[int]:
        """Return the variables to relinearise in this frame; of recent states all or none, so that they agree."""
        may_move = self._frozen.others - set(self.isam.getFixedVariables())
        landmarks = {key for key in self._to_relinearise & may_move if self.has(key)}
        states = [key for key in may_move - self._landmarks if kind_of(key) != "l" and self.has(key)]
        return landmarks.union(states if any_moved_beyond(self._at_most, self.isam.getDelta(), states) else ())

    def _linearisations(
        self, factors: gtsam.NonlinearFactorGraph, new: gtsam.Values
    ) -> tuple[dict[int, CachedLinearisation], dict[int, CachedLinearisation]]:
        """Return linearisations of Python factors: of new ones by index, of relinearised old ones by slot."""
        added = python_factors(factors)
        states = self._to_relinearise - self._landmarks
        stale = {slot: old for slot, old in self._cached.items() if not states.isdisjoint(old.keys)} if states else {}
        of_factors = [*(factor.keys() for factor in added.values()), *(old.keys for old in stale.values())]
        at = self._linearisation_points(list(set().union(*of_factors)), new) if of_factors else new
        return (
            {place: CachedLinearisation(factor, at.extract(factor.keys())) for place, factor in added.items()},
            {slot: CachedLinearisation(old.factor, at.extract(old.keys)) for slot, old in stale.items()},
        )

    def _linearisation_points(self, keys: list[int], new: gtsam.Values) -> gtsam.Values:
        """Return the tree's linearisation points of states and landmarks from this frame on."""
        stay = [key for key in keys if not new.exists(key) and key not in self._to_relinearise]
        estimates, at = self._first_values(keys, new), self.isam.getLinearizationPoint().extract(stay)
        at.insert(estimates.extract([key for key in keys if not at.exists(key)]))
        return at

    def _not_relinearised(self) -> gtsam.KeyList:
        """Return the keys that GTSAM must not relinearise: all except those marked for it."""
        fixed = gtsam.KeyList(self._frozen.keys)
        for key in (*(self._frozen.others - self._to_relinearise), LAST):
            fixed.push_back(key)
        return fixed

    def _update(
        self,
        factors: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        cached: dict[int, CachedLinearisation],
        moved: dict[int, CachedLinearisation],
        dropped_slots: Iterable[int] = (),
    ) -> Recovery:
        """Add factors (``cached`` linearises some, by index), replace those of ``moved``, by slot, and remove others.

        The slots of new factors always follow those of the old ones, so that they are known after a refusal as well.
        """
        for slot, renewal in moved.items():
            del self._cached[slot]
            cached[factors.size()] = renewal
            factors.add(renewal.container())
        self._cached |= {self._slot_count + place: factor for place, factor in cached.items()}
        for place in range(factors.size()):
            keys: list[int] = factors.at(place).keys()
            for key in keys:
                if kind_of(key) == "l":
                    self._sightings.setdefault(key, []).append(self._slot_count + place)
                    self._landmarks.add(key)
        self._slot_count += factors.size()
        new = list(factors.keys())
        leaving, fixed = self._leaving(), self._not_relinearised()
        order, anew = (self._order(new, new), None) if not leaving else self._order_before_retiring(values, leaving)
        try:
            self.isam.update(factors, values, [*moved, *dropped_slots], order, fixed, anew)
            self._solve_back()
        except RuntimeError as refusal:
            return self._recovered(refusal)
        if leaving:
            self._retire(leaving)
        return Recovery([], set())

    def _leaving(self) -> list[int]:
        """Return the variables to retire now: none in most frames, and none while solving by QR."""
        is_time = self._taken_back or self._frozen.count % RETIRING_EVERY_FRAMES == 0
        if not self._retires or self._factorization == "QR" or not is_time:
            return []
        unused = self._frozen.unused_for(RETIRED_AFTER_FRAMES)
        # Tracks use poses for longer than biases. A bias leaving alone would take its pose's factors along.
        stay = {key for keys in self._recent if not set(keys).issubset(unused) for key in keys}
        return [key for key in unused if key not in stay and self.has(key)]

    def _retire(self, leaving: list[int]) -> None:
        still_there = [key for key in leaving if self.has(key)]
        self._retired.take(self.isam, still_there)
        self._taken_back = False
        self._slot_count = self.isam.getFactorsUnsafe().size()
        self._frozen.leave(self._retired.keys)
        self._landmarks -= self._retired.keys
        while self._recent[0][0] in self._retired.keys:
            self._recent.popleft()

    def _order_before_retiring(self, new: gtsam.Values, leaving: list[int]) -> tuple[gtsam.KeyGroupMap, gtsam.KeyList]:
        """Return the elimination indices of all variables, leaving ones first, and the list of all, to re-eliminate."""
        gone = self._retired.keys.union(leaving)
        landmarks = [key for key in self._landmarks.difference(leaving) if self.has(key) or new.exists(key)]
        states = [keys for keys in self._recent if keys[0] not in gone]
        groups = gtsam.KeyGroupMap()
        for place, keys in enumerate([landmarks, *states, [LAST]], start=1):
            for key in keys:
                groups.insert2(key, place)
        everything = [*leaving, *landmarks, *(key for keys in states for key in keys), LAST]
        return groups, key_list(key for key in everything if not new.exists(key))

    def _solve_back(self) -> None:
        """Read a variable, for which GTSAM solves for all: only here does QR raise for a singular system."""
        self.read(self._recent[-1][:1])

    def _order(self, new: list[int], in_view: Iterable[int]) -> gtsam.KeyGroupMap:
        """Return the elimination index of each recent state, and of each long-lived landmark in view.

        All other variables come first: eliminated after its states, the long-lived landmarks of a whole run would leave
        a dense system. ``new`` are the keys of the factors that an update adds. CCOLAMD accepts no index beyond the
        number of variables it orders, which are at least these; an update that only removes factors orders at least
        two, one of them the dummy.
        """
        groups, states = gtsam.KeyGroupMap(), list(self._recent)
        long_lived = [key for key in in_view if len(self._sightings.get(key, ())) > LONG_LIVED_SIGHTINGS]
        last = [*states[:-1], long_lived, *states[-1:], [LAST]]
        for place, keys in enumerate(last[-max(len(new) - 1, 1) :], start=1):
            for key in keys:
                groups.insert2(key, place)
        return groups

    def _recovered(self, refusal: RuntimeError) -> Recovery:
        """Rebuild the tree without undetermined landmarks, or the one named, or with a weak prior on a state named."""
        log, dropped = [], set()
        for _ in range(MOST_RECOVERIES):
            key = variable_named(refusal)
            factors = self._retired.with_factors_of(self.isam)
            values = _joined(self.isam.getLinearizationPoint(), self._retired.linearised_at)
            if kind_of(key) == "l":
                of_tree = without_gaps(self.isam.getFactorsUnsafe()), self.isam.getLinearizationPoint()
                for culprit in undetermined(*of_tree) or [key]:
                    dropped.add(gtsam.Symbol(culprit).index())
                    log.append(
                        f"landmark {gtsam.Symbol(culprit).index()} made the system indeterminate and was dropped"
                    )
                    for slot in self._sightings.pop(culprit):
                        factors.remove(slot)
            elif self._factorization == "CHOLESKY":
                log.append(f"{gtsam.Symbol(key).string()} was indeterminate to rounding: solved by QR for some frames")
                self._factorization, self._frames_by_qr = "QR", 0
            else:
                log.append(f"{gtsam.Symbol(key).string()} was indeterminate and has a weak prior at its value")
                factors.add(weak_prior(key, values))
            try:
                self._rebuild(factors, values)
            except RuntimeError as again:
                refusal = again
            else:
                return Recovery(log, dropped)
        raise EstimatorError(f"the system stays indeterminate after {MOST_RECOVERIES} recoveries: {log[-1]}")

    def _back_to_cholesky(self, has_landmarks: bool) -> Recovery:
        """Return from QR, which costs ten times as much, once vision has been available again for some frames."""
        self._frames_by_qr += has_landmarks
        if self._factorization == "CHOLESKY" or self._frames_by_qr <= QR_FRAMES:
            return Recovery([], set())
        self._factorization = "CHOLESKY"
        return self._restored()

    def _rebuild(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """Rebuild the tree from all factors, those of departed variables included, and the values they involve.

        A landmark that was dropped with all its factors is left out: it would be a variable without an elimination
        index, and could not be started again.
        """
        kept = [slot for slot in range(factors.size()) if factors.exists(slot)]
        compact, slot_of = gtsam.NonlinearFactorGraph(), {old: new for new, old in enumerate(kept)}
        for slot in kept:
            compact.add(factors.at(slot))
        values = values.extract(compact.keyVector())
        self._slot_count = len(kept)
        self._cached = {slot_of[old]: factor for old, factor in self._cached.items()}
        self._sightings = {key: [slot_of[old] for old in slots] for key, slots in self._sightings.items()}
        self._tie_slots = [slot_of[old] for old in self._tie_slots]
        self._frozen.come_back(self._retired.keys)
        self._taken_back = bool(self._retired.keys)
        self._retired, self._landmarks = RetiredVariables(), set(self._sightings)
        self.isam = self._empty_tree()
        self.isam.update(compact, values, [], self._order(list(compact.keys()), in_view=()))
        self._solve_back()

    def _empty_tree(self) -> gtsam.ISAM2:
        params = gtsam.ISAM2Params()
        # Relinearisation is requested by key instead.
        params.setRelinearizeThreshold(0.0)
        params.relinearizeSkip = 1
        params.setFactorization(self._factorization)
        return gtsam.ISAM2(params)


def state_thresholds(motion: MotionModel, baseline_m: float) -> dict[str, Array]:
    """Return how far a state's variables may move from where they are linearised, (6,) or (3,) by kind, as in GTSAM."""
    pose = np.repeat([ROTATION_THRESHOLD_RAD, POSITION_THRESHOLD_BASELINES * baseline_m], 3)
    at_most = {"x": pose, "v": np.repeat(VELOCITY_THRESHOLD, 6), "b": np.repeat(BIAS_THRESHOLD, 3)}
    return {kind: at_most[kind][-size:] for kind, size in motion.variable_sizes.items()}


def any_moved_beyond(at_most: Mapping[str, Array], steps: gtsam.VectorValues, keys: list[int]) -> bool:
    """Say whether a state variable is beyond its threshold, given its step from the linearisation point."""
    if not keys:
        return False
    return bool((np.abs(steps.vector(keys)) >= np.concatenate([at_most[kind_of(key)] for key in keys])).any())


def linearised_badly(now: Array, linearised_at: Array, T_world_imu: Array, rig: StereoRig) -> BoolArray:
    """Say for which points (N, 3) m in the world the linearised image in a pose (4, 4) is off by too much.

    With image h, depth z and a point moved by dp, ``h(p) + h'(p) dp - h(p + dp)`` is ``(h(p + dp) - h(p)) dz / z``.
    """
    T_imu_world = se3_inverse(T_world_imu)
    before_px, before_m = stereo.images(transform(T_imu_world, linearised_at), rig)
    now_px, now_m = stereo.images(transform(T_imu_world, now), rig)
    off_px = (now_px - before_px) * ((now_m - before_m) / before_m)[:, None]
    off_sigma = np.linalg.norm(off_px @ rig.whitener.T, axis=1)
    return np.asarray((off_sigma > LANDMARK_BEYOND_SIGMA) | (before_m <= 0.0) | (now_m <= 0.0))
