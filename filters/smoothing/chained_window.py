"""The chained sightings of an incremental smoother: frames are added, states and landmarks leave, factors are renewed.

The graph holds their linearisations, renewed in every frame about the latest estimates: the residuals are then exact,
and the weights of the loss are those of the residuals. For a variable whose linearisation point a marginal fixes, the
Jacobians are taken at that point, as in GTSAM's own factors. An unobservable direction is then in the null space of
both sightings and marginal.
"""

from collections.abc import Iterable

import gtsam
import numpy as np

from filters.smoothing.track_chain import ChainedFactors, SightingRows
from toolkit.sequence import StereoFrame, StereoRig


class ChainedWindow:
    """The sightings of the frames in a window, and the slots of their factors in the graph."""

    def __init__(self, rig: StereoRig, huber: float | None) -> None:
        self._rig, self._huber = rig, huber
        self._rows = SightingRows.none()
        self._since_ns: list[int] = []
        self._slots: list[int] = []

    @property
    def is_used(self) -> bool:
        """Say whether the rig states a track noise model."""
        return self._rig.track_noise is not None

    @property
    def slots(self) -> list[int]:
        """Return the slots of the factors in the graph."""
        return self._slots

    def add(self, frame: StereoFrame, k: int) -> None:
        """Add the sightings of landmarks in frame k."""
        self._rows = self._rows.followed_by(frame, k)

    def drop(self, track_ids: Iterable[int]) -> None:
        """Drop the sightings of some landmarks."""
        self._rows = self._rows.select(~np.isin(self._rows.track_id, list(track_ids)))

    def placed(self, slots: Iterable[int]) -> None:
        """Record the slots of the factors that were returned last."""
        self._slots = list(slots)

    def forget(self, oldest_ns: int) -> None:
        """Drop older frames with the factors on them, which a marginal has absorbed.

        These factors include the innovations of the sightings that come next after the dropped ones. Later sightings
        chain from those that stay.
        """
        if not self.is_used:
            return
        self._rows = self._rows.select(self._rows.t_ns >= oldest_ns)
        kept = [since_ns >= oldest_ns for since_ns in self._since_ns]
        self._slots = [slot for slot, stays in zip(self._slots, kept, strict=True) if stays]
        self._since_ns = [since_ns for since_ns in self._since_ns if since_ns >= oldest_ns]

    def keys(self) -> list[int]:
        """Return the keys of the poses and landmarks of all sightings."""
        return self._rows.keys()

    def counted_keys(self, values: gtsam.Values) -> set[int]:
        """Return the keys of the poses and landmarks of the sightings that are used at some values."""
        if not self._rows.pose.size:
            return set()
        sightings = ChainedFactors.of(self._rows, self._rig, self._huber).in_front(values).sightings
        return set(self._rows.select(sightings.counted).keys())

    def factors(self, values: gtsam.Values, jacobians_at: gtsam.Values) -> gtsam.NonlinearFactorGraph:
        """Return the innovation of each sighting, linearised about the values; report their slots to :meth:`placed`."""
        if not self._rows.pose.size:
            self._since_ns = []
            return gtsam.NonlinearFactorGraph()
        chained = ChainedFactors.of(self._rows, self._rig, self._huber).in_front(values)
        counted, before = chained.sightings.counted, chained.sightings.chain.before
        oldest = np.where(before >= 0, before, np.arange(before.size))
        self._since_ns = self._rows.t_ns[oldest[counted]].tolist()
        return chained.linearised(values, jacobians_at)
