"""What an incremental tree no longer has: variables that are marginalised for its speed, kept for the final solve.

iSAM2 walks its whole tree once a frame, whatever the frame changes. A variable that stays linearised where it is can
leave: its marginal says of the others what it said itself, to rounding. Those others GTSAM holds where they are
linearised, too. Source: Kaess et al. 2012, "iSAM2: Incremental smoothing and mapping using the Bayes tree", section
3.3, of which a marginal of leaves is the cached factor on a subtree's separator.
"""

from collections.abc import Iterable

import gtsam


class RetiredVariables:
    """The variables that left a tree, the factors that went with them, and the slots of these and their marginals."""

    def __init__(self) -> None:
        self.keys: set[int] = set()
        self.slots: set[int] = set()
        self._factors: dict[int, gtsam.NonlinearFactor] = {}
        self._marginals: set[int] = set()
        self._latest, self._linearised_at = gtsam.Values(), gtsam.Values()

    def take(self, tree: gtsam.ISAM2, leaving: list[int]) -> None:
        """Marginalise variables that nothing else in the tree hangs below; keep them and their factors."""
        before = gtsam.NonlinearFactorGraph(tree.getFactorsUnsafe())
        self._latest.insert(tree.calculateEstimate().extract(leaving))
        self._linearised_at.insert(tree.getLinearizationPoint().extract(leaving))
        marginals, removed = tree.marginalizeLeavesWithIndices(key_list(leaving))
        self._factors |= {slot: before.at(slot) for slot in removed if slot not in self._marginals}
        self._marginals = (self._marginals - set(removed)) | set(marginals)
        self.keys.update(leaving)
        self.slots = set(self._factors)

    def with_factors_of(self, tree: gtsam.ISAM2) -> gtsam.NonlinearFactorGraph:
        """Return the factors of a tree and of what left it, each in its slot, and no marginals."""
        factors = gtsam.NonlinearFactorGraph(tree.getFactorsUnsafe())
        for slot in self._marginals:
            factors.remove(slot)
        for slot, factor in self._factors.items():
            factors.replace(slot, factor)
        return factors

    def with_values(self, of_tree: gtsam.Values) -> gtsam.Values:
        """Return a tree's values and those that what left it had last."""
        return _joined(of_tree, self._latest)

    def with_linearisation_points(self, of_tree: gtsam.Values) -> gtsam.Values:
        """Return where a tree's variables and those that left it are linearised."""
        return _joined(of_tree, self._linearised_at)


def key_list(keys: Iterable[int]) -> gtsam.KeyList:
    """Return keys as GTSAM's updates take them."""
    listed = gtsam.KeyList()
    for key in keys:
        listed.push_back(key)
    return listed


def _joined(first: gtsam.Values, second: gtsam.Values) -> gtsam.Values:
    joined = gtsam.Values(first)
    joined.insert(second)
    return joined
