"""Edits of a sequence: a selection of frames or motion samples, and new ids where a track follows another point."""

from dataclasses import replace

import numpy as np

from toolkit.geometry import BoolArray, IntArray
from toolkit.sequence import Observations, Sequence


def keep_frames(sequence: Sequence, kept: IntArray) -> Sequence:
    """Return the sequence with the frames ``kept`` (M,), in that order, without the sightings of the others.

    A prior is the state at the first frame: it is dropped where the first frame changes.
    """
    new_index = np.full(sequence.frame_count, -1)
    new_index[kept] = np.arange(kept.size)
    observations = sequence.observations
    frame = new_index[observations.frame]
    rows = frame >= 0
    first_frame_stays = kept.size > 0 and kept[0] == 0
    return replace(
        sequence,
        frames_t_ns=sequence.frames_t_ns[kept],
        observations=Observations.sorted(frame[rows], observations.track_id[rows], observations.uv_px[rows]),
        prior=sequence.prior if first_frame_stays else None,
    )


def keep_samples(sequence: Sequence, kept: BoolArray | IntArray) -> Sequence:
    """Return the sequence with the motion samples of a mask (S,) or an index (M,), in that order."""
    motion = sequence.motion
    return replace(sequence, motion=motion.of(motion.t_ns[kept], motion.values[kept]))


def by_track(observations: Observations) -> IntArray:
    """Return the order (N,) that lists the sightings track by track, each track by frame."""
    return np.lexsort((observations.frame, observations.track_id))


def split(observations: Observations, starts: BoolArray) -> IntArray:
    """Return track ids (N,) in which a new track begins at every row of the mask ``starts`` (N,).

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
