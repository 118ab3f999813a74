"""The window of a fixed-lag smoother on GTSAM's Bayes tree, with recovery from an indeterminate system.

GTSAM's own IncrementalFixedLagSmoother does not control the elimination order within the window and leaves the newest
state deep in the tree: its marginal then costs twice the update. Here the variables that are about to leave are
eliminated first, then the landmarks (those that marginals of departed variables connect come last, in a few large
cliques), then the states in the order of time. The oldest state, which leaves next, is the exception: it stands beside
the newest in the root. The last covariance of the oldest and the first of the newest are then nearly free, and the
update costs no more. A dummy variable follows the newest state, for the condition number of the cliques
(``indeterminate``).

A variable that makes the system indeterminate gets a weak prior at its value; if it is a landmark, so do all others
whose own factors do not determine them. A landmark that does so again in the same frame is dropped, and so are
landmarks without a determined depth in a clique for which GTSAM names another variable. If a state does so for the
first time, the cause is rounding in the normal equations: the window is then solved by QR, which takes ten times as
long, until vision has been available again for the length of the window. In either case a new tree is built from the
factors of the old one, with the same estimates.
"""

from collections.abc import Collection, Iterable

import gtsam

from filters.smoothing.graph_builder import GraphExtension
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
from toolkit.geometry import Array
from toolkit.models.factors import L, joint_cov, key_list, kind_of, points_of

MOST_RECOVERIES = 20
# How many landmarks with a marginal on them are eliminated in one clique: with fewer, copying from clique to clique
# costs more; with more, rows have zeros.
_MOST_AT_ONCE = 12
# How far an estimate may be from GTSAM's linearisation point, in rad, m and so on.
RELINEARISE_BEYOND = 0.01


