"""A sequence with only some of its frames or motion samples."""

from dataclasses import replace

import numpy as np

from toolkit.geometry import BoolArray, IntArray
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


def keep_samples(sequence: Sequence, kept: BoolArray | IntArray) -> Sequence:
    """Return the sequence with the motion samples of a mask (S,) or an index (M,), in that order."""
    motion = sequence.motion
    return replace(sequence, motion=motion.of(motion.t_ns[kept], motion.values[kept]))
