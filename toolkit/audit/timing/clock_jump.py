"""A clock that is set during the recording: stamps of frames and samples jump together, and the vehicle does not.

If nothing was recorded for a while, the vehicle has moved as far as the stamps say; if the clock was set, it has moved
by one usual step. The distance that the camera moves in that interval, by the tracks and in units of the intervals
around it, decides between the two. A clock that goes back by more than a step shows in its stamps (`time_order`).
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.edits import keep_frames, keep_samples
from toolkit.audit.parts.robust import Scalar
from toolkit.audit.parts.stamps import NOT_A_TIME
from toolkit.geometry import Array, IntArray
from toolkit.models.camera_motion import camera_motion
from toolkit.models.gating import MAD_TO_SIGMA
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# A step of the frames is unusual if it differs from the usual one by this share of it, by this time (s), and by so many
# times the scatter of all steps. A step of the samples near it must differ by the same, to half of their usual step or
# a quarter of the difference.
LEAST_SHARE, LEAST_S, SCATTERS = 0.25, 0.01, 10.0
ALIKE_STEPS, ALIKE = 0.5, 0.25
# So many intervals on either side show how far the camera moves in a step, at least so many together; acceleration
# limits the accuracy to this share.
AROUND, FEWEST_AROUND, SYSTEMATIC = 4, 5, 0.03
# The camera moved one step, or as many as the stamps say, to within so many standard errors; the two must be at least
# so many standard errors apart.
WITHIN, APART = 3.0, 6.0
# A camera that moves less (m), or rotates less (rad), in a usual step is not used.
LEAST_M, LEAST_RAD = 0.01, 0.005
# With more unusual steps than this, none of them is taken as a jump: the stamps are uneven for another reason.
MOST = 10


class _Step(NamedTuple):
    """The frame and the sample after which both streams have an unusual step.

    ``by_s`` is its excess over the usual step, ``stamped`` the step of the frames in usual steps. ``gone`` is how many
    usual steps the camera moved; None where that does not show whether the clock was set.
    """

    frame: int
    sample: int
    by_s: float
    stamped: float
    gone: Scalar | None

    @property
    def is_jump(self) -> bool:
        """Whether the camera moved by one usual step, and not by as many as the stamps say."""
        if self.gone is None:
            return False
        near, far = abs(self.gone.value - 1.0), abs(self.gone.value - self.stamped)
        return near < WITHIN * self.gone.error < far


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Report the times at which the clock was set; keep the longest stretch between them."""
    sequence = evidence.sequence
    steps = list(_steps_alike(sequence))
    jumps = [step for step in steps if step.is_jump]
    if not jumps:
        open_s = [f"{step.by_s:+.3g} s at {_at_s(sequence, step):.1f} s" for step in steps if step.gone is None]
        summary = f"the stamps of frames and samples jump together by {', '.join(open_s)}"
        return Undecided(f"{summary}: the tracks do not determine whether time passed") if open_s else None
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
    """Yield the unusual steps of the frames at which the samples have a step with the same excess."""
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
    """Return how many usual steps the camera moves or rotates after a frame, if that decides the question."""
    for steps in _steps_gone(sequence, frame):
        error = float(np.hypot(steps.error, SYSTEMATIC))
        decided = abs(steps.value - 1.0) < WITHIN * error or abs(steps.value - stamped) < WITHIN * error
        if decided and abs(stamped - 1.0) > APART * error:
            return Scalar(steps.value, error)
    return None


def _steps_gone(sequence: Sequence, frame: int) -> Iterator[Scalar]:
    """Yield how far the camera moves, and how far it rotates, after a frame, in units of the intervals around it.

    Nothing is yielded where the camera stands, hardly rotates, or its motion is not known.
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
    """Say whether motions (n, 3) around the one at ``here`` have no common direction, as noise at standstill.

    That is so where the line through them, at ``here``, is within APART standard errors of zero.
    """
    line = np.stack([np.ones(beside.size), beside - here], axis=1)
    found, *_ = np.linalg.lstsq(line, moved[beside])
    variance = float(np.sum((moved[beside] - line @ found) ** 2)) / (beside.size - 2)
    error = np.sqrt(variance * np.linalg.inv(line.T @ line)[0, 0])
    return bool(np.linalg.norm(found[0]) < APART * error)


def _ratio(size: Array, beside: IntArray, here: int) -> Scalar:
    """Return the size (n,) at one interval over the line through those around it, with its standard error."""
    line = np.polynomial.Polynomial.fit(beside - here, size[beside], 1)
    expected = float(line(0.0))
    scatter = float(np.sqrt(np.sum((size[beside] - line(beside - here)) ** 2) / (beside.size - 2)))
    return Scalar(size[here] / expected, scatter / expected * float(np.sqrt(1.0 + 1.0 / beside.size)))


def _longest_stretch(sequence: Sequence, jumps: list[_Step]) -> Sequence:
    """Return the longest stretch, in frames, between two jumps, with its samples; of equal ones the first."""
    frame_part = np.searchsorted([jump.frame for jump in jumps], np.arange(sequence.frame_count), side="left")
    sample_part = np.searchsorted([jump.sample for jump in jumps], np.arange(sequence.motion.t_ns.size), side="left")
    part = int(np.argmax(np.bincount(frame_part)))
    return keep_samples(keep_frames(sequence, np.flatnonzero(frame_part == part)), sample_part == part)


FAULT = Fault(
    "clock-jump",
    "a clock that is set during the recording, by more or less than a step, while the vehicle moves on",
    check,
)
