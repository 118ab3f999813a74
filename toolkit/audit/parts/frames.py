"""Keeping some frames of a sequence and renumbering what refers to them."""

from dataclasses import replace

import numpy as np

from toolkit.geometry import IntArray
from toolkit.sequence import Observations, Sequence


def keep_frames(sequence: Sequence, kept: IntArray) -> Sequence:
    """Return the sequence with the frames ``kept`` (M,), in that order; the sightings of the others go.

    A prior is the state at the first frame: it goes where that frame is another one.
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
