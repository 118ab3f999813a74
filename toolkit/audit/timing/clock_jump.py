"""A clock that is set on the way: stamps of frames and samples leap, or stay, together, and the vehicle does not.

Where both were lost for a while the vehicle has moved on, as far as the stamps say; where the clock was set it has
moved by one usual step, whatever they say. Which of the two it is the tracks tell: how far the camera went in that
interval, in steps of those beside it. A clock that goes back by more than a step is seen by its stamps (`time_order`).
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.edits import keep_frames, keep_samples
from toolkit.audit.parts.robust import MAD_TO_SIGMA, Scalar
from toolkit.audit.parts.stamps import NOT_A_TIME
from toolkit.geometry import Array, IntArray
from toolkit.models.camera_motion import camera_motion
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# A step of the frames counts that is off the usual one by this share of it, by so long (s), and by so many of the
# scatter of all steps. One of the samples beside it is off by the same, to half of a usual step and a quarter.
LEAST_SHARE, LEAST_S, SCATTERS = 0.25, 0.01, 10.0
ALIKE_STEPS, ALIKE = 0.5, 0.25
# How far the camera goes in a step is told by so many on either side, known no better than to 3 %: acceleration.
AROUND, FEWEST_AROUND, SYSTEMATIC = 4, 5, 0.03
# It went one step within so many standard errors, or as many steps as the stamps say; both are so many apart at least.
WITHIN, APART = 3.0, 6.0
# A camera that goes less (m), or turns less (rad), in a usual step tells nothing.
LEAST_M, LEAST_RAD = 0.01, 0.005
# With more steps that are off the stamps are of another kind, and none of them is a jump.
MOST = 10


class _Step(NamedTuple):
    """The frame and the sample after which both streams have another step, by how much (s), and how often a usual one.

    ``gone`` is how many usual steps the camera went; None where that does not tell whether the clock was set.
    """

    frame: int
    sample: int
    by_s: float
    stamped: float
    gone: Scalar | None

    @property
    def is_jump(self) -> bool:
        """Whether the camera went one step, and not what the stamps say."""
        if self.gone is None:
            return False
        near, far = abs(self.gone.value - 1.0), abs(self.gone.value - self.stamped)
        return near < WITHIN * self.gone.error < far


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Name the times at which the clock was set; keep the longest stretch between them."""
    sequence = evidence.sequence
    steps = list(_steps_alike(sequence))
    jumps = [step for step in steps if step.is_jump]
    if not jumps:
        open_s = [f"{step.by_s:+.3g} s at {_at_s(sequence, step):.1f} s" for step in steps if step.gone is None]
        summary = f"the stamps of frames and samples leap together by {', '.join(open_s)}"
        return Undecided(f"{summary}: the tracks do not tell whether time passed") if open_s else None
    usual_s = float(np.median(np.diff(sequence.frames_t_ns))) / NS_PER_S
    jumps_text = [
        f"by {step.by_s:+.3g} s at {_at_s(sequence, step):.1f} s (by the tracks "
        f"{usual_s * step.gone.value:.3f} +- {usual_s * step.gone.error:.3f} s passed)"
        for step in jumps
        if step.gone is not None
    ]
    remedy = _longest_stretch(sequence, jumps)
    return Symptom(
        count=len(jumps),
        detail=f"the clock of frames and samples is set {', '.join(jumps_text)}",
        treatment=f"the longest stretch without a jump is kept: {remedy.frame_count} of {sequence.frame_count} frames",
        remedy=remedy,
    )


def _at_s(sequence: Sequence, step: _Step) -> float:
    return float(sequence.frames_t_ns[step.frame] - sequence.frames_t_ns[0]) / NS_PER_S


