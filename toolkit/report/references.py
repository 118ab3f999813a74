"""What other systems estimated from a recording, as runs that were not made here."""

from collections.abc import Mapping

import numpy as np

from toolkit.cutting import NS_PER_S
from toolkit.estimate import Landmarks, Run, Trajectory
from toolkit.geometry import IntArray
from toolkit.sequence import Sequence

# Stamps printed with 16 digits are off by half a microsecond, those with five decimals by 5; no motion shows in that.
_ROUNDING_NS = 10_000
_OTHER_TERMS = (
    "its start, its noise and its cost are its own, and it may have seen the tracks that are withheld from the others"
)


def reference_runs(references: Mapping[str, Trajectory], sequence: Sequence) -> tuple[Run, ...]:
    """Return a run for each reference, with what it said while the sequence's camera ran as causal output."""
    return tuple(_run(name, trajectory, sequence.frames_t_ns) for name, trajectory in references.items())


def _run(name: str, whole: Trajectory, frames_t_ns: IntArray) -> Run:
    t_ns = _on_frames(whole.t_ns, frames_t_ns)
    during = (t_ns >= frames_t_ns[0]) & (t_ns <= frames_t_ns[-1])
    log = [f"read from a file of the recording, not run here: {_OTHER_TERMS}"]
    if not during.any():
        log.append(f"none of its poses ({_range_s(whole.t_ns)}) lies within the frames ({_range_s(frames_t_ns)})")
    causal = Trajectory(t_ns[during], whole.T_world_imu[during])
    return Run(name, "ok", causal, None, Landmarks.none(), timings=None, log=tuple(log))


def _on_frames(t_ns: IntArray, frames_t_ns: IntArray) -> IntArray:
    """Return stamps (N,) with those that are a frame's up to rounding replaced by the frame's."""
    after = np.clip(np.searchsorted(frames_t_ns, t_ns), 1, frames_t_ns.size - 1)
    before = after - 1
    nearest = np.where(frames_t_ns[after] - t_ns < t_ns - frames_t_ns[before], after, before)
    return np.where(np.abs(frames_t_ns[nearest] - t_ns) <= _ROUNDING_NS, frames_t_ns[nearest], t_ns)


def _range_s(t_ns: IntArray) -> str:
    return f"{t_ns[0] / NS_PER_S:.3f} .. {t_ns[-1] / NS_PER_S:.3f} s"
