"""Sightings track by track, and a new track where an id no longer follows one point."""

import numpy as np

from toolkit.geometry import BoolArray, IntArray
from toolkit.sequence import Observations


def by_track(observations: Observations) -> IntArray:
    """Return the order (N,) that lists the sightings track by track, each track by frame."""
    return np.lexsort((observations.frame, observations.track_id))


def split(observations: Observations, starts: BoolArray) -> IntArray:
    """Return track ids (N,) in which every row of ``starts`` (N,), and its track from there on, is a new track.

    The first part of each track keeps its id; new ids follow the largest one there is.
    """
    order = by_track(observations)
    track_id = observations.track_id[order]
    first_of_track = np.diff(track_id, prepend=-1) != 0
    first_of_track[:1] = True
    part = np.cumsum(starts[order] & ~first_of_track)
    part_at_first = np.maximum.accumulate(np.where(first_of_track, part, 0))
    renamed = np.empty_like(track_id)
    renamed[order] = np.where(part > part_at_first, track_id.max(initial=-1) + part, track_id)
    return renamed