def _steps_alike(sequence: Sequence) -> Iterator[_Step]:
    """Yield the steps of the frames that are off the usual one, and those of the samples beside them likewise."""
    frames_t_ns, samples_t_ns = sequence.frames_t_ns, sequence.motion.t_ns
    if min(frames_t_ns.size, samples_t_ns.size) < 2 * AROUND or NOT_A_TIME in (frames_t_ns.min(), samples_t_ns.min()):
        return
    step_s, sample_step_s = np.diff(frames_t_ns) / NS_PER_S, np.diff(samples_t_ns) / NS_PER_S
    usual_s, usual_sample_s = float(np.median(step_s)), float(np.median(sample_step_s))
    if usual_s <= 0.0 or usual_sample_s <= 0.0:
        return
    off_s, sample_off_s = step_s - usual_s, sample_step_s - usual_sample_s
    scatter_s = MAD_TO_SIGMA * float(np.median(np.abs(off_s)))
    far = (np.abs(off_s) > max(LEAST_SHARE * usual_s, LEAST_S, SCATTERS * scatter_s)) & (step_s >= 0.0)
    if far.sum() > MOST:
        return
    for frame in np.flatnonzero(far).tolist():
        by_s = float(off_s[frame])
        reach_ns = round((usual_sample_s + abs(by_s)) * NS_PER_S)
        begin, end = frames_t_ns[frame] - reach_ns, frames_t_ns[frame + 1] + reach_ns
        near = np.flatnonzero((samples_t_ns[:-1] >= begin) & (samples_t_ns[1:] <= end))
        apart_s = np.abs(sample_off_s[near] - by_s)
        if near.size and apart_s.min() <= max(ALIKE_STEPS * usual_sample_s, ALIKE * abs(by_s)):
            stamped = float(step_s[frame]) / usual_s
            yield _Step(frame, int(near[np.argmin(apart_s)]), by_s, stamped, _gone(sequence, frame, stamped))


def _gone(sequence: Sequence, frame: int, stamped: float) -> Scalar | None:
    """Return how many usual steps the camera goes, or turns, after a frame, if that tells one from those stamped."""
    for steps in _steps_gone(sequence, frame):
        error = float(np.hypot(steps.error, SYSTEMATIC))
        decided = abs(steps.value - 1.0) < WITHIN * error or abs(steps.value - stamped) < WITHIN * error
        if decided and abs(stamped - 1.0) > APART * error:
            return Scalar(steps.value, error)
    return None


def _steps_gone(sequence: Sequence, frame: int) -> Iterator[Scalar]:
    """Yield how far the camera goes, and how far it turns, after a frame in units of what it does around it.

    What stands, turns little or is not known says nothing.
    """
    kept = np.arange(max(frame - AROUND, 0), min(frame + AROUND + 2, sequence.frame_count))
    camera = camera_motion(replace(keep_frames(sequence, kept), frames_t_ns=NS_PER_S * np.arange(kept.size)))
    here = int(np.flatnonzero(kept == frame)[0])
    if not camera.known[here]:
        return
    for moved, least in ((camera.v_mps, LEAST_M), (camera.w_radps, LEAST_RAD)):
        beside = np.flatnonzero(camera.known & (np.arange(camera.known.size) != here))
        size = np.linalg.norm(moved, axis=1)
        if beside.size < FEWEST_AROUND or np.median(size[beside]) < least or _is_noise(moved, beside, here):
            continue
        yield _ratio(size, beside, here)


def _is_noise(moved: Array, beside: IntArray, here: int) -> bool:
    """Say whether motions (n, 3) beside one at ``here`` have no direction in common, as noise of what stands has none.

    That is where the lines through them come no farther from zero than so many of their standard errors.
    """
    line = np.stack([np.ones(beside.size), beside - here], axis=1)
    found, *_ = np.linalg.lstsq(line, moved[beside])
    variance = float(np.sum((moved[beside] - line @ found) ** 2)) / (beside.size - 2)
    error = np.sqrt(variance * np.linalg.inv(line.T @ line)[0, 0])
    return bool(np.linalg.norm(found[0]) < APART * error)


def _ratio(size: Array, beside: IntArray, here: int) -> Scalar:
    """Return a size (n,) at one interval over the line through those beside it, and its standard error."""
    line = np.polynomial.Polynomial.fit(beside - here, size[beside], 1)
    expected = float(line(0.0))
    scatter = float(np.sqrt(np.sum((size[beside] - line(beside - here)) ** 2) / (beside.size - 2)))
    return Scalar(size[here] / expected, scatter / expected * float(np.sqrt(1.0 + 1.0 / beside.size)))


def _longest_stretch(sequence: Sequence, jumps: list[_Step]) -> Sequence:
    """Return the longest stretch, in frames, between two jumps, with its samples; the first of equals."""
    frame_part = np.searchsorted([jump.frame for jump in jumps], np.arange(sequence.frame_count), side="left")
    sample_part = np.searchsorted([jump.sample for jump in jumps], np.arange(sequence.motion.t_ns.size), side="left")
    part = int(np.argmax(np.bincount(frame_part)))
    return keep_samples(keep_frames(sequence, np.flatnonzero(frame_part == part)), sample_part == part)


FAULT = Fault(
    "clock-jump",
    "a clock that is set on the way, by more or less than a step, while the vehicle goes on",
    check,
)
