"""Pairs of sightings of one track in two frames that follow each other."""

from typing import NamedTuple

import numpy as np

from toolkit.geometry import BoolArray, IntArray
from toolkit.sequence import Observations


class Neighbours(NamedTuple):
    """Rows into the observations: ``before`` (P,) seen in frame k, ``after`` (P,) the same track in k + 1.

    Sorted by frame; ``interval`` (P,) is k.
    """

    before: IntArray
    after: IntArray
    interval: IntArray

    def select(self, rows: BoolArray) -> "Neighbours":
        """Return the pairs of a mask (P,)."""
        return Neighbours(self.before[rows], self.after[rows], self.interval[rows])


def neighbours(observations: Observations) -> Neighbours:
    """Pair each sighting with the same track's sighting in the next frame, where there is one."""
    frame, track_id = observations.frame, observations.track_id
    by_track = np.lexsort((frame, track_id))
    follows = (np.diff(track_id[by_track]) == 0) & (np.diff(frame[by_track]) == 1)
    before, after = by_track[:-1][follows], by_track[1:][follows]
    in_time = np.argsort(frame[before], kind="stable")
    before, after = before[in_time], after[in_time]
    return Neighbours(before, after, frame[before])
