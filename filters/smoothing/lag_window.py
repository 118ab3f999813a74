"""The window of a fixed-lag smoother on GTSAM's Bayes tree, which goes on when its system becomes indeterminate.

GTSAM's own IncrementalFixedLagSmoother leaves the order of elimination within the window to chance, and the newest
state deep in the tree: its marginal then costs twice the update. Here the elimination takes what is to leave first,
then the landmarks, then the states in the order of time, but the oldest, which leaves next, beside the newest in the
root: what the window says in the end of the one and first of the other is nearly free, and the update is no dearer.

A variable that makes the system indeterminate is held weakly where it is. A state that does so the first time is a
matter of rounding in the normal equations, as in seconds of an accurate IMU alone: the window is then solved by QR,
ten times dearer, until vision has been back for as long as it reaches.
"""

from collections.abc import Iterable

import gtsam

from filters.smoothing.graph_builder import Grown
from filters.smoothing.indeterminate import variable_named, weak_hold, without_gaps
from filters.smoothing.marginals import state_cov
from toolkit.errors import EstimatorError
from toolkit.geometry import Array
from toolkit.models.factors import L, kind_of

MOST_RECOVERIES = 20
RELINEARISE_BEYOND = 0.01


class LagWindow:
    """Takes in factors and values with their stamps; what is older than the lag is marginalised."""

    def __init__(self, lag_ns: int) -> None:
        self._lag_ns = lag_ns
        self._by_qr_from_ns: int | None = None
        self._isam = self._empty_tree()
        self._state_stamps_ns: dict[int, int] = {}
        self._landmark_stamps_ns: dict[int, int] = {}

    def add(self, grown: Grown, t_ns: int) -> list[str]:
        """Take in what a packet at a time adds, and solve; return what had to be recovered, a line each.

        Raises EstimatorError where the system stays indeterminate whatever is held.
        """
        self._state_stamps_ns |= dict.fromkeys(grown.state_keys, t_ns)
        self._landmark_stamps_ns |= dict.fromkeys(map(L, grown.landmark_ids), t_ns)
        factors, values = grown.factors, grown.values
        if self._by_qr_from_ns is not None and grown.landmark_ids and t_ns > self._by_qr_from_ns + self._lag_ns:
            self._by_qr_from_ns = None
            factors, values = self._emptied(factors, values)
        log: list[str] = []
        for _ in range(MOST_RECOVERIES):
            try:
                self._update(factors, values, t_ns - self._lag_ns)
            except RuntimeError as refusal:
                # What was new is in the tree by now, but the tree is not to be used any more.
                key = variable_named(refusal)
                rounding = kind_of(key) != "l" and self._by_qr_from_ns is None
                if rounding:
                    self._by_qr_from_ns = t_ns
                factors, values = self._emptied(gtsam.NonlinearFactorGraph(), gtsam.Values())
                if not rounding:
                    factors.add(weak_hold(key, values))
                remedy = "to rounding: solved by QR for some frames" if rounding else "and is held weakly where it was"
                log.append(f"{gtsam.Symbol(key).string()} was indeterminate {remedy}")
            else:
                return log
        raise EstimatorError(f"the window stays indeterminate after {MOST_RECOVERIES} recoveries: {log[-1]}")

    def values(self) -> gtsam.Values:
        """Return the latest values of the window."""
        return self._isam.calculateEstimate()

    def state_cov(self, keys: list[int], R_world_imu: Array) -> Array:
        """Return the covariance of one state, in the order and on the side of an Estimate."""
        return state_cov(self._isam, keys, R_world_imu)

    def _update(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, oldest_ns: int) -> None:
        old_states = [key for key, t_ns in self._state_stamps_ns.items() if t_ns < oldest_ns]
        old_landmarks = [key for key, t_ns in self._landmark_stamps_ns.items() if t_ns < oldest_ns]
        # Before an old state can leave, all that stands below it in the tree must be eliminated anew, after it. The
        # states are at every step: CCOLAMD takes no place beyond the number of variables it orders.
        moved = [*(self._landmark_stamps_ns if old_states else old_landmarks), *self._state_stamps_ns]
        known = [key for key in moved if self._isam.valueExists(key)]
        self._isam.update(factors, values, [], self._order(oldest_ns), gtsam.KeyList(), _key_list(known))
        leaving = old_landmarks + old_states
        if leaving:
            self._isam.marginalizeLeaves(_key_list(leaving))
        for stamps_ns in (self._state_stamps_ns, self._landmark_stamps_ns):
            for key in stamps_ns.keys() & leaving:
                del stamps_ns[key]

    def _emptied(
        self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Begin a new tree; return all that was in the old one, and what is given, to be taken in."""
        everything, everywhere = without_gaps(self._isam.getFactorsUnsafe()), self._isam.getLinearizationPoint()
        everything.push_back(factors)
        everywhere.insert(values)
        self._isam = self._empty_tree()
        return everything, everywhere

    def _empty_tree(self) -> gtsam.ISAM2:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(RELINEARISE_BEYOND)
        params.relinearizeSkip = 1
        params.findUnusedFactorSlots = True
        params.setFactorization("CHOLESKY" if self._by_qr_from_ns is None else "QR")
        return gtsam.ISAM2(params)

    def _order(self, oldest_ns: int) -> gtsam.KeyGroupMap:
        """Return the place of every variable in the elimination; those to leave have none, which is the first.

        Places must be consecutive: CCOLAMD, unchecked, wants fewer of them than variables.
        """
        landmarks = [key for key, t_ns in self._landmark_stamps_ns.items() if t_ns >= oldest_ns]
        states = [(key, t_ns) for key, t_ns in self._state_stamps_ns.items() if t_ns >= oldest_ns]
        some_leave = len(landmarks) + len(states) < len(self._landmark_stamps_ns) + len(self._state_stamps_ns)
        groups, place = gtsam.KeyGroupMap(), int(some_leave)
        for key in landmarks:
            groups.insert2(key, place)
        place += bool(landmarks)
        stamps_ns = _oldest_beside_newest(list(dict.fromkeys(t_ns for _, t_ns in states)))
        place_of = {t_ns: place + i for i, t_ns in enumerate(stamps_ns)}
        for key, t_ns in states:
            groups.insert2(key, place_of[t_ns])
        return groups


def _oldest_beside_newest(stamps_ns: list[int]) -> list[int]:
    return [*stamps_ns[1:-1], *stamps_ns[:1], *stamps_ns[1:][-1:]]


def _key_list(keys: Iterable[int]) -> gtsam.KeyList:
    listed = gtsam.KeyList()
    for key in keys:
        listed.push_back(key)
    return listed
