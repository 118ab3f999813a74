"""Faults of clocks: wrong stamps of frames, or of frames and motion samples.

They are injectors like those of ``faults``, which re-exports them.
"""

from dataclasses import replace

import numpy as np

from toolkit.geometry import BoolArray, IntArray
from toolkit.sequence import Observations, Sequence
from toolkit.simulation.faults.parts import ns, span_s


def camera_clock(sequence: Sequence, dose: float = 0.02, seed: int = 0) -> Sequence:
    """Stamp all frames late by the dose (s): exposure and transfer not accounted for, a clock set by hand.

    Frames that leave the time of the motion samples are cut off. The truth stays on the motion's clock.
    """
    return _with_frames_at(sequence, sequence.frames_t_ns + ns(dose))


def camera_clock_step(sequence: Sequence, dose: float = 0.05, seed: int = 0) -> Sequence:
    """Stamp the frames of the second half late by the dose (s): only the camera's clock is set during the recording."""
    later = np.arange(sequence.frame_count) >= sequence.frame_count // 2
    return _with_frames_at(sequence, sequence.frames_t_ns + np.where(later, ns(dose), 0))


def alternate_frames_late(sequence: Sequence, dose: float = 0.02, seed: int = 0) -> Sequence:
    """Stamp every other frame late by the dose (s): two buffers, of which one is read after the other."""
    odd = np.arange(sequence.frame_count) % 2 == 1
    return _with_frames_at(sequence, sequence.frames_t_ns + np.where(odd, ns(dose), 0))


def frame_jitter(sequence: Sequence, dose: float = 0.015, seed: int = 0) -> Sequence:
    """Shift each stamp uniformly by up to the dose (s), less than half a step: a busy computer."""
    off_s = np.random.default_rng(seed).uniform(-dose, dose, sequence.frame_count)
    return _with_frames_at(sequence, sequence.frames_t_ns + np.rint(1e9 * off_s).astype(np.int64))


def camera_clock_drift(sequence: Sequence, dose: float = 0.02, seed: int = 0) -> Sequence:
    """Let the camera's clock run fast by a share of the time: a cheap quartz, frames counted and not stamped."""
    since_ns = sequence.frames_t_ns - sequence.frames_t_ns[0]
    return _with_frames_at(sequence, sequence.frames_t_ns + np.rint(dose * since_ns).astype(np.int64))


def clock_jump(sequence: Sequence, dose: float = -0.5, seed: int = 0) -> Sequence:
    """Shift all stamps of frames and samples by the dose (s) from some time on: a daemon sets the clock."""
    at_ns = sequence.frames_t_ns[0] + ns(span_s(sequence, 0.0, seed)[0])
    motion, frames_t_ns = sequence.motion, sequence.frames_t_ns
    frames_t_ns = frames_t_ns + np.where(frames_t_ns > at_ns, ns(dose), 0)
    samples_t_ns = motion.t_ns + np.where(motion.t_ns > at_ns, ns(dose), 0)
    return replace(sequence, frames_t_ns=frames_t_ns, motion=replace(motion, t_ns=samples_t_ns))


def _with_frames_at(sequence: Sequence, frames_t_ns: IntArray) -> Sequence:
    """Return the sequence with other stamps of its frames (K,), without those outside the motion samples."""
    moved, motion_t_ns = replace(sequence, frames_t_ns=frames_t_ns), sequence.motion.t_ns
    inside = (frames_t_ns >= motion_t_ns[0]) & (frames_t_ns <= motion_t_ns[-1])
    return moved if inside.all() else _with_first_frames_cut(moved, inside)


def _with_first_frames_cut(sequence: Sequence, inside: BoolArray) -> Sequence:
    """Return the sequence with the frames of a mask (K,) that is one stretch; the prior goes with the first one."""
    seen, first = sequence.observations, int(np.argmax(inside))
    rows = inside[seen.frame]
    kept = Observations(seen.frame[rows] - first, seen.track_id[rows], seen.uv_px[rows])
    prior = sequence.prior if first == 0 else None
    return replace(sequence, frames_t_ns=sequence.frames_t_ns[inside], observations=kept, prior=prior)