class FixedLagTree:
    """Adds factors and values with their stamps; variables older than the lag are marginalised."""

    def __init__(self, lag_ns: int) -> None:
        self._lag_ns = lag_ns
        self._by_qr_from_ns: int | None = None
        self._isam = self._empty_tree()
        self._values = gtsam.Values()
        self._oldest_ns = 0
        self._state_stamps_ns: dict[int, int] = {}
        self._landmark_stamps_ns: dict[int, int] = {}
        self._first_seen_ns: dict[int, int] = {}
        # Variables in marginals of earlier trees, which are valid only at the linearisation points of these variables.
        self._fixed: set[int] = set()
        # The variables of the newest state with their sizes, and the slots of the factors that tie the dummy to them.
        self._newest: dict[int, int] = {}
        self._tie_slots: list[int] = []

    def add(self, extension: GraphExtension, t_ns: int) -> Recovery:
        """Add a packet's factors and values at a time, and solve; return the recoveries.

        Raises EstimatorError where the system stays indeterminate after all recoveries.
        """
        self._state_stamps_ns |= dict.fromkeys(extension.state_keys, t_ns)
        seen = list(map(L, extension.landmark_ids))
        self._landmark_stamps_ns |= dict.fromkeys(seen, t_ns)
        self._first_seen_ns = dict.fromkeys(seen, t_ns) | self._first_seen_ns
        self._oldest_ns = t_ns - self._lag_ns
        self._newest = {key: extension.values.extract([key]).dim() for key in extension.state_keys}
        added, back = self._solved(extension.factors, extension.values), Recovery([], set())
        # Only after the update: a landmark dropped by the return to Cholesky may be one of the packet's.
        if self._by_qr_from_ns is not None and extension.landmark_ids and t_ns > self._by_qr_from_ns + self._lag_ns:
            self._by_qr_from_ns = None
            back = self.rebuild()
        return Recovery(added.log + back.log, added.dropped | back.dropped)

    def rebuild(self) -> Recovery:
        """Rebuild the tree; its present and later estimates are the same up to rounding."""
        return self._solved(*self._emptied())

    def rebuilt_by_qr(self, refusal: RuntimeError) -> Recovery:
        """Rebuild the tree by QR where GTSAM refused a covariance because of rounding; raise any other error again.

        A covariance is read from the products of several cliques, whose condition may be worse than that of each.
        """
        key = variable_named(refusal)
        if self._by_qr_from_ns is not None:
            raise refusal
        self._by_qr_from_ns = self._newest_ns()
        again = self.rebuild()
        line = (
            f"{gtsam.Symbol(key).string()} was indeterminate to rounding in a covariance: solved by QR for some frames"
        )
        return Recovery([line, *again.log], again.dropped)

    def drop(self, track_ids: Collection[int]) -> Recovery:
        """Remove landmarks and their sightings in the window; other variables keep older sightings' information."""
        keys, factors = [L(i) for i in track_ids], self._isam.getFactorsUnsafe()
        slots = [slot for slot in range(factors.size()) if factors.exists(slot)]
        slots = [slot for slot in slots if any(_is_removed_with(key, factors.at(slot)) for key in keys)]
        self._landmark_stamps_ns |= dict.fromkeys(keys, self._oldest_ns - 1)
        return self._solved(gtsam.NonlinearFactorGraph(), gtsam.Values(), slots)

    def values(self) -> gtsam.Values:
        """Return the latest values of the window, and of the variables that left it with the last packet."""
        return self._values

    def points(self, track_ids: Iterable[int]) -> dict[int, Array]:
        """Return the latest points (3,) of landmarks of the window."""
        return points_of(self._values, track_ids)

    def cov(self, keys: list[int]) -> Array:
        """Return the joint covariance of some variables of the window, in GTSAM's tangent spaces."""
        return joint_cov(self._isam, keys)

    def _solved(
        self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, dropped_slots: Iterable[int] = ()
    ) -> Recovery:
        """Add factors and values, remove some factors, and solve until nothing is indeterminate."""
        log: list[str] = []
        with_prior, dropped = set[int](), set[int]()
        for _ in range(MOST_RECOVERIES):
            try:
                self._update(factors, values, dropped_slots)
            except RuntimeError as refusal:
                # The new factors are in the tree by now, but the tree is not usable any more.
                key, dropped_slots = variable_named(refusal), ()
                beyond = self._undetermined() if kind_of(key) == "l" else []
                if kind_of(key) != "l" and self._by_qr_from_ns is None:
                    self._by_qr_from_ns, culprits = self._newest_ns(), [key]
                    factors, values = self._emptied()
                    remedy = "to rounding: solved by QR for some frames"
                elif kind_of(key) == "l" and (key in with_prior or (beyond and key not in beyond)):
                    culprits = sorted({key, *with_prior.intersection(beyond)}) if key in with_prior else beyond
                    factors, values = self._without(culprits, *self._emptied())
                    dropped |= {gtsam.Symbol(culprit).index() for culprit in culprits}
                    remedy = ("although fixed by a weak prior, " if key in with_prior else "") + "and was dropped"
                else:
                    # GTSAM would name the others one by one.
                    culprits = sorted({key, *beyond}.difference(with_prior))
                    factors, values = self._emptied()
                    for culprit in culprits:
                        factors.add(weak_prior(culprit, values))
                    with_prior.update(culprits)
                    remedy = "and has a weak prior at its value"
                in_all = f", {len(culprits)} in all" if len(culprits) > 1 else ""
                log.append(f"{gtsam.Symbol(culprits[0]).string()} was indeterminate {remedy}{in_all}")
            else:
                return Recovery(log, dropped)
        raise EstimatorError(f"the window stays indeterminate after {MOST_RECOVERIES} recoveries: {log[-1]}")

    def _undetermined(self) -> list[int]:
        """Return the landmarks that their own factors do not determine."""
        return undetermined(without_gaps(self._isam.getFactorsUnsafe()), self._isam.getLinearizationPoint())

    def _newest_ns(self) -> int:
        return max(self._state_stamps_ns.values())

    def _update(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, dropped_slots: Iterable[int]) -> None:
        old_states = [key for key, t_ns in self._state_stamps_ns.items() if t_ns < self._oldest_ns]
        old_landmarks = [key for key, t_ns in self._landmark_stamps_ns.items() if t_ns < self._oldest_ns]
        # Before an old state can leave, everything below it in the tree must be eliminated again, after it; and
        # CCOLAMD accepts no index beyond the number of variables it orders.
        new = set(values.keys())
        known = [key for key in (*self._landmark_stamps_ns, *self._state_stamps_ns) if key not in new]
        factors, values = with_the_last_tied(self._isam, factors, values, self._newest)
        slots = [*dropped_slots, *self._tie_slots]
        self._add(factors, values, slots, key_list(known))
        # QR eliminates singular systems without an error; solving raises it here, before anything is marginalised.
        self._values = self._isam.calculateEstimate()
        leaving = old_landmarks + old_states
        still_there = [key for key in leaving if self._isam.valueExists(key)]
        if still_there:
            self._isam.marginalizeLeaves(key_list(still_there))
        self._forget(leaving)

    def _add(
        self,
        factors: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        dropped_slots: Iterable[int],
        eliminated_anew: gtsam.KeyList,
    ) -> None:
        """Add factors and values, and remove some factors."""
        slots, fixed = list(dropped_slots), key_list(self._fixed)
        result = self._isam.update(factors, values, slots, self._order(), fixed, eliminated_anew)
        self._tie_slots = list(result.getNewFactorsIndices())[-len(self._newest) :]

    def _forget(self, leaving: Iterable[int]) -> None:
        for stamps_ns in (self._state_stamps_ns, self._landmark_stamps_ns, self._first_seen_ns):
            for key in stamps_ns.keys() & leaving:
                del stamps_ns[key]
        self._fixed.difference_update(leaving)

    def _emptied(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Start a new tree; return all factors and values of the old one, to be added to it.

        A landmark that was dropped with all its factors is left out, because in a tree it would be a variable without
        an elimination index. GTSAM's marginal factors have no linearisation point: they stay right only while their
        variables keep their linearisation points. The tree that made them fixes those; for the next tree they must
        be passed on.
        """
        factors, values = without_gaps(self._isam.getFactorsUnsafe(), but=LAST), self._isam.getLinearizationPoint()
        self._tie_slots = []
        self._fixed.update(self._isam.getFixedVariables())
        self._isam = self._empty_tree()
        known = set(factors.keyVector())
        lost = [key for key in values.keys() if key not in known]  # noqa: SIM118 - not a mapping
        for key in lost:
            values.erase(key)
        self._forget(lost)
        return factors, values

    def _without(
        self, landmarks: list[int], factors: gtsam.NonlinearFactorGraph, values: gtsam.Values
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Return factors and values without landmarks and their sightings; the prior is marginalised over them."""
        for key in landmarks:
            kept = gtsam.NonlinearFactorGraph()
            for factor in (factors.at(i) for i in range(factors.size())):
                if not _is_removed_with(key, factor):
                    kept.add(factor)
            if kept.keys().count(key):
                self._landmark_stamps_ns[key] = self._oldest_ns - 1
                kept.add(weak_prior(key, values))
            else:
                values.erase(key)
                self._forget([key])
            factors = kept
        return factors, values

    def _empty_tree(self) -> gtsam.ISAM2:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(RELINEARISE_BEYOND)
        params.relinearizeSkip = 1
        params.findUnusedFactorSlots = True
        params.setFactorization("CHOLESKY" if self._by_qr_from_ns is None else "QR")
        return gtsam.ISAM2(params)

    def _order(self) -> gtsam.KeyGroupMap:
        """Return the elimination index of every variable; those about to leave have none, which puts them first.

        Indices must be consecutive: CCOLAMD, unchecked, expects fewer of them than variables.
        """
        landmarks = [key for key, t_ns in self._landmark_stamps_ns.items() if t_ns >= self._oldest_ns]
        states = [(key, t_ns) for key, t_ns in self._state_stamps_ns.items() if t_ns >= self._oldest_ns]
        some_leave = len(landmarks) + len(states) < len(self._landmark_stamps_ns) + len(self._state_stamps_ns)
        groups, place = gtsam.KeyGroupMap(), int(some_leave)
        for together in self._landmark_groups(landmarks):
            for key in together:
                groups.insert2(key, place)
            place += bool(together)
        stamps_ns = _oldest_beside_newest(list(dict.fromkeys(t_ns for _, t_ns in states)))
        place_of = {t_ns: place + i for i, t_ns in enumerate(stamps_ns)}
        for key, t_ns in states:
            groups.insert2(key, place_of[t_ns])
        groups.insert2(LAST, place + len(stamps_ns))
        return groups

    def _landmark_groups(self, landmarks: list[int]) -> list[list[int]]:
        """Return groups of landmarks to eliminate together: first those that are in no marginal.

        All others are connected by marginals. They are grouped by when they were last seen, and each group starts with
        its landmark seen the latest. No other landmark of the group then involves states that the first does not, and
        the group is eliminated as one clique; otherwise each landmark would be eliminated in a clique of nearly all
        remaining variables.
        """
        connected = [key for key in landmarks if self._first_seen_ns[key] < self._oldest_ns]
        connected.sort(key=self._landmark_stamps_ns.__getitem__)
        turns = [connected[i : i + _MOST_AT_ONCE] for i in range(0, len(connected), _MOST_AT_ONCE)]
        unconnected = [key for key in landmarks if self._first_seen_ns[key] >= self._oldest_ns]
        return [unconnected, *(part for turn in turns for part in (turn[-1:], turn[:-1]))]


def _is_removed_with(landmark: int, factor: gtsam.NonlinearFactor) -> bool:
    """Say whether a factor is removed with a landmark: a sighting, or a linear factor on it alone."""
    keys: list[int] = factor.keys()
    return landmark in keys and (len(keys) == 1 or not isinstance(factor, gtsam.LinearContainerFactor))


def _oldest_beside_newest(stamps_ns: list[int]) -> list[int]:
    return [*stamps_ns[1:-1], *stamps_ns[:1], *stamps_ns[1:][-1:]]
