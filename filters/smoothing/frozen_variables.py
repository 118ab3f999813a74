"""Variables of an incremental tree whose linearisation points are fixed: frozen ones, and those that left the tree.

No recent frame has factors on a frozen variable. iSAM2 traverses its whole tree once a frame, whatever the frame
changes, so frozen variables are marginalised for speed, and kept for the final solve. The marginal of a variable that
leaves has the same information on the others as its factors, up to rounding; GTSAM fixes the linearisation points of
those others too. Source: Kaess et al. 2012, "iSAM2: Incremental smoothing and mapping using the Bayes tree", section
3.3: the marginal of leaves is the cached factor on a subtree's separator.
"""

from collections import deque
from collections.abc import Collection, Iterable, Set

import gtsam

from toolkit.models.factors import key_list


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
        self._used: set[int] = set()
        self.keys = gtsam.KeyList()

    @property
    def others(self) -> Set[int]:
        """Return the variables that recent frames have factors on, except those frozen before."""
        return self._used

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
        self._used |= frame - self._frozen
        if len(self._recent) > self._frames:
            oldest = self.count - self._frames
            for key in sorted(self._recent.popleft()):
                if self._last_frame[key] == oldest and key not in self._frozen:
                    self.keys.push_back(key)
                    self._frozen.add(key)
                    self._used.remove(key)
        self.count += 1


class RetiredVariables:
    """The variables that left a tree, their factors, and the slots of these factors and of the marginals."""

    def __init__(self) -> None:
        self.keys: set[int] = set()
        self.slots: set[int] = set()
        self._factors: dict[int, gtsam.NonlinearFactor] = {}
        self._marginals: set[int] = set()
        self._latest, self._linearised_at = gtsam.Values(), gtsam.Values()

    def take(self, tree: gtsam.ISAM2, leaving: list[int]) -> None:
        """Marginalise variables that are leaves of the tree; keep them and their factors."""
        before = gtsam.NonlinearFactorGraph(tree.getFactorsUnsafe())
        self._latest.insert(tree.calculateEstimate().extract(leaving))
        self._linearised_at.insert(tree.getLinearizationPoint().extract(leaving))
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

    def with_values(self, of_tree: gtsam.Values) -> gtsam.Values:
        return _joined(of_tree, self._latest)

    def with_linearisation_points(self, of_tree: gtsam.Values) -> gtsam.Values:
        return _joined(of_tree, self._linearised_at)


def _joined(first: gtsam.Values, second: gtsam.Values) -> gtsam.Values:
    joined = gtsam.Values(first)
    joined.insert(second)
    return joined
